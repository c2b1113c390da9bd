"""Whole data sets: spread over processes, finished recordings kept, failures listed, memory bounded."""

import csv
import gc
import json
import os
import shutil
import subprocess
import sys
import time
import weakref
from pathlib import Path

import pytest
import torch
from PIL import Image

from wearcap.cli import capture, evaluate, export, train
from wearcap.cli.conf import compose, conf_dir, load_pipeline, with_pipeline
from wearcap.errors import WearcapError
from wearcap.evaluation import datasets
from wearcap.evaluation.datasets import Outcome, over_recordings, scored, settings_key
from wearcap.io.formats.motion_npz import read_motion
from wearcap.metrics.table import Row
from wearcap.models.checkpoint import shared_checkpoints
from wearcap.parallel import Parallel
from wearcap.recording import RecordingStore
from wearcap.runtime.system import Captured, CaptureInput, System, training_of
from wearcap_testing import recording_of, small_dataset, swaying_motion

FEW_STEPS = "pipeline.sampling.steps=1"


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return small_dataset(tmp_path_factory.mktemp("data")).root


@pytest.fixture(scope="module")
def checkpoint(data, tmp_path_factory) -> Path:
    run = tmp_path_factory.mktemp("runs") / "run"
    small = [f"model.net.transformer.{name}" for name in ("width=32", "layers=1", "heads=4", "feedforward=32")]
    quiet = ["trainer.enable_progress_bar=false", "callbacks.progress=null", "callbacks.capture=null"]
    given = [f"data.sources.simulated.root={data}", f"hydra.run.dir={run}", "data.dataset.window=60", "debug=fast"]
    train.main(["experiment=motion_diffusion_head", "trainer.accelerator=cpu", *given, *small, *quiet])
    return run / "checkpoints" / "last.ckpt"


def capturing(checkpoint: Path, data: Path, output: Path, *more: str) -> None:
    given = [f"checkpoint={checkpoint}", f"recording={data}", f"output={output}", f"hydra.run.dir={output}/run"]
    capture.main([*given, "video=false", "body=false", FEW_STEPS, *more])


def table(path: Path) -> dict[str, dict[str, str]]:
    with open(path, newline="") as file:
        return {row["recording"]: row for row in csv.DictReader(file)}


def written(output: Path) -> dict[str, int]:
    return {path.parent.name: path.stat().st_mtime_ns for path in output.glob("*/motion.npz")}


def test_a_data_set_is_captured_and_gone_on_with(checkpoint, data, tmp_path, capsys):
    output = tmp_path / "out"
    capturing(checkpoint, data, output, "jobs=2")
    names = RecordingStore.open(data).names()
    rows = table(output / "recordings.csv")
    assert list(rows) == names
    assert set(written(output)) == set(names)
    assert all(float(row["mpjpe_cm"]) > 0 and not row["error"] for row in rows.values())
    assert int(rows["r2"]["frames"]) == len(read_motion(output / "r2/motion.npz"))
    shown = capsys.readouterr().out
    assert all(name in shown for name in (*names, "seconds", "frames", "mpjpe_cm"))
    first = written(output)
    capturing(checkpoint, data, output)
    assert written(output) == first, "what is finished is not captured again"
    assert table(output / "recordings.csv") == rows
    (output / "r3/motion.bvh").unlink()
    capturing(checkpoint, data, output, "jobs=1")
    again = written(output)
    assert {name for name in names if again[name] != first[name]} == {"r3"}
    capturing(checkpoint, data, output, "jobs=1", "seed=4", "split=test")
    other = written(output)
    assert {name for name in names if other[name] != again[name]} == {"r4", "r5"}, "another config, of one split"
    capturing(checkpoint, data, output, "jobs=1", "seed=4", "split=test", "overwrite=true")
    assert written(output)["r4"] != other["r4"]


def test_another_checkpoint_or_other_inputs_are_captured_again(checkpoint, data, tmp_path, trusted):
    own, output = Path(shutil.copytree(data, tmp_path / "own")), tmp_path / "out"
    saved = torch.load(checkpoint, weights_only=True)
    torch.save(saved, tmp_path / "a.ckpt")
    capturing(tmp_path / "a.ckpt", own, output, "jobs=1", "split=test")
    first = written(output)
    RecordingStore.open(own).add(recording_of(swaying_motion(150, 9), "r4"), split="test", config_hash="new")
    capturing(tmp_path / "a.ckpt", own, output, "jobs=1", "split=test")
    second = written(output)
    assert [second[name] == first[name] for name in ("r4", "r5")] == [False, True]
    saved["state_dict"]["net.head.bias"] += 1.0
    torch.save(saved, tmp_path / "a.ckpt")
    capturing(tmp_path / "a.ckpt", own, output, "jobs=1", "split=test")
    third = written(output)
    assert all(third[name] != second[name] for name in third)


def test_a_failed_recording_does_not_stop_the_others(checkpoint, data, tmp_path, capsys):
    own, output = Path(shutil.copytree(data, tmp_path / "own")), tmp_path / "out"
    store = RecordingStore.open(own)
    store.path_of("r1").write_bytes(store.path_of("r1").read_bytes()[:-1000])
    with pytest.raises(WearcapError, match="1 of 6 recordings failed, r1 among them: .*r1") as caught:
        capturing(checkpoint, own, output, "jobs=1")
    assert "\n" not in str(caught.value)
    rows = table(output / "recordings.csv")
    assert {name for name, row in rows.items() if row["error"]} == {"r1"}
    assert set(written(output)) == set(store.names()) - {"r1"}
    assert "error" in capsys.readouterr().out
    shutil.copy(RecordingStore.open(data).path_of("r1"), store.path_of("r1"))
    before = written(output)
    capturing(checkpoint, own, output, "jobs=1")
    assert written(output).items() >= before.items()
    assert "r1" in written(output)


def evaluating(checkpoint: Path, data: Path, output: Path, *more: str) -> dict:
    given = [f"checkpoint={checkpoint}", f"dataset={data}", f"output={output}", f"hydra.run.dir={output.parent}/run"]
    evaluate.main([*given, "seeds=[0,1]", "batch_size=2", FEW_STEPS, *more])
    return json.loads(output.read_text())["methods"]


@pytest.mark.parametrize(
    "how",
    [
        "backend=threading",
        pytest.param("backend=loky", marks=pytest.mark.slow),
        pytest.param("backend=dask", marks=pytest.mark.slow),
    ],
)
def test_scores_are_the_same_however_they_are_spread(how, checkpoint, data, tmp_path):
    if how.endswith("dask"):
        pytest.importorskip("distributed")
    alone = evaluating(checkpoint, data, tmp_path / "alone/t.json", "jobs=1")
    spread = evaluating(checkpoint, data, tmp_path / "spread/t.json", "jobs=2", how)
    assert set(alone) == set(spread) == {"wearcap", "mean pose", "nearest window"}
    for method, scores in alone.items():
        for name, value in scores.items():
            mean = spread[method][name]["mean"]
            assert mean == (None if value["mean"] is None else pytest.approx(value["mean"], rel=2e-3, abs=1e-4)), name


def test_an_evaluation_goes_on_and_lists_what_failed(checkpoint, data, tmp_path, monkeypatch):
    own, output = Path(shutil.copytree(data, tmp_path / "own")), tmp_path / "t.json"
    store = RecordingStore.open(own)
    whole_file = store.path_of("r5").read_bytes()
    store.path_of("r5").write_bytes(whole_file[:-1000])
    with pytest.raises(WearcapError, match="1 of 2 recordings failed, r5 among them"):
        evaluating(checkpoint, own, output, "jobs=1")
    assert json.loads(output.read_text())["methods"]["wearcap"]["mpjpe_cm"]["seeds"] == 2
    rows = table(tmp_path / "t.csv")
    assert (bool(rows["r5"]["error"]), bool(rows["r4"]["error"])) == (True, False)
    store.path_of("r5").write_bytes(whole_file)
    captured = []
    monkeypatch.setattr(datasets, "evaluate", lambda *given: captured.append(given[2]) or _evaluate(*given))
    both = evaluating(checkpoint, own, output, "jobs=1")
    assert captured[0] == ["r5"], "the other one is finished"
    captured.clear()
    assert evaluating(checkpoint, own, output, "jobs=1") == both
    assert captured == []


_evaluate = datasets.evaluate


def test_an_evaluation_says_where_it_errs_and_draws_the_worst(checkpoint, data, tmp_path, capsys):
    evaluating(checkpoint, data, tmp_path / "t.json", "jobs=1", "sheets=true")
    tree = json.loads((tmp_path / "t.json").read_text())
    errors = {name: float(row["mpjpe_cm"]) for name, row in table(tmp_path / "t.csv").items()}
    assert tree["recordings"]["worst"] == max(errors, key=lambda name: errors[name])
    assert tree["recordings"]["best"] == min(errors, key=lambda name: errors[name])
    assert set(tree["activities"]) == {"wearcap", "mean pose", "nearest window"}
    activities = tree["activities"]["wearcap"]
    assert {row["activity"] or "unnamed" for row in table(tmp_path / "t.csv").values()} == set(activities)
    for scores in activities.values():
        assert scores["foot_pe_cm"]["mean"] > scores["head_pe_cm"]["mean"] > 0
    out = capsys.readouterr().out
    assert "by part of the body" in out
    assert f"worst: {tree['recordings']['worst']}" in out
    for place in ("worst", "median", "best"):
        picture = Image.open(tmp_path / f"t_{place}.png")
        assert picture.height == 2 * 240


def test_an_evaluation_without_the_training_data_runs_and_says_what_is_missing(
    checkpoint, data, tmp_path, capsys, trusted
):
    away, moved = tmp_path / "away", tmp_path / "moved.ckpt"
    saved = torch.load(checkpoint, weights_only=True)
    saved["wearcap"]["config"] = saved["wearcap"]["config"].replace(str(data), str(away))
    torch.save(saved, moved)
    assert set(evaluating(moved, data, tmp_path / "t.json", "jobs=1")) == {"wearcap"}
    lines = [line for line in capsys.readouterr().out.splitlines() if "left out" in line]
    assert len(lines) == 1
    assert "mean pose, nearest window" in lines[0]
    assert f"{away}: no data set here" in lines[0]
    assert "baselines=false" in lines[0]
    evaluating(moved, data, tmp_path / "t.json", "jobs=1", "baselines=false")
    assert "left out" not in capsys.readouterr().out


def test_a_checkpoint_chooses_its_pipeline(checkpoint, data, tmp_path):
    assert with_pipeline([f"checkpoint={checkpoint}"])[0] == "pipeline=hmd2"
    for name in shared_checkpoints():
        _, owner = training_of(name)
        chosen = with_pipeline([f"checkpoint={name}", "device=cpu"])
        assert (chosen[0] == f"pipeline={owner.pipeline}") if owner else (chosen[0] == f"checkpoint={name}"), name
    several = "checkpoint=[contact_transformer_sliding,contact_transformer_hinged]"
    assert with_pipeline([several])[0] == "pipeline=ireplica"
    assert with_pipeline(["-m", "checkpoint=echo,echo"])[0] == "pipeline=echo"
    for given in (["pipeline=hps"], ["checkpoint=echo", "pipeline=echo_online"], ["checkpoint=null"]):
        assert with_pipeline(given) == given
    with pytest.raises(WearcapError, match=r"several pipelines: echo \(echo\), hmd2 \(hmd2\)"):
        with_pipeline(["checkpoint=[echo,hmd2]"])


@pytest.mark.parametrize("name", ["hmd2", "mocap_every", "echo", "contact_sequence"])
def test_the_chosen_pipeline_runs_the_checkpoint(name):
    given = [*with_pipeline([f"checkpoint={name}"]), "recording=x"]
    system = load_pipeline(name, compose("capture", given).pipeline, "cpu")
    owner = training_of(name)[1]
    assert owner is not None
    assert type(system) is owner
    assert owner.pipeline is not None
    assert (conf_dir() / "pipeline" / f"{owner.pipeline}.yaml").is_file()


@pytest.mark.parametrize(
    ("name", "pipeline", "message"),
    [
        ("mocap_every", "hmd2", "HMD2 cannot run WatchRegression.*pipeline=mocap_every"),
        ("hmd2", "ireplica", "IReplica cannot run MotionDiffusion.*pipeline=hmd2"),
        ("egoview", "hmd2", "HMD2 cannot run EgoView's network. Expected a checkpoint of experiment=hmd2.$"),
    ],
)
def test_another_systems_checkpoint_is_one_clear_line(name, pipeline, message, data, tmp_path):
    with pytest.raises(WearcapError, match=f"^{name}: {message}") as caught:
        evaluate.main([f"checkpoint={name}", f"pipeline={pipeline}", f"dataset={data}", f"hydra.run.dir={tmp_path}"])
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_a_shared_checkpoint_is_exported_without_naming_its_pipeline(tmp_path):
    export.main(["checkpoint=mocap_every", "format=pt2", f"output={tmp_path}/m.pt2", f"hydra.run.dir={tmp_path}"])
    assert (tmp_path / "m.pt2").is_file()


class Truth(System):
    """Captures what is true, and remembers how many recordings are alive."""

    name = "truth"

    def __init__(self):
        self.seen: list[weakref.ref] = []
        self.alive: list[int] = []

    def capture(self, recordings, seeds, options=None):
        sources = [CaptureInput.of(recording) for recording in recordings]
        self.seen += [weakref.ref(source.recording) for source in sources]
        gc.collect()
        self.alive.append(sum(each() is not None for each in self.seen))
        return [Captured(source.recording.motion) for source in sources]

    def score(self, motion, source, seed):
        return Row(source.recording.name, seed, len(motion), {"zero_cm": 0.0, "unknown": float("nan")})


def test_memory_does_not_grow_with_the_number_of_recordings(tmp_path):
    store = RecordingStore(tmp_path / "data")
    for index in range(24):
        store.add(recording_of(swaying_motion(30, index), f"r{index:02}"), split="test", config_hash="x")
    system = Truth()

    def work(names):
        return scored(names, system=lambda: system, key="k", root=store.root, seeds=[0], batch_size=4)

    outcomes = list(over_recordings(work, store, store.names(), Parallel(jobs=1), chunk=4, notes=tmp_path / "n"))
    assert [outcome.recording for outcome in outcomes] == store.names()
    assert len(system.alive) == 6
    assert max(system.alive) <= 8, "those of one chunk, and no more than the one before"


def test_what_was_finished_before_a_kill_is_kept(tmp_path):
    store, done = small_dataset(tmp_path / "data"), []

    def work(names):
        if len(done) == 2:
            raise KeyboardInterrupt
        done.extend(names)
        rows = (Row(names[0], 0, 3, {"a_cm": 1.0, "unknown": float("nan"), "endless": float("inf")}),)
        return [Outcome(names[0], 1.5, 3, rows)]

    def outcomes():
        return list(over_recordings(work, store, store.names(), Parallel(jobs=1), notes=tmp_path / "n", settings="s"))

    with pytest.raises(KeyboardInterrupt):
        outcomes()
    first = list(done)
    done[:] = []
    with pytest.raises(KeyboardInterrupt):
        outcomes()
    assert not set(first) & set(done)
    for path in (tmp_path / "n").glob("*.json"):
        json.loads(path.read_text(), parse_constant=pytest.fail)
    (tmp_path / "n" / f"{first[0]}.json").write_text("{broken")
    third = list(done)
    done[:] = []
    with pytest.raises(KeyboardInterrupt):
        outcomes()
    assert done == [first[0], next(name for name in store.names() if name not in {*first, *third})]
    (kept,) = over_recordings(work, store, [first[1]], Parallel(jobs=1), notes=tmp_path / "n", settings="s")
    assert kept.rows[0].scores["a_cm"] == 1.0
    assert kept.rows[0].scores["unknown"] != kept.rows[0].scores["unknown"]
    assert kept.rows[0].scores["endless"] == float("inf")


def test_the_key_of_settings_is_of_files_and_code(tmp_path):
    file = tmp_path / "x.json"
    file.write_text("1")
    config = {"pipeline": {"_target_": "wearcap.systems.hps.pipeline.HPS", "environment": str(file)}, "seeds": [0]}
    key = settings_key(config, [])
    assert key == settings_key(json.loads(json.dumps(config)), [])
    file.write_text("2")
    assert settings_key(config, []) != key
    assert settings_key(config, ["hmd2"]) != settings_key(config, ["echo"])
    other = {**config, "pipeline": config["pipeline"] | {"_target_": "wearcap.systems.echo.pipeline.Echo"}}
    assert settings_key(other, []) != settings_key(config, [])


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="kills a process")
def test_a_killed_capture_goes_on_with_what_is_left(checkpoint, tmp_path):
    """Two workers, killed with their parent after the first recordings; nothing finished is captured again."""
    store, output = RecordingStore(tmp_path / "data"), tmp_path / "out"
    for index in range(8):
        store.add(recording_of(swaying_motion(400, index), f"r{index}"), split="test", config_hash="x")
    given = [f"checkpoint={checkpoint}", f"recording={store.root}", f"output={output}", f"hydra.run.dir={tmp_path}/run"]
    command = [sys.executable, "-m", "wearcap.cli.main", "capture", *given, "video=false", "body=false", FEW_STEPS]
    process = subprocess.Popen([*command, "jobs=2"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 120
    while not list(output.glob("finished/*.json")):
        assert process.poll() is None, "it ended before anything was finished"
        assert time.monotonic() < deadline
        time.sleep(0.02)
    process.kill()
    process.wait()
    finished = {path.stem: path.stat().st_mtime_ns for path in output.glob("finished/[!.]*.json")}
    capturing(checkpoint, store.root, output, "jobs=1")
    after = {path.stem: path.stat().st_mtime_ns for path in output.glob("finished/[!.]*.json")}
    assert set(after) == set(store.names())
    assert finished.items() <= after.items()
    assert len(table(output / "recordings.csv")) == 8
