"""The voxel autoencoder end to end: it trains, is scored, and its checkpoint encodes."""

import csv
import dataclasses
from pathlib import Path

import pytest
import torch

from wearcap.cli import train
from wearcap.data.surroundings import PlaceCodes
from wearcap.recording import PointCloud, RecordingStore
from wearcap_testing import experiments, recording_of, swaying_motion

pytestmark = pytest.mark.usefixtures("few_statistics")

EXPERIMENTS = experiments("voxel_autoencoder")


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    """A floor and a wall."""
    store = RecordingStore(tmp_path_factory.mktemp("data"))
    for seed, split in enumerate(("train", "train", "val")):
        random = torch.Generator().manual_seed(seed)
        points = torch.rand(3000, 3, generator=random) * torch.tensor([6.0, 6.0, 2.0]) - torch.tensor([3.0, 3.0, 0.0])
        points[::2, 2], points[1::2, 0] = 0.0, 1.5
        recording = recording_of(swaying_motion(200, seed), f"r{seed}")
        store.add(dataclasses.replace(recording, points=PointCloud(points)), split=split, config_hash="test")
    return store.root


def trained(experiment: str, data: Path, run: Path, *more: str) -> Path:
    train.main(
        [
            f"experiment={experiment}",
            f"data.sources.simulated.root={data}",
            "data.sources.cmu=null",
            f"hydra.run.dir={run}",
            f"paths.outputs={run.parent}",
            "data.dataset.window=4",
            "data.loading.batch_size=4",
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
    checkpoint = trained(experiment, data, tmp_path / "run", "trainer.max_steps=24", "data.loading.steps_per_epoch=12")
    with open(tmp_path / "run" / "metrics.csv") as file:
        rows = list(csv.DictReader(file))
    losses = [float(row["train/loss"]) for row in rows if row["train/loss"]]
    assert sum(losses[-4:]) < 0.95 * sum(losses[:4])
    last = [row for row in rows if row["val/occupancy_iou"]][-1]
    assert 0 <= float(last["val/occupancy_iou"]) <= 1
    assert 0 < float(last["val/held_distance_cm"]) < 10
    encoder = PlaceCodes(checkpoint).encoder
    assert not encoder.training
    code = encoder.encode(torch.full((3, 10, 10, 10), 0.1))
    assert code.shape == (3, 128)
    assert not code.requires_grad


@pytest.mark.slow
def test_resuming_equals_training_straight_through(data, tmp_path):
    short = ("data.loading.steps_per_epoch=3", "optimizer.scheduler.total=6", "optimizer.scheduler.warmup=2")
    straight = trained("voxel_autoencoder", data, tmp_path / "straight", "trainer.max_steps=6", *short)
    half = trained("voxel_autoencoder", data, tmp_path / "half", "trainer.max_steps=3", *short)
    resumed = trained("voxel_autoencoder", data, tmp_path / "resumed", "trainer.max_steps=6", *short, f"resume={half}")
    one, other = PlaceCodes(straight).encoder.state_dict(), PlaceCodes(resumed).encoder.state_dict()
    assert all(torch.equal(one[name], other[name]) for name in one)
