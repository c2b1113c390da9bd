"""Recordings in which a bent elbow means that the hand holds something: a table's edge or, with the arm raised, a door."""

from dataclasses import replace
from pathlib import Path

import torch

from wearcap.body.skeleton import Skeleton, xsens23
from wearcap.geometry import rotation
from wearcap.recording import Motion, Recording, RecordingStore
from wearcap.recording.motion import Interactions
from wearcap_testing import recording_of, swaying_motion

CLASSES = ("sliding", "hinged")


def bending(frames: int, seed: int = 0, skeleton: Skeleton | None = None) -> tuple[Motion, Interactions]:
    """A swaying body whose elbows bend, one hand at a time, for a second in every two."""
    motion = swaying_motion(frames, seed, skeleton=skeleton or xsens23())
    random = torch.Generator().manual_seed(seed)
    start = 0.5 + 2.0 * torch.arange(max(0, (frames + 30) // 120), dtype=torch.float64)
    hand = torch.randint(2, (len(start),), generator=random)
    kind = torch.randint(2, (len(start),), generator=random)
    R = motion.R_parent_joint.clone()
    for s, h, k in zip(start.tolist(), hand.tolist(), kind.tolist()):
        side, sign = ("left", "right")[h], (1.0, -1.0)[h]
        rise = ((motion.timestamps - s) / 0.1).clamp(0, 1) * ((s + 1.0 - motion.timestamps) / 0.1).clamp(0, 1)
        elbow, shoulder = motion.skeleton.indices(f"{side}_elbow", f"{side}_shoulder")
        R[:, elbow] = R[:, elbow] @ rotation.about_axis("z", -1.4 * sign * rise.float())
        R[:, shoulder] = R[:, shoulder] @ rotation.about_axis("x", 1.2 * k * sign * rise.float())
    interactions = Interactions(
        start,
        start + 1.0,
        torch.nn.functional.one_hot(hand, 2).bool(),
        ("object",) * len(start),
        tuple(CLASSES[k] for k in kind.tolist()),
    )
    return replace(motion, R_parent_joint=R), interactions


def bending_recording(frames: int, name: str, seed: int = 0) -> Recording:
    motion, interactions = bending(frames, seed)
    return replace(recording_of(motion, name), suit=motion, interactions=interactions)


def bending_dataset(root: Path, frames: int = 900, train: int = 3) -> RecordingStore:
    """Recordings b0, b1 …, some to train and the last one to validate."""
    store = RecordingStore(root)
    for seed, split in enumerate(("train",) * train + ("val",)):
        store.add(bending_recording(frames, f"b{seed}", seed), split=split, config_hash="test")
    return store
