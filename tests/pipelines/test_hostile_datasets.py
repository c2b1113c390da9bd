"""Commands on data sets from elsewhere: names are literal, nothing is resolved in them, and no file outside is touched."""

import csv
import json
import os
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from command_line import exit_code
from hostile import in_time
from wearcap.cli import capture, evaluate
from wearcap.errors import WearcapError
from wearcap.evaluation.datasets import Outcome, outcome_table, over_recordings
from wearcap.parallel import Parallel
from wearcap.reading import read
from wearcap.recording import RecordingStore
from wearcap.recording.store import save_recording
from wearcap.runtime.stages import StagedSystem
from wearcap.runtime.system import StageOptions
from wearcap_testing import recording_of, swaying_motion

NAMES = (
    "${oc.env:HOME}",
    "${now:}",
    "${recording}",
    "a,b",
    "[x]",
    "{a:1}",
    "null",
    "x=y",
    "???",
    "-m",
    "it's",
    'say "hi"',
    "two words",
    "[red]x",
    "\\${x}",
    "true",
)


@pytest.fixture(autouse=True)
def soon():
    with in_time(300):
        yield


def dataset(root: Path, names: Sequence[str]) -> RecordingStore:
    store = RecordingStore(root)
    for name in names:
        store.add(recording_of(swaying_motion(60, 1), name), split="test", config_hash="x")
    return store


@pytest.fixture
def home(monkeypatch) -> str:
    monkeypatch.setenv("HOME", "/home/secret-person")
    return "secret-person"


def test_recordings_are_captured_and_scored_under_their_literal_names(tmp_path, home, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    store, output = dataset(tmp_path / "data", NAMES), tmp_path / "out"
    plain = ["pipeline=recorded", "jobs=1", f"hydra.run.dir={tmp_path}/run", f"output={output}"]
    capture.main([*plain, f"recording={store.root}", "video=false", "body=false", "smpl=false"])
    assert {path.parent.name for path in output.glob("*/motion.npz")} == set(NAMES)
    with open(output / "recordings.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["recording"] for row in rows] == sorted(NAMES)
    assert not any(row["error"] for row in rows)
    assert home not in "".join(str(path) for path in tmp_path.rglob("*"))
    evaluate.main([*plain[:-1], f"output={output}/table.json", f"dataset={store.root}", "seeds=[0]"])
    with open(output / "table.csv", newline="") as file:
        assert [row["recording"] for row in csv.DictReader(file)] == sorted(NAMES)
    shown = capsys.readouterr()
    assert home not in shown.out + shown.err
    assert "[red]x" in shown.out


def test_one_recording_given_by_its_file_keeps_its_literal_name(tmp_path, home, capsys):
    for name in NAMES:
        save_recording(recording_of(swaying_motion(60, 1), name), file := tmp_path / "x.safetensors")
        assert exit_code(["doctor", str(file)]) in (0, 1)
        assert read(file).name == name
    shown = capsys.readouterr()
    assert home not in shown.out + shown.err


def test_a_table_shows_names_and_errors_as_they_are():
    console = Console(width=200, record=True, file=open(os.devnull, "w"))  # noqa: SIM115
    console.print(outcome_table("t", [Outcome("[/x]", error="[bold]no[/]")]))
    assert "[/x]" in (text := console.export_text())
    assert "[bold]no[/]" in text


def outcomes(store: RecordingStore, notes: Path) -> dict[str, str]:
    def work(names: Sequence[str]) -> list[Outcome]:
        return [Outcome(name, 1.0, 1) for name in names]

    store = RecordingStore.open(store.root)
    return {
        found.recording: found.error
        for found in over_recordings(work, store, store.names(), Parallel(jobs=1), notes=notes)
    }


@pytest.mark.skipif(os.name != "posix", reason="pipes and links as of POSIX")
@pytest.mark.parametrize("part", ["scene", "environment"])
def test_only_files_that_are_used_are_hashed(tmp_path, part):
    """Beside the scan lie a pipe, a link to a device, and a file that changes."""
    store = RecordingStore(tmp_path / "data")
    room = store.root / "room"
    room.mkdir(parents=True)
    os.mkfifo(room / "pipe")
    os.mkfifo(room / "map.safetensors")
    (room / "zero").symlink_to("/dev/zero")
    (room / "a.json").write_text("{}")
    recording = replace(recording_of(swaying_motion(60, 1), "a"), **{part: "room/a.json"})
    store.add(recording, split="test", config_hash="")
    evil = replace(recording, name="evil", **{part: "/proc/x.ply"})
    store.add(evil, split="test", config_hash="")
    found = outcomes(store, tmp_path / "notes")
    assert found["a"] == ""
    assert "'/proc/x.ply'" in found["evil"]
    key = json.loads((tmp_path / "notes/a.json").read_text())["key"]
    (room / "other.txt").write_text("new")
    outcomes(store, tmp_path / "notes")
    assert json.loads((tmp_path / "notes/a.json").read_text())["key"] == key
    (room / "a.json").write_text("[]")
    outcomes(store, tmp_path / "notes")
    assert json.loads((tmp_path / "notes/a.json").read_text())["key"] != key


@pytest.mark.parametrize("verb", ["capture", "evaluate", "doctor", "render"])
@pytest.mark.parametrize("scene", ["/proc/x.ply", "../x.ply", "pipe"])
def test_commands_refuse_a_recording_that_names_files_elsewhere(tmp_path, verb, scene, capsys):
    store = RecordingStore(tmp_path / "data")
    recording = recording_of(swaying_motion(60, 1), "a")
    store.add(recording, split="test", config_hash="")
    os.mkfifo(store.root / "pipe")
    store.add(replace(recording, scene=scene, environment=scene), split="test", config_hash="")
    plain = ["pipeline=recorded", "jobs=1", f"hydra.run.dir={tmp_path}/run", f"output={tmp_path}/out/t.json"]
    given = {
        "capture": ["capture", *plain, f"recording={store.root}", "split=test"],
        "evaluate": ["evaluate", *plain, f"dataset={store.root}"],
        "doctor": ["doctor", str(store.root)],
        "render": ["render", str(store.root / "a"), "--out", str(tmp_path / "x.png")],
    }
    assert exit_code(given[verb]) in (1, 2)
    shown = capsys.readouterr()
    text = re.sub(r"\s+", " ", shown.out + shown.err)
    assert "it names the file" in text or "a pipe" in text
    assert "Traceback" not in text


class Nothing(StagedSystem):
    name = "nothing"

    def stages(self, source):
        return []

    def motion_of(self, results):
        return None


@pytest.mark.parametrize("name", ["../../up", "/abs", "..", "a\0b"])
def test_results_are_kept_below_the_cache_alone(tmp_path, name):
    with pytest.raises(WearcapError, match="names the file"):
        Nothing().capture([recording_of(swaying_motion(9, 1), name)], [0], StageOptions(tmp_path / "cache"))
