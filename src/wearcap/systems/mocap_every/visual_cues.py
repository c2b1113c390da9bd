"""Editing of a captured motion within the motion manifold to fit visual cues (MocapEvery §3.4)."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from wearcap.body.skeleton import FEET, FOOT_JOINTS, Skeleton
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import nearest_frames
from wearcap.models.checkpoint import load_trained
from wearcap.recording import Motion, Recording
from wearcap.recording.recording import Cue
from wearcap.systems.mocap_every.energy import (
    Body,
    LatentSolution,
    LatentSolver,
    LatentWeights,
    PixelCue,
    PlaceCue,
    PoseCue,
    Seen,
    anchored_body,
    energy_terms,
    solve_latent,
)
from wearcap.systems.mocap_every.manifold import MotionManifold
from wearcap.systems.mocap_every.manifold_features import Posed, decode_window, encode_window, origin_of
from wearcap.tracking.anchor import anchored_to_head


@dataclass(frozen=True, eq=False)
class View:
    """A wearer's pose as observed by another wearer's camera."""

    motion: Motion
    confidence: Float[Tensor, "time joint"]
    """Confidence of each joint, 0…1; 0: not observed."""


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
        views = [view_at_frames(view, motion.timestamps) for view in views]
        confidence = [cue.confidence for cue in cues] + [view.confidence.amax(-1) for view in views]
        if not confidence or not torch.stack(confidence).any():
            return motion, []
        starts = self._starts(torch.stack(confidence).amax(0) > 0)
        edited, solutions = _Blend(motion, self.window), []
        for first in starts.split(self.batch):
            frames = first[:, None] + torch.arange(self.window)
            R, root, solution = self._edit_windows(motion, recording, T_world_head, frames, cues, views)
            edited.add(frames, R, root)
            solutions.append(solution)
        return anchored_to_head(edited.motion(), T_world_head), solutions

    def _starts(self, observed: Tensor) -> Int64[Tensor, "window"]:
        """First frames of the windows with observations, on a grid of half windows that extends past the motion."""
        half = self.window // 2
        grid = torch.arange(-half, len(observed), half)
        counted = torch.cat([torch.zeros(1, dtype=torch.int64), observed.long().cumsum(0)])
        stop = (grid + self.window).clamp_max(len(observed))
        return grid[counted[stop] > counted[grid.clamp_min(0)]]

    def _edit_windows(
        self,
        motion: Motion,
        recording: Recording,
        T_world_head: Rigid,
        frames: Int64[Tensor, "window time"],
        cues: list[Cue],
        views: list[View],
    ) -> tuple[Tensor, Tensor, LatentSolution]:
        """Optimise the latents of a batch of windows; returns local rotations, root translation and the solution."""
        skeleton = motion.skeleton
        exists = (frames >= 0) & (frames < len(motion))
        frames = frames.clamp(0, len(motion) - 1)
        window = Posed(motion.R_parent_joint[frames], motion.t_world_root[frames], _foot_contact(motion)[frames])
        head = Rigid(T_world_head.R[frames], T_world_head.t[frames])
        seen = _observations(recording, skeleton, head, frames, exists, cues, views)
        origin = origin_of(window)
        X0 = encode_window(window, origin)
        feet = skeleton.indices(*FOOT_JOINTS)
        with torch.no_grad():
            start = self.manifold.encode(X0)
            reconstructed = self.manifold.decode(start)

        smoothing = _gaussian_filter(self.window, self.smooth)

        def edited(latent: Tensor) -> Tensor:
            decoded = self.manifold.decode(latent)
            return X0 + smoothing @ (decoded - reconstructed) if self.residual else decoded

        def body(latent: Tensor) -> Body:
            posed = decode_window(edited(latent), origin)
            return anchored_body(skeleton, posed.R_parent_joint, window.foot_contact, head)

        solution = solve_latent(
            start, lambda z: energy_terms(body(z), seen, z - start, feet, motion.fps, self.weights), self.solver
        )
        with torch.no_grad():
            posed = decode_window(edited(solution.latent), origin)
        return posed.R_parent_joint, posed.t_world_root, solution


def _gaussian_filter(window: int, frames: float) -> Float[Tensor, "time time"]:
    """Matrix of a Gaussian filter over time, with a standard deviation in frames; 0: identity."""
    time = torch.arange(window, dtype=torch.float32)
    weight = torch.exp(-0.5 * ((time[:, None] - time) / max(frames, 1e-3)) ** 2)
    return weight / weight.sum(1, keepdim=True)


class _Blend:
    """Blends overlapping windows with Hann weights; frames without windows stay as captured."""

    def __init__(self, motion: Motion, window: int):
        self._motion = motion
        self._weight = torch.hann_window(window, periodic=True)
        self._rotations = torch.zeros(len(motion), 6 * len(motion.skeleton))
        self._roots, self._shares = torch.zeros(len(motion), 3), torch.zeros(len(motion))

    def add(self, frames: Tensor, R: Tensor, root: Tensor) -> None:
        """Add windows "window time" at frame numbers, which may extend past the motion."""
        exists = (frames >= 0) & (frames < len(self._shares))
        weight = (self._weight * exists).flatten()
        at = frames.flatten().clamp(0, len(self._shares) - 1)
        self._rotations.index_add_(0, at, weight[:, None] * rotation.rot6d_from_matrix(R).flatten(-2).flatten(0, 1))
        self._roots.index_add_(0, at, weight[:, None] * root.flatten(0, 1))
        self._shares.index_add_(0, at, weight)

    def motion(self) -> Motion:
        """The blended motion."""
        motion = self._motion
        left = (1 - self._shares).clamp_min(0)[:, None]
        whole = self._shares[:, None] + left
        turned = self._rotations + left * rotation.rot6d_from_matrix(motion.R_parent_joint).flatten(-2)
        R = rotation.matrix_from_rot6d((turned / whole).unflatten(-1, (-1, 6)))
        return replace(motion, R_parent_joint=R, t_world_root=(self._roots + left * motion.t_world_root) / whole)


def at_frames(cue: Cue, timestamps: Float64[Tensor, "time"]) -> Cue:
    """Resample a cue to a motion's frames: the nearest observation within half a frame, else confidence 0."""
    if not len(cue.timestamps):
        empty = torch.zeros(len(timestamps), cue.points.shape[-1])
        return replace(cue, timestamps=timestamps, points=empty, confidence=torch.zeros(len(timestamps)))
    nearest = nearest_frames(cue.timestamps, timestamps)
    step = timestamps.diff().median() if len(timestamps) > 1 else 1.0
    points = cue.points[nearest]
    near = ((cue.timestamps[nearest] - timestamps).abs() <= 0.5 * step + 1e-6) & points.isfinite().all(-1)
    return replace(cue, timestamps=timestamps, points=points.nan_to_num(), confidence=cue.confidence[nearest] * near)


def view_at_frames(view: View, timestamps: Float64[Tensor, "time"]) -> View:
    """Resample a view to a motion's frames, as `at_frames` does."""
    nearest = nearest_frames(view.motion.timestamps, timestamps)
    step = timestamps.diff().median() if len(timestamps) > 1 else 1.0
    near = (view.motion.timestamps[nearest] - timestamps).abs() <= 0.5 * step + 1e-6
    motion = replace(
        view.motion,
        timestamps=timestamps,
        R_parent_joint=view.motion.R_parent_joint[nearest],
        t_world_root=view.motion.t_world_root[nearest],
        contact_prob=None,
        hand_contact_prob=None,
        body_contact_prob=None,
        object_motion=None,
    )
    return View(motion, view.confidence[nearest] * near[:, None])


def _observations(
    recording: Recording,
    skeleton: Skeleton,
    head: Rigid,
    frames: Tensor,
    exists: Tensor,
    cues: list[Cue],
    views: list[View],
) -> Seen:
    """Observations of a batch of windows; frames outside the capture have confidence 0."""
    camera = recording.camera
    cues_2d, cues_3d = ([cue for cue in cues if cue.points.shape[-1] == axes] for axes in (2, 3))
    pixels = (
        tuple(PixelCue(skeleton.index(c.joint), c.points[frames], c.confidence[frames] * exists) for c in cues_2d)
        if camera
        else ()
    )
    places = tuple(PlaceCue(skeleton.index(c.joint), c.points[frames], c.confidence[frames] * exists) for c in cues_3d)
    poses = tuple(PoseCue(v.motion.R_parent_joint[frames], v.confidence[frames] * exists[..., None]) for v in views)
    mount = None if camera is None else Rigid(camera.R_head_cam, camera.t_head_cam)
    return Seen(head, None if camera is None else camera.camera, mount, pixels, places, poses)


def _foot_contact(motion: Motion) -> Float[Tensor, "time foot"]:
    """Contact probability of each foot, the maximum over its patches."""
    if motion.contact_prob is None:
        return torch.zeros(len(motion), FEET)
    return motion.contact_prob.unflatten(-1, (FEET, -1)).amax(-1)


def load_visual_cues(
    manifold: str, weights: LatentWeights | None = None, solver: LatentSolver | None = None, **settings: Any
) -> VisualCues:
    """An editor in the manifold of a checkpoint of experiment=motion_manifold; see `VisualCues` for the settings.

    Raises WearcapError for another checkpoint.
    """
    net = getattr(load_trained(manifold)[0], "net", None)
    if not isinstance(net, MotionManifold):
        raise WearcapError(
            "cues need a motion manifold", where=manifold, expected="a checkpoint of experiment=motion_manifold"
        )
    return VisualCues(net, weights or LatentWeights(), solver or LatentSolver(), **settings)
