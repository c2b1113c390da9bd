"""Exported ECHO: the same motion from the file, and files that do not belong together are refused."""

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from subprocess import run

import pytest
import torch

from carried_box import WINDOW, carried_dataset, carrying, drawn_echo, scenario_of, small_features, small_net
from wearcap.body.skeleton import xsens23
from wearcap.diffusion.schedule import CosineSchedule
from wearcap.errors import WearcapError
from wearcap.export.files import load_exported, write_exports
from wearcap.geometry.trajectory import Trajectory
from wearcap.models.point_encoder import PointNeXt
from wearcap.recording.store import RecordingFile
from wearcap.systems.echo.contacts import Guidance
from wearcap.systems.echo.export import condition_channels, motion_channels
from wearcap.systems.echo.pipeline import Echo

FORMATS = ("onnx", "pt2")


def drawn(**settings) -> Echo:
    """A small pipeline with an encoder of objects."""
    features = small_features(shape_size=8)
    torch.manual_seed(1)
    encoder = PointNeXt(4, (6,), (0,), (8,), 0.3).eval()
    net = small_net(features, streams=3, blend=3)
    echo = drawn_echo(net=net, **settings)
    return replace(echo, model=replace(echo.model, features=features, encoder=encoder))


@pytest.fixture(scope="module")
def exports(tmp_path_factory):
    """A pipeline's file in both formats, with its report."""
    folder = tmp_path_factory.mktemp("echo")
    pipeline = drawn(guidance=Guidance(object=2.0))
    return {
        format: write_exports(pipeline.exports(), folder / format / f"net.{format}", format)["step"]
        for format in FORMATS
    }


@pytest.mark.parametrize("format", FORMATS)
def test_the_file_predicts_what_the_network_predicts(exports, format):
    report, eager = exports[format], drawn()
    assert report.max_abs_error < 1e-4
    # Long enough for windows that fill, run and end, and a batch item that ends before the other.
    scenarios = [scenario_of(carrying(1.3)), scenario_of(carrying(0.9))]
    there = load_exported(report.path)
    there = replace(there, contacts=replace(there.contacts, guidance=None))
    for motion, expected in zip(*(echo.capture_scenarios(scenarios, [3, 4]) for echo in (there, eager))):
        torch.testing.assert_close(motion.T_world_joint.t, expected.T_world_joint.t, atol=1e-3, rtol=0)
        torch.testing.assert_close(motion.body_contact_prob, expected.body_contact_prob, atol=1e-3, rtol=0)
        for name, track in (expected.object_motion or {}).items():
            found = (motion.object_motion or {})[name]
            assert isinstance(found, Trajectory)
            torch.testing.assert_close(found.t_world_body, track.t_world_body, atol=1e-3, rtol=0)


def test_the_sidecar_has_everything_else(exports):
    pipeline, there = drawn(guidance=Guidance(object=2.0)), load_exported(exports["pt2"].path)
    assert isinstance(there.model.schedule, CosineSchedule)
    assert (there.model.net.window, there.sampling.context, there.sampling.per_frame) == (WINDOW, 8, 1)
    assert (there.settings(), there.fps, there.model.skeleton) == (pipeline.settings(), 30.0, pipeline.model.skeleton)
    with open(exports["pt2"].path.replace(".pt2", ".json"), encoding="utf-8") as file:
        about = json.load(file)
    assert about["features"]["classes"] == ["box", "chair"]
    assert len(about["condition_channels"]) == pipeline.model.features.condition_size
    assert len(about["object_channels"]) == pipeline.model.features.object_condition_size
    assert len(about["motion_channels"]) == sum(pipeline.model.net.sizes) == len(about["motion_scale"])
    assert about["motion_channels"][3] == "pelvis.xx"


def test_channels_are_named_for_every_frame_of_reference():
    for frame in ("own", "window", "world"):
        for body in (True, False):
            features = small_features(frame, body=body)
            assert len(condition_channels(features)) == features.condition_size
    names = motion_channels(xsens23(), small_features())
    assert names[141 : 141 + 4] == [f"object{entry}" for entry in ("_x", "_y", "_z", ".xx")]


def test_it_runs_without_lightning_and_hydra(exports, tmp_path):
    root = carried_dataset(tmp_path / "data", splits=("test",))
    source = next((tmp_path / "data" / "recordings").glob("*.safetensors"))
    program = (
        "import sys; from wearcap.export.__main__ import main; main(sys.argv[1:]); "
        "assert not {'lightning', 'hydra', 'omegaconf'} & set(sys.modules)"
    )
    run([sys.executable, "-c", program, exports["onnx"].path, source, tmp_path / "out.safetensors"], check=True)
    motion = RecordingFile(tmp_path / "out.safetensors").load().motion
    assert motion is not None, root
    assert len(motion) == 60
    assert set(RecordingFile(tmp_path / "out.safetensors").load().object_motion) == {"box_1"}


def test_what_was_exported_cannot_be_exported_again(exports):
    with pytest.raises(WearcapError, match="exported already"):
        load_exported(exports["pt2"].path).exports()


def test_files_that_do_not_belong_are_refused(exports, tmp_path, trusted):
    path = shutil.copytree(Path(exports["pt2"].path).parent, tmp_path, dirs_exist_ok=True) / "net.pt2"
    sidecar, encoder = tmp_path / "net.json", tmp_path / "net.encoder.safetensors"
    about = json.loads(sidecar.read_text())
    sidecar.write_text(json.dumps(about | {"network": "contact"}))
    with pytest.raises(WearcapError, match="a contact network"):
        load_exported(path)
    sidecar.write_text(json.dumps(about))
    kept = encoder.read_bytes()
    encoder.write_bytes(kept[:-4] + b"\0\1\2\3")
    with pytest.raises(WearcapError, match="belongs to another"):
        load_exported(path)
    encoder.unlink()
    with pytest.raises(WearcapError, match=r"net\.encoder\.safetensors: a part of the exported model is missing"):
        load_exported(path)
    encoder.write_bytes(kept)
    sidecar.unlink()
    with pytest.raises(WearcapError, match="no such sidecar"):
        load_exported(path)


def test_other_schedules_are_refused():
    echo = drawn()
    with pytest.raises(WearcapError, match="cannot be exported"):
        replace(echo, model=replace(echo.model, schedule=lambda level: 1 - level)).exports()
