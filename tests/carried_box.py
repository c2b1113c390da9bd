"""A walking person who carries boxes beside the wrists, free of measurement errors, and an ECHO with random weights."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from boxes import box_mesh as mesh_between
from walking_person import SEAT, walk
from wearcap.body.skeleton import FOOT_PATCHES, xsens23
from wearcap.diffusion.schedule import CosineSchedule
from wearcap.geometry import rotation
from wearcap.geometry.mesh import Mesh
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.formats.environment import write_environment
from wearcap.models.layers import TransformerSize
from wearcap.recording import ContactTrack, FloorTrack, HeadStream, Recording, RecordingStore
from wearcap.recording.active_objects import true_spans
from wearcap.recording.motion import Interactions
from wearcap.scene.objects import Environment, Freedom, SceneObject
from wearcap.systems.echo.contacts import ContactUse
from wearcap.systems.echo.features import CONTACTS, OBJECT_SIZE, EchoFeatures
from wearcap.systems.echo.model import EchoDenoiser
from wearcap.systems.echo.observations import Scenario
from wearcap.systems.echo.pipeline import Echo, Sampling
from wearcap.systems.echo.queue import EchoModel

WINDOW, FPS = 16, 30.0
CLASSES = ("box", "chair")
HALF, MIDDLE = np.array([0.15, 0.1, 0.05]), np.array([0.04, 0.0, 0.02])
GRIP = Rigid(rotation.exp(torch.tensor([0.2, 0.4, -0.7])), torch.tensor([0.08, 0.0, -0.06]))
"""T_wrist_box."""
CARRIED = (("box_1", "left", 0.4, 1.2),)
"""Box, side, start and stop (s) of its interaction; the box is beside that wrist all the time."""


def box_mesh(half=HALF, middle=MIDDLE) -> Mesh:
    """A box centred on a point `middle` of its own axes (m)."""
    return mesh_between(np.subtract(middle, half), np.add(middle, half))


def scene_object(name: str, category: str = "box", mesh: Mesh | None = None) -> SceneObject:
    return SceneObject(name, category, mesh or box_mesh(), torch.eye(3), torch.zeros(3), Freedom("free"))


def boxes(carried=CARRIED) -> Environment:
    """An environment with the carried boxes; the second one is a chair of another size."""
    names = dict.fromkeys(name for name, *_ in carried)
    return Environment(
        tuple(scene_object(name, CLASSES[k % 2], box_mesh(HALF / (1 + k), MIDDLE * k)) for k, name in enumerate(names))
    )


def carrying(seconds: float = 2.0, name: str = "carry", carried=CARRIED, fps: float = FPS) -> Recording:
    """A walk with boxes."""
    time = torch.arange(int(seconds * fps), dtype=torch.float64) / fps
    motion, contact = walk(time)
    T_world_device = motion.joint("head") @ SEAT
    tracks = {}
    for box, side, *_ in carried:
        T = motion.joint(f"{side}_wrist") @ GRIP
        tracks[box] = Trajectory(time, T.R, T.t)
    start, stop = (torch.tensor([row[k] for row in carried], dtype=torch.float64) for k in (2, 3))
    hands = torch.tensor([[row[1] == "left", row[1] == "right"] for row in carried]).bool().reshape(-1, 2)
    interactions = Interactions(start, stop, hands, tuple(row[0] for row in carried), ("sliding",) * len(carried))
    return Recording(
        name,
        head=HeadStream(time, T_world_device.R, T_world_device.t, SEAT.R, SEAT.t),
        motion=motion,
        contacts=ContactTrack(time, FOOT_PATCHES, contact),
        floor=FloorTrack(time, torch.zeros(len(time))),
        skeleton=motion.skeleton,
        object_motion=tracks,
        interactions=interactions if carried else None,
        subject=f"subject_{name}",
        location="nowhere",
        license="MIT",
    )


def carried_dataset(
    root: Path, splits: Sequence[str] = ("train", "val", "test"), fps: float = FPS, carried=CARRIED
) -> str:
    """One carrying walk per split, with its boxes' file."""
    from dataclasses import replace

    store = RecordingStore(root)
    write_environment(boxes(carried), root / "scene")
    for number, split in enumerate(splits):
        recording = carrying(2.0, f"c{number}", carried, fps)
        store.add(replace(recording, environment="scene/environment.json"), split=split, config_hash="test")
    return str(root)


def small_features(frame: str = "own", **changes) -> EchoFeatures:
    return EchoFeatures(**{"frame": frame, "classes": CLASSES, "shape_size": 0} | changes)


def small_net(features: EchoFeatures, **changes) -> EchoDenoiser:
    """A network with random weights, and statistics with which any output is a valid pose."""
    torch.manual_seed(0)
    sizes = (features.human_size, OBJECT_SIZE, CONTACTS)
    settings = {"window": WINDOW, "transformer": TransformerSize(32, 1, 2, 32, 0.0)}
    net = EchoDenoiser(sizes, features.condition_size, features.object_condition_size, **settings | changes)
    for parameter in net.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    mean, scale = torch.zeros(sum(net.sizes)), torch.full((sum(net.sizes),), 0.5)
    mean[9 : features.human_size] = torch.tensor([1.0, 0, 0, 0, 1.0, 0]).repeat(features.joints - 1)
    scale[net.sizes[0] + OBJECT_SIZE :] = 1.0
    net.motion_normalizer.set(mean, scale)
    return net.eval()


def drawn_echo(frame: str = "own", net=None, features: EchoFeatures | None = None, **settings) -> Echo:
    """A small pipeline with a lookahead of seven frames and without the static-object constraint."""
    features = features or small_features(frame)
    return with_settings(EchoModel(net or small_net(features), features, CosineSchedule(), xsens23()), **settings)


def with_settings(model: EchoModel, kind: type[Echo] = Echo, **settings) -> Echo:
    """A pipeline with settings by name, whichever part of it they belong to."""
    settings = {"context": 8, "per_frame": 1, "static_threshold": None, **settings}
    sampling, use = (
        part(**{name: settings.pop(name) for name in part.__dataclass_fields__ if name in settings})
        for part in (Sampling, ContactUse)
    )
    return kind(model, sampling, use, **settings)


def scenario_of(recording: Recording, carried=CARRIED, margin_s: float = 0.1, **changes) -> Scenario:
    """The scenario of a walk with boxes."""
    spans = tuple(true_spans(recording, margin_s)) if recording.object_motion else ()
    return Scenario(recording, boxes(carried), spans, **changes)
