"""The object encoder end to end: it trains, is scored, resumes, and its checkpoint encodes."""

import csv
from pathlib import Path

import pytest
import torch

from wearcap.cli import export, train
from wearcap.models.checkpoint import load_trained
from wearcap.models.point_encoder import PointNeXt
from wearcap.systems.echo.features import EchoFeatures
from wearcap.systems.echo.object_training import ObjectEncoding, instance_loss
from wearcap.systems.echo.training_windows import EchoContent
from wearcap_testing import experiments

EXPERIMENTS = experiments("object_encoder")


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("data")


def loaded(checkpoint: Path) -> PointNeXt:
    """The encoder as ECHO's windows read it."""
    encoder = EchoContent(EchoFeatures(), str(checkpoint)).encoder
    assert encoder is not None
    return encoder


def trained(experiment: str, data: Path, run: Path, *more: str) -> Path:
    train.main(
        [
            f"experiment={experiment}",
            f"paths.datasets={data}",
            f"hydra.run.dir={run}",
            f"paths.outputs={run.parent}",
            "data.dataset.classes=[box,chair,bottle]",
            "data.dataset.per_class={train: 8, val: 3}",
            "data.dataset.points=120",
            "data.loading.batch_size=6",
            "model.net.encoder.width=4",
            "trainer.accelerator=cpu",
            "trainer.log_every_n_steps=1",
            "trainer.enable_progress_bar=false",
            "callbacks.progress=null",
            "logger.csv.flush_logs_every_n_steps=1",
            *more,
        ]
    )
    return run / "checkpoints" / "last.ckpt"


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_it_learns_and_its_checkpoint_encodes(experiment, data, tmp_path):
    steps = ("trainer.max_steps=24", "data.loading.steps_per_epoch=12", "optimizer.scheduler.warmup=2")
    checkpoint = trained(experiment, data, tmp_path / "run", *steps, "optimizer.optimizer.lr=0.01")
    with open(tmp_path / "run" / "metrics.csv") as file:
        rows = list(csv.DictReader(file))
    losses = [float(row["train/loss"]) for row in rows if row["train/loss"]]
    assert sum(losses[-5:]) < 0.9 * sum(losses[:5])
    last = [row for row in rows if row["val/accuracy_1"]][-1]
    assert 0 <= float(last["val/accuracy_2"]) <= 1
    system, _ = load_trained(checkpoint)
    assert isinstance(system, ObjectEncoding)
    assert system.net.classes == ("box", "chair", "bottle")
    export.main(
        [
            f"checkpoint={checkpoint}",
            "dtype=bfloat16",
            "format=safetensors",
            f"output={tmp_path}/e.safetensors",
            f"hydra.run.dir={tmp_path}/x",
        ]
    )
    encoder = loaded(tmp_path / "e.safetensors")
    assert not encoder.training
    points = torch.rand(2, 150, 3)
    feature = encoder(points)
    assert not feature.requires_grad
    close = torch.cosine_similarity(feature, system.net.encoder(points).detach())
    assert close.min() > 0.98


@pytest.mark.slow
def test_resuming_equals_training_straight_through(data, tmp_path, capsys):
    short = ("data.loading.steps_per_epoch=3", "optimizer.scheduler.total=6", "optimizer.scheduler.warmup=2")
    straight = trained("object_encoder", data, tmp_path / "straight", "trainer.max_steps=6", *short)
    half = trained("object_encoder", data, tmp_path / "half", "trainer.max_steps=3", *short)
    resumed = trained("object_encoder", data, tmp_path / "resumed", "trainer.max_steps=6", *short, f"resume={half}")
    one, other = (loaded(path).state_dict() for path in (straight, resumed))
    assert all(torch.equal(one[name], other[name]) for name in one)
    capsys.readouterr()
    trained("object_encoder", data, tmp_path / "again", "trainer.max_steps=6", *short, f"resume={resumed}")
    assert "no step was left to make" in capsys.readouterr().out


def test_an_object_is_found_by_its_other_view():
    one = torch.eye(6)
    assert instance_loss(one, 3 * one) < 0.01
    assert instance_loss(one, one.roll(1, 0)) > 5
