"""iReplica as a validation callback: the current weights drive the tracker, where recordings allow it."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import lightning
import numpy as np
import pytest
import torch

from contact_motion import CLASSES, bending_recording
from wearcap.body.kinematics import site_positions
from wearcap.data.datamodule import Loading, WindowsModule
from wearcap.data.windows import Windows
from wearcap.geometry.camera import Camera
from wearcap.geometry.mesh import Mesh
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.formats.environment import write_environment
from wearcap.recording import CameraStream, Localization, Recording, RecordingStore
from wearcap.runtime.stages import StagedSystem
from wearcap.scene.objects import Environment, Freedom, SceneObject
from wearcap.systems.ireplica.contact_sequence import ContactSequence
from wearcap.systems.ireplica.features import HandViews
from wearcap.systems.ireplica.object_tracker import PALMS, ObjectTracker
from wearcap.systems.ireplica.pipeline import IReplica
from wearcap.systems.ireplica.training import ContactDetection
from wearcap.systems.ireplica.training_windows import ContactContent
from wearcap.systems.ireplica.validation import IReplicaValidation, fit
from wearcap.training.base import Optimization


class TrueMotion(StagedSystem):
    """A registration that knows."""

    name = "truth"

    def __init__(self):
        self.asked: list[str] = []

    def stages(self, source):
        self.asked.append(source.recording.name)
        self.motion = source.recording.motion
        return []

    def motion_of(self, results):
        return self.motion

    def report(self, source, results):
        return {}


def equipped(root: Path, recording: Recording) -> Recording:
    """With a camera, a scene, and one object that was never moved."""
    motion = recording.motion
    assert motion is not None
    head, times = motion.joint("head"), motion.timestamps
    place = site_positions(motion.skeleton, motion.T_world_joint, PALMS)[0, 0]
    mesh = Mesh(
        np.random.default_rng(0).normal(size=(30, 3)).astype(np.float32),
        np.zeros((0, 3), np.int32),
        np.ones(3, np.float32),
    )
    unmoved = SceneObject("object", "table", mesh, torch.eye(3), place, Freedom("plane"))
    write_environment(Environment((unmoved,)), root / "scene")
    (root / "scene/pointcloud.ply").touch()
    return replace(
        recording,
        camera=CameraStream(times, Camera.pinhole(64, 48, 60.0), torch.eye(3), torch.zeros(3)),
        localization=Localization(times, head.R, head.t, torch.ones(len(times))),
        scene="scene/pointcloud.ply",
        object_motion={"object": Trajectory(times[[0, -1]], torch.eye(3).repeat(2, 1, 1), place.repeat(2, 1))},
        environment="scene/environment.json",
    )


def validated(root: Path, registration: TrueMotion) -> dict:
    features = HandViews()
    torch.manual_seed(0)
    module = ContactDetection(
        partial(ContactSequence, width=8), features, list(CLASSES), 60.0, Optimization(torch.optim.Adam)
    )
    content = ContactContent(features, list(CLASSES), 60.0)
    dataset = partial(Windows, content=content, window=120, stride=120, fps=60.0)
    data = WindowsModule(dataset, Loading(4), {"s": {"root": str(root), "weight": 1.0}})
    data.val = data.dataset("val")
    callback = IReplicaValidation(
        partial(IReplica, registration=registration, tracker=ObjectTracker(None)), every_n_epochs=1
    )
    trainer = lightning.Trainer(
        accelerator="cpu",
        callbacks=[callback],
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    trainer.validate(module, datamodule=data, verbose=False)
    return {name: value.item() for name, value in trainer.callback_metrics.items()}


@pytest.mark.parametrize("known", [True, False])
def test_recordings_with_objects_are_tracked_and_others_left_out(known, tmp_path):
    store, registration = RecordingStore(tmp_path), TrueMotion()
    plain = bending_recording(480, "plain")
    full = equipped(tmp_path, bending_recording(480, "full", 1))
    store.add(plain, split="val", config_hash="test")
    if known:
        store.add(full, split="val", config_hash="test")
    logged = validated(tmp_path, registration)
    assert "val/loss" in logged
    assert registration.asked == (["full"] if known else [])
    assert ("ireplica/end_cm" in logged) == known
    assert all(np.isfinite(value) for name, value in logged.items() if name.startswith("ireplica/"))


@pytest.mark.parametrize("missing", ["camera", "environment", "suit", "interactions", "scene", "localization"])
def test_what_lacks_a_part_is_not_fit(missing, tmp_path):
    full = equipped(tmp_path, bending_recording(240, "full"))
    assert fit(full, tmp_path)
    assert not fit(replace(full, **{missing: None}), tmp_path)
    assert not fit(replace(full, object_motion={}), tmp_path)
    assert not fit(full, tmp_path / "elsewhere")
