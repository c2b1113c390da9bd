"""The table of what each set of motion brings: who learns from what, and what is reported of whom."""

import argparse
import importlib
import json
from dataclasses import replace
from pathlib import Path

import pytest

from normal_walk import walk
from wearcap.errors import WearcapError
from wearcap.models.checkpoint import read_checkpoint
from wearcap.recording import RecordingStore
from wearcap_testing import recording_of, small_dataset

pytestmark = pytest.mark.usefixtures("few_statistics")
SMALL = [
    *(f"model.net.transformer.{name}" for name in ("width=32", "layers=1", "heads=4", "feedforward=32")),
    *("data.dataset.window=60", "data.loading.val_windows=8", "data.loading.batch_size=4", "trainer.accelerator=cpu"),
    *("trainer.enable_progress_bar=false", "callbacks.progress=null"),
]


@pytest.fixture
def table():
    return importlib.import_module("benchmarks.tables.sets")


def given(table, tmp_path: Path, *more: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    table.add_arguments(parser)
    sets = [f"{name}={tmp_path / name}" for name in ("one", "two", "strangers")]
    options = parser.parse_args(["--datasets", *sets, "--steps", "10", *more])
    return argparse.Namespace(**vars(options), quick=False, output=tmp_path / "out")


@pytest.fixture
def sets(tmp_path) -> Path:
    for name in ("one", "two"):
        small_dataset(tmp_path / name)
    RecordingStore(tmp_path / "strangers").add(
        recording_of(walk(10.0, seconds=4.0), "walker"), split="val", config_hash="test"
    )
    return tmp_path


def test_each_row_learns_from_its_sets_alone_with_equal_steps(table, sets, capsys):
    options = given(table, sets, "--seeds", "2", "--weights", "two=0.5", "--overrides", *SMALL)
    tree = json.loads(table.tables(options, {}).read_text())
    assert list(tree["rows"]) == ["all sets", "without one", "without two"]
    for row, by_set in tree["rows"].items():
        assert set(by_set) == {"one", "two", "strangers", "walkers"}
        assert by_set["two"]["mpjpe_cm"]["seeds"] == 2
        assert by_set["two"]["mpjpe_cm"]["std"] > 0, "seeds are other trainings"
        assert by_set["walkers"]["truth_stance_knee_deg"]["mean"] == pytest.approx(21.5, abs=1.5)
        assert "stance_knee_deg" not in by_set["one"], "nobody walks there"
        for seed in range(2):
            run = sets / "out" / "runs" / f"sets_{row.replace(' ', '_')}_10_{seed}"
            config, _ = read_checkpoint(run / "checkpoints" / "last.ckpt")
            learnt = {name: source["weight"] for name, source in config["data"]["sources"].items() if source}
            assert learnt == {name: w for name, w in {"one": 1.0, "two": 0.5}.items() if row != f"without {name}"}
            assert config["training"]["steps"] == 10
    assert tree["minutes"]["strangers"] == {"train": 0, "val": pytest.approx(240 / 60 / 60, rel=0.02)}
    assert "without two" in capsys.readouterr().out
    options.overrides, folders = [*SMALL, "data.augment=false"], {name: sets / name for name in ("one", "two")}
    first = table._trainings(options, folders, ["one", "two"], sets / "one")[0]
    before = (first.run / "checkpoints" / "last.ckpt").stat().st_mtime_ns
    with pytest.raises(WearcapError, match="augment"):
        first.checkpoint()
    finished = replace(first, overrides=tuple(SMALL), sources=(first.sources[0], (*first.sources[1][:2], 0.5)))
    assert finished.checkpoint().stat().st_mtime_ns == before, "a finished training is kept"


def test_sets_are_pairs_and_two_at_least_teach(table, sets):
    options = given(table, sets)
    options.datasets = ["one"]
    with pytest.raises(WearcapError, match="NAME=VALUE"):
        table.tables(options, {})
    options.datasets = [f"one={sets / 'one'}", f"strangers={sets / 'strangers'}"]
    with pytest.raises(WearcapError, match="training splits of one. Expected those of two"):
        table.tables(options, {})
    options.datasets = [f"strangers={sets / 'strangers'}"]
    with pytest.raises(WearcapError, match="training splits of no set"):
        table.tables(options, {})
    with pytest.raises(WearcapError, match="no such data set"):
        table.tables(argparse.Namespace(**vars(options) | {"datasets": [f"none={sets / 'none'}"]}), {})
