"""Rivals are trained at the best of a few rates, go on after a kill, and their tables say so."""

import argparse
import importlib
import json
from pathlib import Path

import pytest
from rich.progress import Progress

from benchmarks.rivals import compose
from benchmarks.rivals import trainings as rivals
from benchmarks.rivals.pose_regression.net import PoseRegressor
from benchmarks.rivals.pose_regression.training import PoseRegression
from benchmarks.tables import echo as tables
from benchmarks.tables import hmd2_runs as runs
from benchmarks.tables import tabling
from wearcap.errors import WearcapError
from wearcap.metrics.table import Row, Summary
from wearcap.models.build import brought_up_to_date, target_of
from wearcap.models.checkpoint import read_checkpoint
from wearcap_testing import small_dataset

pytestmark = pytest.mark.usefixtures("few_statistics")
NAME, STEP, STEPS = "motion_diffusion_head", 8 * 240, 60
SMALL = [f"model.net.transformer.{name}" for name in ("width=32", "layers=1", "heads=4", "feedforward=32")]
QUIET = [
    "data.dataset.window=60",
    "data.loading.val_windows=8",
    "trainer.accelerator=cpu",
    "trainer.enable_progress_bar=false",
    "callbacks.progress=null",
]


@pytest.fixture(scope="module")
def datasets(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("datasets")
    for name in ("cmu", "simulated", "accad", "hdm05", "ui_prmd", "fubot_vr"):
        small_dataset(folder / name)
    return folder


def given(datasets: Path, runs: Path, *more: str) -> list[str]:
    overrides = [f"paths.datasets={datasets}", "trainer.precision=32-true", *SMALL, *QUIET]
    return [
        "hmd2",
        "--only",
        NAME,
        "--runs",
        str(runs),
        "--budget",
        str(STEPS * STEP),
        *more,
        "--overrides",
        *overrides,
    ]


def finish(arguments: list[str]) -> object:
    with pytest.raises(SystemExit) as ended:
        rivals.main(arguments)
    return ended.value.code


def test_rates_are_swept_the_best_trained_and_what_is_finished_left_alone(datasets, tmp_path, monkeypatch, capsys):
    fitted = []
    fit = rivals.Rival.fit

    def remembered(rival, rate, share, run, seed=0):
        fitted.append((rate, share, seed))
        if len(fitted) == 3:
            raise KeyboardInterrupt  # killed after the sweep
        return fit(rival, rate, share, run, seed)

    monkeypatch.setattr(rivals.Rival, "fit", remembered)
    arguments = given(datasets, tmp_path, "--rates", "1e-9", "3e-3", "--seeds", "0", "1")
    with pytest.raises(KeyboardInterrupt):
        rivals.main(arguments)
    assert fitted == [(1e-9, 0.1, 0), (3e-3, 0.1, 0), (3e-3, 1.0, 0)]
    note = json.loads((tmp_path / NAME / "rate.json").read_text())
    assert note["losses"]["0.003"] < note["losses"]["1e-09"]
    assert not note["finished"]
    assert finish(arguments) == 0
    assert fitted[3:] == [(3e-3, 1.0, 0), (3e-3, 1.0, 1)], "the sweep is not made again"
    assert finish(arguments) == 0
    assert len(fitted) == 5
    assert f"{NAME}: rate 0.003" in capsys.readouterr().out
    for run in (NAME, f"{NAME}_1"):
        best = tmp_path / run / "checkpoints" / "best.ckpt"
        config, _ = read_checkpoint(best)
        assert config["optimizer"]["optimizer"]["lr"] == 0.003
        assert config["seed"] == int(run != NAME)
        took = tabling.training_of(str(best))
        assert took["rate_swept"].mean == 0.003
        assert str(took["rate_swept"]) == "0.0030"
        assert 0 < took["frames_seen_m"].mean <= STEPS * 8 * 60 / 1e6
    assert not (tmp_path / NAME / "sweep").exists()


def test_a_killed_training_goes_on_where_it_was(datasets, tmp_path, monkeypatch):
    import lightning

    arguments = given(datasets, tmp_path, "--rates", "1e-3")
    fit = lightning.Trainer.fit

    def killed(trainer, module, *rest, **named):
        class Kill(lightning.Callback):
            def on_train_batch_end(self, trainer, *_):
                if trainer.global_step == 25:
                    raise KeyboardInterrupt("killed")

        trainer.callbacks.append(Kill())
        return fit(trainer, module, *rest, **named)

    with monkeypatch.context() as patch:
        patch.setattr(lightning.Trainer, "fit", killed)
        with pytest.raises((KeyboardInterrupt, SystemExit)):
            rivals.main(arguments)
    assert (tmp_path / NAME / "checkpoints" / "last.ckpt").is_file()
    assert not json.loads((tmp_path / NAME / "rate.json").read_text())["finished"]
    assert finish(arguments) == 0
    config, _ = read_checkpoint(tmp_path / NAME / "checkpoints" / "last.ckpt")
    assert config["training"]["steps"] == STEPS
    note = json.loads((tmp_path / NAME / "rate.json").read_text())
    assert note["losses"] == {}, "one rate needs no sweep"
    assert "rate_swept" not in tabling.training_of(str(tmp_path / NAME / "checkpoints" / "best.ckpt"))


def test_another_budget_and_no_finite_loss_are_refused(datasets, tmp_path, monkeypatch, capsys):
    rival = rivals.Rival("hmd2", NAME, 100, (1e-3, 1.0), (0,), tmp_path)
    monkeypatch.setattr(rivals.Rival, "fit", lambda *_: float("nan"))
    with pytest.raises(WearcapError, match=r"no rate of 0.001, 1 gives a finite loss. Give lower --rates"):
        rivals.train_rival(rival, 1)
    assert finish(given(datasets, tmp_path)) == 1
    assert f"{NAME} has been trained with frames 100, batch None" in capsys.readouterr().out
    assert finish(["hmd2", "--only", "motion_diffusion"]) == 2


@pytest.mark.parametrize("system", rivals.SYSTEMS)
def test_budgets_scale_with_what_is_asked_for(system):
    table = importlib.import_module(f"benchmarks.tables.{system}")
    ours = compose("train", table.training(table.RUNS[0])).data.loading.batch_size
    for run in table.RUNS:
        small, large = (compose("train", table.training(run, frames)) for frames in (table.BUDGET, 10 * table.BUDGET))
        assert large.trainer.max_steps == pytest.approx(10 * small.trainer.max_steps, rel=0.05), run
        assert 3 <= small.trainer.max_steps / small.data.loading.steps_per_epoch <= tabling.EPOCHS + 1
        assert large.trainer.max_steps // large.data.loading.steps_per_epoch == tabling.EPOCHS
        assert 0.98 <= small.callbacks.average.decay <= large.callbacks.average.decay <= 0.995
        wide = compose("train", table.training(run, 10 * table.BUDGET, 3 * ours))
        assert wide.data.loading.batch_size == 3 * large.data.loading.batch_size, run
        assert wide.trainer.max_steps == pytest.approx(large.trainer.max_steps / 3, rel=0.01), run


def test_a_training_that_was_stopped_is_no_row(tmp_path):
    checkpoint = tmp_path / NAME / "checkpoints" / "best.ckpt"
    assert not tabling.is_trained(checkpoint)
    checkpoint.parent.mkdir(parents=True)
    checkpoint.touch()
    assert tabling.is_trained(checkpoint), "a training by hand"
    note = tmp_path / NAME / tabling.RATE_FILE
    note.write_text(json.dumps({"rate": 1e-3, "finished": {}}))
    assert not tabling.is_trained(checkpoint)
    note.write_text(json.dumps({"rate": 1e-3, "finished": {"0": 0.4}}))
    assert tabling.is_trained(checkpoint)


@pytest.fixture
def two_trainings(tmp_path) -> tuple[str, str]:
    """Of seeds 0 and 2; that of seed 1 has not finished."""
    for run in (NAME, f"{NAME}_1", f"{NAME}_2"):
        (tmp_path / run / "checkpoints").mkdir(parents=True)
        (tmp_path / run / "checkpoints" / "best.ckpt").touch()
    (tmp_path / f"{NAME}_1" / tabling.RATE_FILE).write_text(json.dumps({"rate": 1e-3, "finished": {}}))
    first, second = map(str, tabling.trainings_of(tmp_path, NAME))
    assert second == str(tmp_path / f"{NAME}_2" / "checkpoints" / "best.ckpt")
    return first, second


def test_a_row_of_hmd2_is_the_mean_of_trainings_that_differ_in_the_seed(two_trainings, tmp_path, monkeypatch):
    errors = dict(zip(two_trainings, (3.0, 5.0)))

    def evaluate(path, store, names, seeds, **_):
        return [Row(name, seed, 60, {"mpjpe_cm": errors[path]}) for seed in seeds for name in names]

    store = small_dataset(tmp_path / "data")
    monkeypatch.setattr(runs, "load_pipeline", lambda path, *_: path)
    monkeypatch.setattr(runs, "training_of", lambda *paths: {"trainings": Summary(len(paths), None, 1)})
    monkeypatch.setattr(runs, "evaluate", evaluate)
    case = runs.Case(store.root, tuple(store.names("test")), (0, 1, 2, 3), (), None, "typical")
    scores = runs.run_method(runs.Method(NAME, two_trainings[0], others=two_trainings[1:]), case).scores
    assert (scores["mpjpe_cm"].mean, scores["mpjpe_cm"].seeds, scores["trainings"].mean) == (4.0, 2, 2)
    assert "best_mpjpe_cm" not in scores, "of other networks, not of other samples"


def test_a_row_of_echo_captures_each_training_with_a_seed_of_its_own(two_trainings, tmp_path, monkeypatch):
    options = argparse.Namespace(runs=tmp_path, leave=(), quick=False, seeds=4, items=2, pipeline=[])
    made = tables._trained({"ours": (NAME, "pipeline=echo")}, options, Progress())
    monkeypatch.setattr(
        tables, "captured", lambda method, _, names, seeds, __: [(method.checkpoint, seeds, method.others)]
    )
    assert list(tables._captured(made[0], options, Progress(), None, ["walk"])) == [
        (two_trainings[0], [0], ()),
        (two_trainings[1], [1], ()),
    ]
    alone = tables.Method("ours", "echo")
    assert list(tables._captured(alone, options, Progress(), None, ["walk"])) == [("echo", [0, 1, 2, 3], ())]


def test_checkpoints_of_rivals_that_name_the_places_of_before_still_load():
    old = "wearcap.systems.hmd2.pose_regressor.training.PoseRegression"
    config = {"_target_": old, "net": {"_target_": "wearcap.models.pose_regressor.PoseRegressor", "_partial_": True}}
    brought_up_to_date(config)
    assert target_of(config["_target_"]) is PoseRegression
    assert target_of(config["net"]["_target_"]) is PoseRegressor
