"""The table of data sets' truth: medians and the worst over people, and people by name."""

import argparse
import json
from dataclasses import replace

import pytest
import torch

from benchmarks.tables import truth as tables_truth
from walking_person import sound_recording
from wearcap.recording import RecordingStore


@pytest.fixture
def table(monkeypatch):
    return tables_truth


def test_sets_and_people(table, tmp_path, capsys):
    store, walk = RecordingStore(tmp_path / "walks"), sound_recording(4.0)
    for subject, height in (("Anna", 0.0), ("Bert", 0.02), ("Cleo", -0.04)):
        t = walk.motion.t_world_root + torch.tensor([0.0, 0.0, height])
        lifted = replace(walk, name=subject, subject=subject, motion=replace(walk.motion, t_world_root=t))
        store.add(lifted, split="train", config_hash="")
    parser = argparse.ArgumentParser()
    table.add_arguments(parser)
    shown = {}
    for extra in ([], ["--people"]):
        options = parser.parse_args(
            ["--datasets", str(store.root), *extra], argparse.Namespace(quick=False, output=tmp_path)
        )
        written = json.loads(table.tables(options, {}).read_text())
        lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in capsys.readouterr().out.splitlines()]
        assert len({len(line) for line in lines}) == 1
        soles = lines[0].index("sole cm")
        shown |= {line[0]: (line[1], line[soles], line[lines[0].index("standing knee °")]) for line in lines[2:]}
    assert shown["people"][1] == "-1.5 to 1.5"
    assert shown["walks (3)"] == ("0.2", "0.0 (-4.0)", "–"), (
        "minutes are added up, and the worst is the one below the floor"
    )
    assert [shown[f"walks {name}"][1] for name in ("Anna", "Bert", "Cleo")] == ["0.0", "2.0", "-4.0"]
    assert written["people"]["walks"]["Bert"]["sole_cm"] == pytest.approx(2, abs=0.1)
