"""Exported denoisers agree with eager ones, as networks and as whole pipelines."""

import json
import math
import subprocess
import sys
from dataclasses import replace

import pytest
import torch
from torch import nn

from small_hmd2 import hmd2_of
from wearcap.body.skeleton import xsens23
from wearcap.errors import WearcapError
from wearcap.export import files
from wearcap.export.files import RUN_BY_FORMAT, load_exported, open_exported
from wearcap.geometry import rotation
from wearcap.geometry.camera import Camera
from wearcap.models.layers import TransformerSize
from wearcap.models.voxel_autoencoder import VoxelAutoencoder
from wearcap.recording import CameraStream, HeadStream, PointCloud, Recording
from wearcap.recording.store import RecordingFile, save_recording
from wearcap.runtime.graphs import Graph
from wearcap.systems.hmd2.features import HeadFeatures
from wearcap.systems.hmd2.model import MotionDenoiser
from wearcap.systems.hmd2.pipeline import HMD2
from wearcap.tracking.head_path import head_path

WINDOW, IMAGE = 24, 8
FORMATS = ("onnx", "pt2")


class Toy(nn.Module):
    def __init__(self):
        super().__init__()
        self.linear = nn.Linear(3, 3)

    def forward(self, x, valid):
        return self.linear(x) * valid[..., None]


def toy_example() -> dict[str, torch.Tensor]:
    return {"x": torch.randn(2, 5, 3), "valid": torch.ones(2, 5, dtype=torch.bool)}


@pytest.fixture(scope="module")
def pipeline() -> HMD2:
    """A small pipeline with random weights that do say something, and that listens to everything."""
    torch.manual_seed(0)
    features, places = HeadFeatures(contacts=True, body=True), VoxelAutoencoder(size=16).eval()
    net = MotionDenoiser(
        features.motion_size,
        features.condition_size,
        WINDOW,
        TransformerSize(32, 1, 2, 64, 0.1),
        frames_per_token=2,
        blend=5,
        conditions={"points": places.size, "image": IMAGE},
        self_conditioning=True,
    )
    for parameter in net.parameters():
        nn.init.normal_(parameter, std=0.05)
    size = features.motion_size
    net.motion_normalizer.set(torch.randn(size) * 0.1, torch.rand(size) + 0.5)
    net.condition_encoder.normalizer.set(torch.randn(17) * 0.1, torch.rand(17) + 0.5)
    return hmd2_of(net, features, None, places, "eyes", steps=3, stride=16, guidance=1.5)


@pytest.fixture(scope="module")
def recording() -> Recording:
    frames = 50
    t = torch.arange(frames, dtype=torch.float64) / 60
    position = torch.stack([t, 0.1 * torch.sin(t), 1.6 + 0 * t], -1).float()
    R = rotation.about_axis("z", torch.linspace(0, 1, frames))
    head = HeadStream(t, R, position, torch.eye(3), torch.zeros(3))
    random = torch.Generator().manual_seed(0)
    points = PointCloud(torch.rand(400, 3, generator=random) * 2 - 0.5)
    camera = CameraStream(
        t[10:40:2],
        Camera.pinhole(32, 32, 90.0),
        torch.eye(3),
        torch.zeros(3),
        embedding=torch.randn(15, IMAGE, generator=random),
        embedding_name="eyes",
    )
    return Recording("walk", head=head, points=points, camera=camera, skeleton=xsens23())


@pytest.fixture(scope="module")
def exports(pipeline, tmp_path_factory):
    """The pipeline in both formats, each with its reports."""
    folder = tmp_path_factory.mktemp("export")
    return {
        format: (
            folder / format / f"model.{format}",
            files.write_exports(pipeline.exports(), folder / format / f"model.{format}", format),
        )
        for format in FORMATS
    }


@pytest.mark.parametrize("format", FORMATS)
def test_toy_network_agrees_at_other_batch_sizes(tmp_path, format):
    net = Toy().train()
    report = files.export_network(Graph(net, toy_example()), tmp_path / f"toy.{format}", format, 1e-4)
    assert report.max_abs_error < 1e-6
    assert report.latency_ms > 0
    assert report.bytes == (tmp_path / f"toy.{format}").stat().st_size
    assert net.training  # the caller's network is left as it was
    run = RUN_BY_FORMAT[format](tmp_path / f"toy.{format}")
    inputs = {"x": torch.randn(7, 5, 3), "valid": torch.rand(7, 5) > 0.5}
    torch.testing.assert_close(run(**inputs), net(**inputs))


@pytest.mark.parametrize("format", FORMATS)
def test_pipeline_reports_small_error(exports, format):
    path, reports = exports[format]
    assert set(reports) == {"step", "plan", "conditions", "places"}
    assert all(0 <= report.max_abs_error < 1e-5 for report in reports.values())
    about = json.loads(path.with_suffix(".json").read_text())
    assert about["window"] == WINDOW
    assert len(about["condition_channels"]) == 17
    assert len(about["motion_channels"]) == 140
    assert about["motion_channels"][6] == "l5.xx"


@pytest.mark.parametrize("format", FORMATS)
def test_runner_equals_the_eager_pipeline(pipeline, recording, exports, format):
    eager = pipeline(recording, seed=5)
    motion = load_exported(exports[format][0])(recording, seed=5)
    assert pipeline.sense(recording, head_path(recording, xsens23(), 60.0)).given[..., 0].any()
    torch.testing.assert_close(motion.R_parent_joint, eager.R_parent_joint, atol=1e-4, rtol=0)
    torch.testing.assert_close(motion.t_world_root, eager.t_world_root, atol=1e-4, rtol=0)
    other = load_exported(exports[format][0])(recording, seed=6)
    assert (other.R_parent_joint - eager.R_parent_joint).abs().max() > 1e-2


@pytest.mark.parametrize("format", FORMATS)
def test_runner_has_windows_as_short_as_the_exported_pipeline(pipeline, recording, tmp_path, format):
    short = replace(pipeline, overlap=replace(pipeline.overlap, window=20))
    files.write_exports(short.exports(), tmp_path / f"model.{format}", format)
    loaded = load_exported(tmp_path / f"model.{format}")
    assert loaded.window == 20
    motion, eager = loaded(recording, seed=5), short(recording, seed=5)
    torch.testing.assert_close(motion.R_parent_joint, eager.R_parent_joint, atol=1e-4, rtol=0)
    assert (pipeline(recording, seed=5).R_parent_joint - eager.R_parent_joint).abs().max() > 1e-3


def test_runner_restores_settings(pipeline, exports):
    loaded = load_exported(exports["onnx"][0])
    assert loaded.model.skeleton == pipeline.model.skeleton
    assert loaded.model.features == pipeline.model.features
    assert loaded.model.fps == 60.0
    assert (loaded.sampling, loaded.overlap) == (pipeline.sampling, pipeline.overlap)
    assert (loaded.sampling.steps, loaded.overlap.stride, loaded.sampling.eta) == (3, 16, 1.0)
    assert loaded.model.schedule.offset == pipeline.model.schedule.offset


@pytest.mark.slow
def test_runner_command_needs_neither_lightning_nor_hydra(recording, exports, tmp_path):
    save_recording(recording, tmp_path / "in.safetensors")
    program = (
        "import sys; from wearcap.export.__main__ import main; main(sys.argv[1:]); "
        "assert not {'lightning', 'hydra', 'omegaconf'} & set(sys.modules)"
    )
    model, source, target = exports["onnx"][0], tmp_path / "in.safetensors", tmp_path / "out.safetensors"
    subprocess.run([sys.executable, "-c", program, model, source, target], check=True)
    assert len(RecordingFile(target).load().motion) == 50


class Moody(nn.Module):
    """Says something else when it is traced."""

    def forward(self, x, valid):
        return x + (1 if torch.compiler.is_compiling() else 0)


def test_a_deviating_export_is_refused_and_leaves_nothing(tmp_path):
    with pytest.raises(WearcapError, match="differs from the eager one"):
        files.export_network(Graph(Moody(), toy_example()), tmp_path / "toy.pt2", "pt2", 1e-4)
    assert list(tmp_path.iterdir()) == []


def test_not_a_number_is_refused(tmp_path):
    net = Toy()
    nn.init.constant_(net.linear.weight, math.nan)
    with pytest.raises(WearcapError, match="nan"):
        files.export_network(Graph(net, toy_example()), tmp_path / "toy.pt2", "pt2", 1e-4)
    assert list(tmp_path.iterdir()) == []


def test_missing_library_and_wrong_names_are_reported(tmp_path, monkeypatch):
    with pytest.raises(WearcapError, match="one of onnx, pt2"):
        files.export_network(Graph(Toy(), toy_example()), tmp_path / "toy.tflite", "tflite", 1e-4)
    with pytest.raises(WearcapError, match=r"ends in \.pt2"):
        files.export_network(Graph(Toy(), toy_example()), tmp_path / "toy.onnx", "pt2", 1e-4)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(WearcapError, match=r'onnx.*pip install "wearcap\[export\]"'):
        files.export_network(Graph(Toy(), toy_example()), tmp_path / "toy.onnx", "onnx", 1e-4)


@pytest.mark.parametrize("format", FORMATS)
def test_hostile_model_files_are_named(tmp_path, exports, format, trusted):
    path = tmp_path / f"model.{format}"
    with pytest.raises(WearcapError, match="no such exported model"):
        load_exported(path)
    path.write_bytes(exports[format][0].read_bytes()[:1000])
    with pytest.raises(WearcapError, match="not a readable"):
        open_exported(path)
    path.write_bytes(exports[format][0].read_bytes())
    with pytest.raises(WearcapError, match="no such sidecar"):
        load_exported(path)
    path.with_suffix(".json").write_text("{")
    with pytest.raises(WearcapError, match="not readable JSON"):
        load_exported(path)
    about = json.loads(exports[format][0].with_suffix(".json").read_text())
    about["model"]["sha256"] = "0" * 64
    path.with_suffix(".json").write_text(json.dumps(about))
    with pytest.raises(WearcapError, match="belongs to another model"):
        load_exported(path)
    path.with_suffix(".json").write_text(exports[format][0].with_suffix(".json").read_text())
    with pytest.raises(WearcapError, match="a part of the exported model is missing"):
        load_exported(path)
