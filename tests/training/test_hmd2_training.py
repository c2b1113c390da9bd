"""HMD² with points and images end to end: every experiment of it trains, and one checkpoint captures with any of them."""

import csv
import dataclasses
import json
import math
from pathlib import Path

import pytest
import torch

from wearcap.cli import capture, evaluate, train
from wearcap.data.surroundings import ConditionWindows, PlaceCodes
from wearcap.errors import WearcapError
from wearcap.export.files import load_exported, write_exports
from wearcap.geometry.camera import Camera
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.formats.motion_npz import read_motion
from wearcap.models.checkpoint import load_trained
from wearcap.recording import CameraStream, PointCloud, Recording, RecordingStore
from wearcap.systems.hmd2.conditions import CONDITIONS, Condition, Sensed
from wearcap.systems.hmd2.pipeline import HMD2, Sampling
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
    wrists = {joint: recording.motion.joint(joint) for joint in ("left_wrist", "right_wrist")}
    tracked = {joint: Trajectory(recording.motion.timestamps, T.R, T.t) for joint, T in wrists.items()}
    return dataclasses.replace(recording, points=PointCloud(points), camera=camera, tracked=tracked)


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
            "data.dataset.window=4",
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
            *([] if places is None else [f"surroundings.windows.points.checkpoint={places}"]),
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
            "video=false",
            "body=false",
            "samples=2",
        ]
    )
    first, second = (read_motion(tmp_path / f"sample-{number}.npz") for number in range(2))
    mean = read_motion(tmp_path / "motion.npz")
    assert mean.provenance["steps"] == "1"
    assert first.provenance["steps"] == "5"
    assert not torch.allclose(mean.R_parent_joint, first.R_parent_joint), "no draw"
    assert not torch.allclose(second.R_parent_joint, first.R_parent_joint), "another draw"
    assert (tmp_path / "samples.png").stat().st_size > 10_000


def test_a_capture_is_refined_by_hps(checkpoint, data, tmp_path):
    found = {}
    for refine in ("none", "hps"):
        folder = tmp_path / refine
        given = [f"checkpoint={checkpoint}", f"recording={data}/r3", f"hydra.run.dir={folder}", f"refine={refine}"]
        capture.main([*given, "video=false", "body=false", "smpl=false"])
        found[refine] = read_motion(folder / "motion.npz")
    energy = json.loads((tmp_path / "hps" / "report.json").read_text())["energy"]
    assert energy[-1]["total"] < energy[0]["total"]
    assert found["hps"].provenance["refine"] == "hps"
    assert "refine" not in found["none"].provenance
    assert not torch.equal(found["hps"].R_parent_joint, found["none"].R_parent_joint)


def test_validation_logs_captures_before_and_after_their_refinement(checkpoint):
    with open(checkpoint.parents[1] / "metrics.csv", newline="") as file:
        logged = {key: float(value) for row in csv.DictReader(file) for key, value in row.items() if value}
    before, after = ({key for key in logged if key.startswith(step)} for step in ("capture/", "refined/"))
    assert "capture/world_mpjpe_cm" in before
    assert {key.replace("capture/", "refined/") for key in before} == after
    assert all(math.isfinite(logged[key]) for key in ("refined/mpjpe_cm", "refined/world_mpjpe_cm"))
    assert logged["capture/jitter_m_s3"] != logged["refined/jitter_m_s3"]
    assert list((checkpoint.parents[1] / "pictures").glob("*.png"))


def test_windows_and_model_must_see_the_same(data, places, tmp_path):
    with pytest.raises(
        WearcapError, match="features {'image': 64, 'hands': 20}.*Expected {'points': 128, 'image': 64, 'hands': 20}"
    ):
        trained("hmd2", data, places, tmp_path / "run", "~data.dataset.content.conditions.points")


@pytest.mark.parametrize("surroundings", ["points", "head"])
def test_rows_of_the_ablation_train_by_themselves(surroundings, data, places, tmp_path):
    more = ["callbacks.capture=null", f"surroundings={surroundings}"]
    run = trained("hmd2", data, places if surroundings == "points" else None, tmp_path / "run", *more)
    system = load_trained(run)[0]
    assert [*system.net.conditions] == {"points": ["points"], "head": []}[surroundings]


def higher_wrist(recording: Recording) -> torch.Tensor:
    """Height (m) of the higher wrist, as tracked, "time 1"."""
    return torch.stack([track.t_world_body[:, 2:] for track in recording.tracked.values()]).amax(0)


class WristHeight(Condition):
    """A condition that HMD² does not have: the height of the higher wrist."""

    use, field = "wrist", "wrist_height"

    def take_all(self, sensed: Sensed, recording: Recording) -> None:
        sensed.values.times = recording.tracked["left_wrist"].timestamps
        sensed.values.values = higher_wrist(recording)


class WristHeights(ConditionWindows):
    size = 1

    def frames(self, store, name):
        height = higher_wrist(store.load(name))
        return torch.stack([height, height], 1), torch.arange(len(height)).int()


def test_a_new_condition_takes_a_class_a_reader_and_a_config(data, tmp_path, monkeypatch):
    """The places of the system's README: it is trained with, captured with and exported."""
    monkeypatch.setitem(CONDITIONS, "wrist", WristHeight)
    windows = f"+surroundings.windows.wrist={{_target_:{__name__}.WristHeights}}"
    given = ["surroundings=head", windows, "+surroundings.network.wrist={size:1,drop:0.5}", "callbacks.capture=null"]
    checkpoint = trained("hmd2", data, None, tmp_path / "run", *given)
    module, _ = load_trained(checkpoint)
    store = RecordingStore.open(data)
    heights = torch.cat([higher_wrist(store.load(name)) for name in store.names("train")])
    normalizer = module.net.condition_encoder.wrist.normalizer
    assert normalizer.mean.item() == pytest.approx(heights.mean().item(), abs=heights.std().item())
    pipeline = HMD2(module.pipeline_parts()["model"], Sampling(steps=2))
    torch.nn.init.normal_(module.net.head.weight, std=0.1)
    recording = store.load("r3")
    motion, without = (system(recording) for system in (pipeline, dataclasses.replace(pipeline, use=[])))
    assert not torch.equal(motion.R_parent_joint, without.R_parent_joint), "it is listened to"
    write_exports(pipeline.exports(), tmp_path / "model.onnx", "onnx")
    assert json.loads((tmp_path / "model.json").read_text())["conditions"]["wrist"]["size"] == 1
    exported = load_exported(tmp_path / "model.onnx")(recording)
    assert torch.allclose(exported.R_parent_joint, motion.R_parent_joint, atol=1e-3)
