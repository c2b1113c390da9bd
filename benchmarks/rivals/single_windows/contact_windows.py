"""Training windows of poses with true hand contact."""

import math
from dataclasses import dataclass

import torch
from einops import rearrange
from jaxtyping import Float, Float64
from torch import Tensor

from benchmarks.rivals.single_windows.bodies import OtherPerson
from benchmarks.rivals.single_windows.transforms import Cut, Draws, Window, joint_twins
from benchmarks.rivals.single_windows.windows import Content, Windows, open_recording
from wearcap.errors import WearcapError
from wearcap.recording import Motion
from wearcap.recording.motion import Interactions
from wearcap.recording.store import RecordingFile, RecordingStore
from wearcap.systems.ireplica.features import PoseFeatures, is_even, pose_frames
from wearcap.systems.ireplica.training_windows import ContactWindow


@dataclass(frozen=True)
class PoseNoise:
    """Noise of joint rotations: a random mixture of constant, slow and per-frame noise of at most `largest_deg`."""

    largest_deg: float = 5.0

    def __call__(self, window: Window, random: Draws) -> Window:
        frames, joints = window.values["R_parent_joint"].shape[:2]
        return window.changed(error=self.errors(frames, joints, random.generator))

    def errors(self, frames: int, joints: int, random: torch.Generator) -> Float[Tensor, "time joint 3"]:
        """Rotation vectors (rad) of one window; the slow noise changes within a second."""
        size, *shares = torch.rand(4, generator=random).tolist()
        scale = math.radians(self.largest_deg * size) / math.sqrt(3 * sum(share**2 for share in shares))
        knots = torch.randn(2 + frames // 60, 3 * joints, generator=random)
        place = torch.linspace(0, len(knots) - 1, frames)
        below = place.long().clamp(max=len(knots) - 2)
        slow = torch.lerp(knots[below], knots[below + 1], (place - below)[:, None])
        fixed = torch.randn(1, 3 * joints, generator=random)
        quick = torch.randn(frames, 3 * joints, generator=random)
        error = scale * (shares[0] * fixed + shares[1] * slow + shares[2] * quick)
        return rearrange(error, "time (joint xyz) -> time joint xyz", xyz=3)


@dataclass(frozen=True, eq=False)
class _PoseTrack:
    """An open recording: poses at the windows' rate, and interactions."""

    file: RecordingFile
    timestamps: Float64[Tensor, "time"]
    interactions: Interactions
    converted: Float[Tensor, "time joint 3 3"] | None
    """Poses of another skeleton or rate after conversion; others are read from the file."""


class ContactContent(Content):
    """Windows of poses in the skeleton of a network's input.

    `stream` is "suit" (sensed poses) or "motion" (ground truth). Recordings with the same skeleton and frame rate are
    read from the memory map; others are converted on first use and kept in memory.
    """

    draws = ("shift", "mirror", "speed")

    def __init__(self, features: PoseFeatures, classes: list[str] | tuple[str, ...], fps: float, stream: str = "suit"):
        if stream not in ("suit", "motion"):
            raise WearcapError(f"no stream of poses {stream!r}", expected='"suit" or "motion"')
        self.skeleton, self.classes, self.fps, self.stream = features.skeleton, tuple(classes), fps, stream
        self._twins = {"R_parent_joint": joint_twins(self.skeleton), "contact": [1, 0]}

    def min_frames(self, window: int, stretch: float) -> int:
        return math.ceil(window * stretch) + 1

    def cut(self, track: _PoseTrack, start: int, frames: int, every: int, windows: Windows) -> Cut:
        length, longest = len(track.timestamps), self.min_frames(windows.window, windows.stretch)
        return Cut(start, windows.window, length, windows.stride, latest=length - longest, stretch=windows.stretch)

    def open(self, store: RecordingStore, name: str, every: int, person: OtherPerson | None = None) -> _PoseTrack:
        file = open_recording(store.path_of(name))
        interactions = file.part("interactions")
        if f"{self.stream}.timestamps" not in file.keys or interactions is None:
            missing = "interactions" if interactions is None else self.stream
            what = f"this recording has no {missing}, which contact detection learns from"
            fix = "Prepare a data set with interactions, such as `wearcap prepare simulated_interactions`."
            raise WearcapError(what, where=file.path, fix=fix)
        timestamps = file.tensor(f"{self.stream}.timestamps")
        motion: Motion = file.part(self.stream)
        if is_even(timestamps, self.fps) and motion.skeleton.joint_names == self.skeleton.joint_names:
            return _PoseTrack(file, timestamps, interactions, None)
        timestamps, converted = pose_frames(motion, self.skeleton, self.fps)
        return _PoseTrack(file, timestamps, interactions, converted.contiguous())

    def read(self, track: _PoseTrack, cut: Cut, random: Draws) -> Window:
        start, stop = cut.bounds
        name = f"{self.stream}.R_parent_joint"
        R = track.file.window(name, start, stop) if track.converted is None else track.converted[start:stop]
        origin, place = cut.place
        place = origin + place
        below = place.long().clamp(max=len(track.timestamps) - 2)
        times = torch.lerp(track.timestamps[below], track.timestamps[below + 1], place.double() - below)
        contact = torch.stack([track.interactions.hand_contact(times, each) for each in self.classes], -1)
        values = {"R_parent_joint": cut.take("R_parent_joint", R, start, sensed=True), "contact": contact}
        return Window(values, self._twins)

    def item(self, track: _PoseTrack, cut: Cut, window: Window, random: Draws) -> ContactWindow:
        R = window.values["R_parent_joint"]
        return ContactWindow(R, window.values.get("error", torch.zeros(R.shape[:-1])), window.values["contact"])
