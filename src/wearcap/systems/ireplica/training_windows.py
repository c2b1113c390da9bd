"""Training windows of poses with true hand contact."""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from einops import rearrange
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.data.batch import Batch
from wearcap.data.packing import Track
from wearcap.data.transforms import joint_twins
from wearcap.data.windows import Content
from wearcap.errors import WearcapError
from wearcap.recording import Recording
from wearcap.recording.store import RecordingFile, RecordingStore
from wearcap.systems.ireplica.features import PoseFeatures, is_even, pose_frames


class ContactWindow(NamedTuple):
    """A batch of windows."""

    R_parent_joint: Float[Tensor, "batch time joint 3 3"]
    error: Float[Tensor, "batch time joint 3"]
    """Pose noise as rotation vectors (rad), drawn with the windows so that it depends on seed and step only."""
    contact: Bool[Tensor, "batch time hand class"]


@dataclass(frozen=True)
class PoseNoise:
    """Noise of joint rotations: a random mixture of constant, slow and per-frame noise of at most `largest_deg`."""

    largest_deg: float = 5.0

    def __call__(self, batch: Batch) -> Batch:
        """With rotation vectors (rad) of each window's "error"; the slow noise changes within a second."""
        frames, joints = batch.values["R_parent_joint"].shape[1:3]
        size, *shares = batch.draws.uniform("pose noise", 4, 1, 1).unbind(1)
        scale = math.radians(self.largest_deg) * size / (3 * torch.stack(shares).square().sum(0)).sqrt()
        knots = batch.draws.normal("slow noise", 2 + frames // 60, 3 * joints)
        place = torch.linspace(0, knots.shape[1] - 1, frames, device=batch.device)
        below = place.long().clamp(max=knots.shape[1] - 2)
        slow = torch.lerp(knots[:, below], knots[:, below + 1], (place - below)[:, None])
        fixed, quick = (
            batch.draws.normal("constant noise", 1, 3 * joints),
            batch.draws.normal("noise", frames, 3 * joints),
        )
        error = scale * (shares[0] * fixed + shares[1] * slow + shares[2] * quick)
        return batch.changed(error=rearrange(error, "batch time (joint xyz) -> batch time joint xyz", xyz=3))


class ContactContent(Content):
    """Windows of poses in the skeleton of a network's input.

    `stream` is "suit" (sensed poses) or "motion" (ground truth). Poses of another skeleton or frame rate are converted.
    """

    own_rate = True
    sensed = frozenset({"R_parent_joint"})

    def __init__(self, features: PoseFeatures, classes: list[str] | tuple[str, ...], fps: float, stream: str = "suit"):
        if stream not in ("suit", "motion"):
            raise WearcapError(f"no stream of poses {stream!r}", expected='"suit" or "motion"')
        self.skeleton, self.classes, self.fps, self.stream = features.skeleton, tuple(classes), fps, stream

    def settings(self) -> Any:
        return self.skeleton, self.classes, self.fps, self.stream

    def min_frames(self, window: int, stretch: float) -> int:
        return math.ceil(window * stretch) + 1

    def twins(self, file: RecordingFile) -> dict[str, list[int]]:
        return {"R_parent_joint": joint_twins(self.skeleton), "contact": [1, 0]}

    def track(self, store: RecordingStore, name: str, recording: Recording, every: int) -> Track:
        motion, interactions = getattr(recording, self.stream), recording.interactions
        if motion is None or interactions is None:
            missing = "interactions" if interactions is None else self.stream
            what = f"this recording has no {missing}, which contact detection learns from"
            fix = "Prepare a data set with interactions, such as `wearcap prepare simulated_interactions`."
            raise WearcapError(what, where=store.path_of(name), fix=fix)
        timestamps, R = motion.timestamps, motion.R_parent_joint
        if not is_even(timestamps, self.fps) or motion.skeleton.joint_names != self.skeleton.joint_names:
            timestamps, R = pose_frames(motion, self.skeleton, self.fps)
        contact = torch.stack([interactions.hand_contact(timestamps, each) for each in self.classes], -1)
        return Track({"R_parent_joint": R, "contact": contact})

    def batch(self, batch: Batch) -> ContactWindow:
        R = batch.values["R_parent_joint"]
        error = batch.values.get("error", torch.zeros(R.shape[:-1], device=R.device))
        return ContactWindow(R, error, batch.values["contact"])
