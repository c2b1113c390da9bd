"""Small recordings for tests, made in milliseconds: a body that sways while it wanders in a circle."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from wearcap.body.skeleton import FOOT_PATCHES, Skeleton, xsens23
from wearcap.data.batch import Batch
from wearcap.geometry import rotation
from wearcap.geometry.camera import Camera
from wearcap.recording import (
    CameraStream,
    ContactTrack,
    FloorTrack,
    HeadStream,
    Localization,
    Motion,
    Recording,
    RecordingStore,
)
from wearcap.runtime.session import Session

PROJECT = Path(__file__).parents[1]


def experiments(*kinds: str) -> list[str]:
    """Names of the experiments, also in sub-folders ("paper/hmd2"), whose files' names begin with one of `kinds`."""
    root = PROJECT / "conf" / "experiment"
    names = (path.relative_to(root).with_suffix("") for path in root.rglob("*.yaml"))
    return sorted(name.as_posix() for name in names if name.name.startswith(kinds))


def swaying_motion(frames: int, seed: int = 0, fps: float = 60.0, skeleton: Skeleton | None = None) -> Motion:
    """Every joint swings with its own phase; the root goes round a circle."""
    skeleton = skeleton or xsens23()
    random = torch.Generator().manual_seed(seed)
    time = torch.arange(frames, dtype=torch.float64) / fps
    phase = 6.3 * torch.rand(len(skeleton), 3, generator=random)
    R = rotation.exp(0.25 * torch.sin(2.0 * time.float()[:, None, None] + phase))
    angle = 0.5 * time.float()
    R[:, 0] = rotation.about_axis("z", angle) @ R[:, 0]
    root = torch.stack([angle.sin(), -angle.cos(), 0 * angle + skeleton.root_height], -1)
    return Motion(time, skeleton, R, root)


def recording_of(motion: Motion, name: str, **about: str) -> Recording:
    """A recording whose device sits exactly 9 cm in front of and above the head joint."""
    offset = torch.tensor([0.09, 0.0, 0.09])
    head = motion.joint("head")
    device = HeadStream(motion.timestamps, head.R, head @ offset, torch.eye(3), offset)
    none = torch.zeros(len(motion), len(FOOT_PATCHES), dtype=torch.bool)
    return Recording(
        name,
        head=device,
        motion=motion,
        contacts=ContactTrack(motion.timestamps, FOOT_PATCHES, none),
        floor=FloorTrack(motion.timestamps, torch.zeros(len(motion))),
        skeleton=motion.skeleton,
        **{"subject": f"subject_{name}", "location": "nowhere", "license": "MIT"} | about,
    )


def small_dataset(root: Path, frames: tuple[int, ...] = (400, 300, 90, 300, 260, 300)) -> RecordingStore:
    """Recordings r0, r1 … dealt to train, train, train, val, test, test; one is shorter than a window."""
    store = RecordingStore(root)
    for index, (count, split) in enumerate(zip(frames, ("train", "train", "train", "val", "test", "test"))):
        store.add(recording_of(swaying_motion(count, index), f"r{index}"), split=split, config_hash="test")
    return store


def suited(root: Path, short: bool = False, **parts) -> Path:
    """A data set of one recording with a suit, a localised camera, and no scan."""
    motion = swaying_motion(90)
    head = motion.joint("head")
    suit = replace(motion, contact_prob=torch.ones(90, 4))
    if short:
        object.__setattr__(suit, "contact_prob", torch.zeros(50, 4))  # the type itself would refuse it here
    camera = CameraStream(motion.timestamps, Camera.pinhole(64, 48, 60.0), torch.eye(3), torch.zeros(3))
    found = Localization(motion.timestamps, head.R, head.t, torch.ones(90))
    sensed = {"suit": suit, "camera": camera, "localization": found} | parts
    RecordingStore(root).add(replace(recording_of(motion, "r"), **sensed), split="test", config_hash="x")
    return root


def pushed(session: Session, samples: list) -> list[Motion | None]:
    """Each wearer's poses after its new samples."""
    session.push(samples)
    return session.poses()


class AlwaysMirrored:
    """A transform that mirrors every window."""

    def cut(self, batch: Batch) -> Batch:
        return replace(batch, mirrored=torch.ones(len(batch.track), dtype=torch.bool))


def window_of(windows: Any, index: int = 0, seed: int = 0) -> Any:
    """One window of a data set, without the batch's axis."""
    batch = windows.batch(torch.tensor([index]), torch.tensor([seed]))
    return type(batch)(*(value[0] for value in batch))


def seeded(windows: Any, index: int, count: int) -> Any:
    """A window of a data set by `count` seeds, as a batch."""
    return windows.batch(torch.full((count,), index), torch.arange(count))
