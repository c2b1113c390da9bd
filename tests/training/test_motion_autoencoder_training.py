"""The motion autoencoder end to end: it trains, its checkpoint is told apart from others, evaluation shows what it measures."""

import csv
import json
from pathlib import Path

import pytest
import torch

from benchmarks.rivals import SEARCH
from wearcap.cli import evaluate, train
from wearcap.cli.conf import compose, load_pipeline
from wearcap.errors import WearcapError
from wearcap.evaluation.evaluate import Realism
from wearcap.models.checkpoint import load_trained
from wearcap.training.motion_autoencoder import MotionEncoding
from wearcap_testing import small_dataset

pytestmark = pytest.mark.usefixtures("few_statistics")


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return small_dataset(tmp_path_factory.mktemp("data")).root


def arguments(data: Path, run: Path, *more: str) -> list[str]:
    return [
        "experiment=motion_autoencoder",
        f"data.sources.simulated.root={data}",
        "data.sources.cmu=null",
        "data.dataset.window=24",
        "model.window=72",
        f"hydra.run.dir={run}",
        f"paths.outputs={run.parent}",
        "model.net.channels=[16,16,16]",
        "model.net.latent=8",
        "trainer.accelerator=cpu",
        "trainer.log_every_n_steps=1",
        "trainer.enable_progress_bar=false",
        "callbacks.progress=null",
        "logger.csv.flush_logs_every_n_steps=1",
        *more,
    ]


@pytest.fixture(scope="module")
def checkpoint(data, tmp_path_factory) -> Path:
    run = tmp_path_factory.mktemp("runs") / "run"
    quick = ["optimizer.optimizer.lr=0.02", "optimizer.scheduler.warmup=5", "trainer.max_steps=40"]
    train.main(arguments(data, run, *quick, "data.loading.steps_per_epoch=20", "data.loading.batch_size=8"))
    return run / "checkpoints" / "last.ckpt"


def logged(run: Path, name: str) -> list[float]:
    with open(run / "metrics.csv") as file:
        return [float(row[name]) for row in csv.DictReader(file) if row.get(name)]


def test_it_learns_and_carries_its_statistics(checkpoint):
    run = checkpoint.parents[1]
    losses = logged(run, "train/loss")
    assert sum(losses[-5:]) < 0.9 * sum(losses[:5])
    assert logged(run, "val/joints_cm")
    system, config = load_trained(checkpoint)
    assert isinstance(system, MotionEncoding)
    assert config["name"] == "motion_autoencoder"
    assert not torch.equal(system.net.normalizer.mean, torch.zeros(143))


def test_its_checkpoint_measures_realism_and_nothing_else(checkpoint):
    realism = Realism.load(checkpoint)
    assert not realism.net.training
    assert (realism.net.frames, realism.stride) == (24, 20)
    config = compose("evaluate", ["pipeline=hmd2", "paths.run=x"])
    with pytest.raises(WearcapError, match="HMD2 cannot run MotionEncoding"):
        load_pipeline(checkpoint, config.pipeline, "cpu")


def test_evaluation_shows_it_beside_the_other_scores(checkpoint, data, tmp_path, capsys):
    run = tmp_path / "regressor"
    train.main(
        [
            SEARCH,
            "experiment=pose_regressor_head",
            f"data.sources.simulated.root={data}",
            "data.dataset.window=60",
            "debug=fast",
            f"hydra.run.dir={run}",
            f"paths.outputs={tmp_path}",
            "trainer.accelerator=cpu",
            "trainer.precision=32-true",
            "trainer.enable_progress_bar=false",
            "callbacks.progress=null",
            "~callbacks.capture",
            "model.net.width=32",
            "model.net.layers=1",
            "model.net.heads=4",
            "model.net.feedforward=32",
        ]
    )
    evaluate.main(
        [
            SEARCH,
            f"checkpoint={run}/checkpoints/last.ckpt",
            "pipeline=pose_regressor",
            f"realism={checkpoint}",
            "seeds=[0,1]",
            f"hydra.run.dir={tmp_path}/e",
            f"output={tmp_path}/table.json",
        ]
    )
    methods = json.loads((tmp_path / "table.json").read_text())["methods"]
    for scores in methods.values():
        assert scores["mpjpe_cm"]["mean"] > 0
        assert scores["fid"]["mean"] is scores["diversity"]["mean"] is scores["truth_diversity"]["mean"] is None
    assert methods["wearcap"]["fid"]["seeds"] == 2
    printed = " ".join(capsys.readouterr().out.split())
    assert "mean pose: 8 windows are too few for FID and Diversity (at least 2000)" in printed
