"""Editing of a captured motion within the motion manifold to fit visual cues (MocapEvery §3.4): 2D and 3D keypoints, and
the views of other wearers' cameras, whose recordings share a session name, a clock and a world (φ_T)."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from einops import reduce
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from wearcap.body.skeleton import FEET, FOOT_JOINTS
from wearcap.boundary.arrays import read_npz, require
from wearcap.errors import WearcapError
from wearcap.files import atomic_path
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import nearest_frames
from wearcap.io.formats.motion_npz import read_motion, write_motion
from wearcap.models.checkpoint import load_trained
from wearcap.recording import Motion, Recording
from wearcap.recording.recording import Cue
from wearcap.systems.mocap_every import energy
from wearcap.systems.mocap_every.energy import LatentSolution, LatentSolver, LatentWeights
from wearcap.systems.mocap_every.manifold import MotionManifold, Posed
from wearcap.tracking.anchor import anchor, anchored_to_head

CONFIDENCE = ".confidence.npz"
"""Suffix of the file with a view's confidence, next to the motion's .npz."""


@dataclass(frozen=True, eq=False)
class View:
    """A wearer's pose as observed by another wearer's camera."""

    motion: Motion
    confidence: Float[Tensor, "time joint"]
    """Confidence of each joint, 0…1; 0: not observed."""

    def write(self, path: str | Path) -> None:
        """Write the view as a motion .npz, with its confidence in a file next to it (`CONFIDENCE`)."""
        write_motion(self.motion, path)
        with atomic_path(_confidence_path(path)) as temporary, open(temporary, "wb") as file:
            np.savez(file, confidence=self.confidence.numpy())

    @classmethod
    def read(cls, path: str | Path) -> "View":
        """Read a view in the format of `write`.

        Raises WearcapError when a file is missing or damaged, or when the confidence (0…1) does not match the motion.
        """
        motion, confidence_file = read_motion(path), _confidence_path(path)
        arrays = read_npz(confidence_file, ["confidence"])
        require(arrays, confidence_file, confidence=(len(motion), len(motion.skeleton)))
        confidence = torch.from_numpy(arrays["confidence"]).float()
        if ((confidence < 0) | (confidence > 1)).any():
            raise WearcapError("confidence beyond its range", where=confidence_file, expected="0 to 1")
        return cls(motion, confidence)


def _confidence_path(path: str | Path) -> Path:
    path = Path(path)
    return path.with_name(path.name.removesuffix(".npz") + CONFIDENCE)


@dataclass
class VisualCues:
    """Edits the windows of a motion that have observations; other frames stay as captured."""

    manifold: MotionManifold
    weights: LatentWeights = field(default_factory=LatentWeights)
    solver: LatentSolver = field(default_factory=LatentSolver)
    window: int = 80
    """Window length in frames; windows advance by half of it and are blended."""
    residual: bool = True
    """True: only the change of the decoded motion is added to the capture (ours). False: the decoded motion is the
    result (the paper), which includes the autoencoder's reconstruction error."""
    smooth: float = 2.0
    """Standard deviation (frames) of the Gaussian that smooths the change over time, against jitter from detector
    errors; only with `residual` (ours)."""
    batch: int = 16
    """Number of windows that are optimised together."""

    def edit(
        self, motion: Motion, recording: Recording, T_world_head: Rigid, views: Sequence[View] = ()
    ) -> tuple[Motion, list[LatentSolution]]:
        """Edit a motion by the recording's cues and by other wearers' views; also returns the solution of each batch.

        `T_world_head` holds the measured head poses at the motion's frames.
        """
        cues = [at_frames(cue, motion.timestamps) for cue in recording.cues.values() if cue.joint in motion.skeleton]
        poses = []
        for view in views:  # as `at_frames` takes cues
            nearest, near = _nearest(view.motion.timestamps, motion.timestamps)
            R_parent_joint = view.motion.R_parent_joint[nearest]
            poses.append(energy.PoseCue(R_parent_joint, view.confidence[nearest] * near[:, None]))
        confidence = [cue.confidence for cue in cues] + [pose.confidence.amax(-1) for pose in poses]
        if not confidence or not torch.stack(confidence).any():
            return motion, []
        # First frames of the windows with observations, on a grid of half windows that extends past the motion.
        observed, half = torch.stack(confidence).amax(0) > 0, self.window // 2
        grid = torch.arange(-half, len(observed), half)
        counted = torch.cat([torch.zeros(1, dtype=torch.int64), observed.long().cumsum(0)])
        stop = (grid + self.window).clamp_max(len(observed))
        starts = grid[counted[stop] > counted[grid.clamp_min(0)]]
        edited, solutions = _Blend(motion, self.window), []
        for first in starts.split(self.batch):
            frames = first[:, None] + torch.arange(self.window)
            R, root, solution = self._edit_windows(motion, recording, T_world_head, frames, cues, poses)
            edited.add(frames, R, root)
            solutions.append(solution)
        return anchored_to_head(edited.motion(), T_world_head), solutions

    def _edit_windows(
        self,
        motion: Motion,
        recording: Recording,
        T_world_head: Rigid,
        frames: Int64[Tensor, "window time"],
        cues: list[Cue],
        poses: list[energy.PoseCue],
    ) -> tuple[Tensor, Tensor, LatentSolution]:
        """Optimise the latents of a batch of windows; returns local rotations, root translation and the solution."""
        skeleton = motion.skeleton
        exists = (frames >= 0) & (frames < len(motion))
        frames = frames.clamp(0, len(motion) - 1)
        contact = torch.zeros(len(motion), FEET)
        if motion.contact_prob is not None:  # the maximum over a foot's patches
            contact = reduce(motion.contact_prob, "time (foot patch) -> time foot", "max", foot=FEET)
        window = Posed(motion.R_parent_joint[frames], motion.t_world_root[frames], contact[frames])
        head = Rigid(T_world_head.R[frames], T_world_head.t[frames])
        # Frames outside the capture have confidence 0.
        rows = [(skeleton.index(cue.joint), cue.points[frames], cue.confidence[frames] * exists) for cue in cues]
        places = tuple(energy.PlaceCue(*row) for row in rows if row[1].shape[-1] == 3)
        viewed = tuple(energy.PoseCue(R[frames], confidence[frames] * exists[..., None]) for R, confidence in poses)
        seen = energy.Seen(head, None, None, (), places, viewed)
        if (camera := recording.camera) is not None:
            pixels = tuple(energy.PixelCue(*row) for row in rows if row[1].shape[-1] == 2)
            T_head_cam = Rigid(camera.R_head_cam, camera.t_head_cam)
            seen = energy.Seen(head, camera.camera, T_head_cam, pixels, places, viewed)
        origin = window.origin()
        X0 = window.encode(origin)
        feet = skeleton.indices(*FOOT_JOINTS)
        with torch.no_grad():
            start = self.manifold.encode(X0)
            reconstructed = self.manifold.decode(start)
        # A Gaussian filter over time as a matrix; a standard deviation of 0 is the identity.
        time = torch.arange(self.window, dtype=torch.float32)
        smoothing = torch.exp(-0.5 * ((time[:, None] - time) / max(self.smooth, 1e-3)) ** 2)
        smoothing = smoothing / smoothing.sum(1, keepdim=True)

        def edited(latent: Tensor) -> Tensor:
            decoded = self.manifold.decode(latent)
            return X0 + smoothing @ (decoded - reconstructed) if self.residual else decoded

        def terms(latent: Tensor) -> dict[str, Float[Tensor, "window"]]:
            posed = Posed.decode(edited(latent), origin)
            body = energy.Body(*anchor(skeleton, posed.R_parent_joint, head), window.foot_contact)
            return energy.energy_terms(body, seen, latent - start, feet, motion.fps, self.weights)

        solution = energy.solve_latent(start, terms, self.solver)
        with torch.no_grad():
            posed = Posed.decode(edited(solution.latent), origin)
        return posed.R_parent_joint, posed.t_world_root, solution


class _Blend:
    """Blends overlapping windows with Hann weights; frames without windows stay as captured."""

    def __init__(self, motion: Motion, window: int):
        self._motion, self._weight = motion, torch.hann_window(window, periodic=True)
        self._sums, self._shares = torch.zeros(len(motion), 6 * len(motion.skeleton) + 3), torch.zeros(len(motion))

    def add(self, frames: Tensor, R: Tensor, root: Tensor) -> None:
        """Add windows "window time" at frame numbers, which may extend past the motion."""
        exists = (frames >= 0) & (frames < len(self._shares))
        weight = (self._weight * exists).flatten()
        at = frames.flatten().clamp(0, len(self._shares) - 1)
        values = torch.cat([rotation.rot6d_from_matrix(R).flatten(-2), root], -1).flatten(0, 1)
        self._sums.index_add_(0, at, weight[:, None] * values)
        self._shares.index_add_(0, at, weight)

    def motion(self) -> Motion:
        """The blended motion."""
        motion, left = self._motion, (1 - self._shares).clamp_min(0)[:, None]
        captured = torch.cat([rotation.rot6d_from_matrix(motion.R_parent_joint).flatten(-2), motion.t_world_root], -1)
        blended = (self._sums + left * captured) / (self._shares[:, None] + left)
        R = rotation.matrix_from_rot6d(blended[:, :-3].unflatten(-1, (-1, 6)))
        return replace(motion, R_parent_joint=R, t_world_root=blended[:, -3:])


def _nearest(
    observed: Float64[Tensor, "observation"], timestamps: Float64[Tensor, "time"]
) -> tuple[Int64[Tensor, "time"], Bool[Tensor, "time"]]:
    """Index of the nearest observation to each time, and whether it is within half a frame."""
    nearest = nearest_frames(observed, timestamps)
    step = timestamps.diff().median() if len(timestamps) > 1 else 1.0
    return nearest, (observed[nearest] - timestamps).abs() <= 0.5 * step + 1e-6


def at_frames(cue: Cue, timestamps: Float64[Tensor, "time"]) -> Cue:
    """Resample a cue to a motion's frames: the nearest observation within half a frame, else confidence 0."""
    if not len(cue.timestamps):
        empty = torch.zeros(len(timestamps), cue.points.shape[-1])
        return replace(cue, timestamps=timestamps, points=empty, confidence=torch.zeros(len(timestamps)))
    nearest, near = _nearest(cue.timestamps, timestamps)
    points = cue.points[nearest]
    near &= points.isfinite().all(-1)
    return replace(cue, timestamps=timestamps, points=points.nan_to_num(), confidence=cue.confidence[nearest] * near)


def load_visual_cues(
    manifold: str, weights: LatentWeights | None = None, solver: LatentSolver | None = None, **settings: Any
) -> VisualCues:
    """An editor in the manifold of a checkpoint of experiment=motion_manifold; see `VisualCues` for the settings.

    Raises WearcapError for another checkpoint.
    """
    net = getattr(load_trained(manifold)[0], "net", None)
    if not isinstance(net, MotionManifold):
        expected = "a checkpoint of experiment=motion_manifold"
        raise WearcapError("cues need a motion manifold", where=manifold, expected=expected)
    return VisualCues(net, weights or LatentWeights(), solver or LatentSolver(), **settings)


def capture_session(
    recordings: Sequence[Recording],
    capture: Callable[[Recording], Motion],
    cues: VisualCues,
    views: Mapping[str, Sequence[View]],
) -> dict[str, Motion]:
    """Motion of each recording of a session, by name; `views` holds the views of a recording's wearer by the others.

    `capture` must return motions anchored to the measured head, as the pipelines do. Raises WearcapError for recordings
    that share no session or no time, for views of an unknown recording, and for views with another skeleton.
    """
    for recording in recordings:
        if recording.session is None or recording.session != recordings[0].session:
            expected = f"that of {recordings[0].name}, {recordings[0].session!r}"
            raise WearcapError(f"session {recording.session!r}", where=recording.name, expected=expected)
    if repeated := [name for name, count in Counter(r.name for r in recordings).items() if count > 1]:
        raise WearcapError(f"two recordings are called {repeated[0]!r}", expected="unique names")
    spans = []
    for recording in recordings:
        stream = recording.head or recording.motion
        if stream is None or not len(stream.timestamps):
            what = "neither head poses nor a motion"
            raise WearcapError(what, where=recording.name, expected="at least one of the two")
        spans.append((stream.timestamps[0].item(), stream.timestamps[-1].item()))
    if spans and max(start for start, _ in spans) > min(stop for _, stop in spans):
        what = "recordings of one session at different times"
        raise WearcapError(what, where=recordings[0].session, expected="one clock")
    if unknown := set(views) - {recording.name for recording in recordings}:
        raise WearcapError(f"views of {min(unknown)!r}", expected=f"of {', '.join(r.name for r in recordings)}")
    motions = {}
    for recording in recordings:
        motion, own_views = capture(recording), views.get(recording.name, ())
        for view in own_views:
            if view.motion.skeleton.joint_names != motion.skeleton.joint_names:
                what = f"a view with the joints of {view.motion.skeleton.name}"
                expected = f"those of {motion.skeleton.name}, as captured"
                raise WearcapError(what, where=recording.name, expected=expected)
        motions[recording.name], _ = cues.edit(motion, recording, motion.joint("head"), own_views)
    return motions
