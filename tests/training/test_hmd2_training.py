"""HMD² with points and images end to end: every experiment of it trains, and one checkpoint captures with any of them."""

import dataclasses
import json
from pathlib import Path

import pytest
import torch

from wearcap.cli import capture, evaluate, train
from wearcap.data.surroundings import PlaceCodes
from wearcap.errors import WearcapError
from wearcap.geometry.camera import Camera
from wearcap.io.formats.motion_npz import read_motion
from wearcap.models.checkpoint import load_trained
from wearcap.recording import CameraStream, PointCloud, Recording, RecordingStore
from wearcap_testing import experiments, recording_of, swaying_motion

pytestmark = pytest.mark.usefixtures("few_statistics")

EXPERIMENTS = experiments("hmd2")
SIZE = 64


def seeing(seed: int) -> Recording:
    """A recording with a floor, a wall and embeddings of 30 pictures a second."""
    recording = recording_of(swaying_motion(150, seed), f"r{seed}")
    random = torch.Generator().manual_seed(seed)
    points = torch.rand(3000, 3, generator=random) * torch.tensor([6.0, 6.0, 2.0]) - torch.tensor([3.0, 3.0, 0.0])
    points[::2, 2], points[1::2, 0] = 0.0, 1.5
    shown = torch.randn(75, SIZE, generator=random).half()
    camera = CameraStream(
        recording.head.timestamps[::2],
        Camera("pinhole", 8, 6, 4.0, 4.0, 3.5, 2.5),
        torch.eye(3),
        torch.zeros(3),
        embedding=shown,
        embedding_mirrored=-shown,
        embedding_name="egoview-01234567",
    )
    return dataclasses.replace(recording, points=PointCloud(points), camera=camera)


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    store = RecordingStore(tmp_path_factory.mktemp("data"))
    for seed, split in enumerate(("train", "train", "val", "test")):
        store.add(seeing(seed), split=split, config_hash="test")
    return store.root


QUIET = (
    "trainer.accelerator=cpu",
    "trainer.enable_progress_bar=false",
    "callbacks.progress=null",
    "trainer.log_every_n_steps=1",
    "logger.csv.flush_logs_every_n_steps=1",
)


@pytest.fixture(scope="module")
def places(data, tmp_path_factory) -> Path:
    """A voxel autoencoder of two steps."""
    run = tmp_path_factory.mktemp("places") / "run"
    train.main(
        [
            "experiment=voxel_autoencoder",
            f"data.sources.simulated.root={data}",
            "data.sources.cmu=null",
            f"hydra.run.dir={run}",
            "trainer.max_steps=2",
            f"paths.outputs={run.parent}",
            "data.dataset.window=20",
            "data.dataset.content.frames=4",
            "data.loading.batch_size=4",
            "data.loading.steps_per_epoch=2",
            *QUIET,
        ]
    )
    return run / "checkpoints" / "last.ckpt"


def trained(experiment: str, data: Path, places: Path | None, run: Path, *more: str) -> Path:
    train.main(
        [
            f"experiment={experiment}",
            f"data.sources.simulated.root={data}",
            "data.sources.cmu=null",
            "people@data.sources=none",
            "debug=fast",
            f"hydra.run.dir={run}",
            f"paths.outputs={run.parent}",
            "data.dataset.window=60",
            "trainer.precision=32-true",
            *([] if places is None else [f"surroundings.places.checkpoint={places}"]),
            "model.net.transformer.width=32",
            "model.net.transformer.layers=1",
            "model.net.transformer.heads=4",
            "model.net.transformer.feedforward=32",
            *QUIET,
            *more,
        ]
    )
    return run / "checkpoints" / "last.ckpt"


@pytest.fixture(scope="module")
def checkpoint(data, places, tmp_path_factory) -> Path:
    return trained("hmd2", data, places, tmp_path_factory.mktemp("runs") / "run")


@pytest.mark.slow
@pytest.mark.parametrize("experiment", [name for name in EXPERIMENTS if name != "hmd2"])
def test_every_experiment_takes_a_step(experiment, data, places, tmp_path):
    assert trained(experiment, data, places, tmp_path / "run", "callbacks.capture=null").is_file()


def test_the_checkpoint_carries_the_place_encoder_and_its_statistics(checkpoint, places):
    system, _ = load_trained(checkpoint)
    own, given = system.place_encoder.state_dict(), PlaceCodes(places).encoder.state_dict()
    assert all(torch.allclose(own[name], given[name], atol=1e-6) for name in given)
    encoder = system.net.condition_encoder
    for normalizer, size in ((encoder.points.normalizer, 128), (encoder.image.normalizer, SIZE)):
        assert len(normalizer.mean) == size
        assert normalizer.scale.std() > 0
    assert not system.place_encoder.training
    assert not any(parameter.requires_grad for parameter in system.place_encoder.parameters())


@pytest.mark.parametrize("use", ["[]", "[points]", "[images]", "[points,images]"])
def test_one_checkpoint_is_scored_with_any_of_its_senses(checkpoint, data, tmp_path, use):
    evaluate.main(
        [
            f"checkpoint={checkpoint}",
            f"dataset={data}",
            f"pipeline.use={use}",
            "pipeline.sampling.steps=2",
            "seeds=[0]",
            "baselines=false",
            f"hydra.run.dir={tmp_path}",
            f"output={tmp_path}/table.json",
        ]
    )
    table = json.loads((tmp_path / "table.json").read_text())
    assert table["methods"]["wearcap"]["mpjpe_cm"]["mean"] > 1


def test_a_capture_reports_its_conditions(checkpoint, data, tmp_path):
    capture.main(
        [
            f"checkpoint={checkpoint}",
            f"recording={data}/r3",
            f"hydra.run.dir={tmp_path}",
            "pipeline.sampling.steps=2",
            "video=false",
            "body=false",
            "samples=2",
        ]
    )
    first, second = (read_motion(tmp_path / f"sample-{number}.npz") for number in range(2))
    assert torch.equal(read_motion(tmp_path / "motion.npz").R_parent_joint, first.R_parent_joint)
    assert not torch.allclose(second.R_parent_joint, first.R_parent_joint), "another draw"
    assert (tmp_path / "samples.png").stat().st_size > 10_000


def test_windows_and_model_must_see_the_same(data, places, tmp_path):
    with pytest.raises(WearcapError, match="points of 0 and images of 64 features.*Expected 128 and 64"):
        trained("hmd2", data, places, tmp_path / "run", "data.dataset.content.surroundings.places=null")


@pytest.mark.parametrize("surroundings", ["points", "images", "head"])
def test_rows_of_the_ablation_train_by_themselves(surroundings, data, places, tmp_path):
    more = ["callbacks.capture=null", f"surroundings={surroundings}"]
    run = trained("hmd2", data, places if surroundings == "points" else None, tmp_path / "run", *more)
    system = load_trained(run)[0]
    sizes = (system.net.points_size > 0, system.net.image_size > 0)
    assert sizes == (surroundings == "points", surroundings == "images")
    assert system.image_encoder == ("egoview-01234567" if surroundings == "images" else None), "as the data names it"
