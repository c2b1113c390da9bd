"""Refinement of what a network predicts: rotations are smoothed without delay, feet that stand are held, and arms reach
tracked wrists.

Whole recordings and streams run the same `Refiner`, which returns a frame once the `lookahead` frames after it are known.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import ceil
from typing import Any, NamedTuple

import torch
from einops import rearrange, reduce
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from wearcap.body.kinematics import local_rotations, site_positions
from wearcap.body.retarget import reach
from wearcap.body.skeleton import FEET, FOOT_PATCHES, SIDES, WRISTS, Skeleton
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.recording import Motion
from wearcap.recording.timing import joined
from wearcap.tracking.anchor import anchored_to_head
from wearcap.tracking.foot_lock import FootLock, FootState, displacements
from wearcap.tracking.head_path import HeadPath

_REACH = 2.5
"""Half width of the filter in standard deviations."""
_STRAIGHT, _SOFT = 0.97, 0.025
"""Share of a leg's length from which a farther goal is approached ever more slowly, and the share within which."""

FADE_S = 0.25
"""Time (s) within which arms go over to wrists that come into view, and leave those that were lost."""
_SURELY_M = 0.02
"""Displacement (m) of a foot from which a knee that was predicted to bend backwards bends forward."""


class Measured(NamedTuple):
    """What is measured in the frames of a motion."""

    R_world_head: Float[Tensor, "time 3 3"]
    t_world_head: Float[Tensor, "time 3"]
    floor_height: Float[Tensor, "time"]
    """World z (m) of the floor, as far as the system knows it."""
    R_world_wrist: Float[Tensor, "time wrist 3 3"]
    """Orientations of the tracked wrists; none of systems that do not track them."""
    t_world_wrist: Float[Tensor, "time wrist 3"]
    seen: Bool[Tensor, "time wrist"]
    """Where each is tracked; elsewhere its pose is any."""
    given: Bool[Tensor, "time"]
    """Frames whose whole body is given, which stay as they are."""

    @classmethod
    def of(
        cls,
        T_world_head: Rigid,
        floor_height: Float[Tensor, "time"],
        T_world_wrist: Rigid | None = None,
        seen: Bool[Tensor, "time wrist"] | None = None,
    ):
        """Measurements of head, floor and, where they are tracked, wrists (R "time wrist 3 3"; None: everywhere); no body
        is given."""
        count = len(floor_height)
        wrists = T_world_wrist or Rigid(torch.zeros(count, 0, 3, 3), torch.zeros(count, 0, 3))
        seen = torch.ones_like(wrists.t[..., 0], dtype=torch.bool) if seen is None else seen
        given = torch.zeros(count, dtype=torch.bool)
        return cls(T_world_head.R, T_world_head.t, floor_height, wrists.R, wrists.t, seen, given)

    def part(self, frames: slice) -> "Measured":
        """A range of frames."""
        return Measured(*(field[frames] for field in self))


@dataclass(frozen=True)
class Refinement:
    """How predicted motion is refined."""

    smooth: float
    """Standard deviation (frames) of the Gaussian that rotations are averaged with; 0: they stay."""
    feet: FootLock | None
    """How standing feet are held; None: they stay."""
    wrists: bool
    """Whether arms are bent to tracked wrists, where a system has them."""

    @property
    def half_width(self) -> int:
        """Frames to either side that are averaged."""
        return ceil(_REACH * self.smooth)

    @property
    def lookahead(self) -> int:
        """Frames after a frame that must be known: a stream's poses come so much later."""
        return self.half_width + (0 if self.feet is None else self.feet.lookahead)

    @classmethod
    def of(cls, values: Mapping[str, Any] | None) -> "Refinement | None":
        """The refinement of plain values, as `dataclasses.asdict` gives them; None of None."""
        if values is None:
            return None
        feet = values["feet"]
        return cls(**{**values, "feet": None if feet is None else FootLock(**feet)})

    def refined(
        self, motion: Motion, measured: Measured, stretches: Sequence[tuple[int, int]], fps: float, anchored: bool
    ) -> Motion:
        """A whole motion, each stretch (frames from, to) by itself; frames between stretches stay.

        `anchored`: whether the head joint is put where it was measured. Raises WearcapError for contact probabilities
        that are not finite.
        """
        R, t = motion.R_parent_joint.clone(), motion.t_world_root.clone()
        for start, stop in stretches:
            refiner = Refiner(self, motion.skeleton, fps, anchored)
            parts = refiner.push(motion.sliced(start, stop), measured.part(slice(start, stop))) + refiner.finish()
            if (found := joined(parts)) is not None:
                R[start:stop], t[start:stop] = found.R_parent_joint, found.t_world_root
        return replace(motion, R_parent_joint=R, t_world_root=t)


class Refiner:
    """Refines one stretch of motion, piece by piece."""

    def __init__(self, refinement: Refinement | None, skeleton: Skeleton, fps: float, anchored: bool):
        """`refinement` None: motion stays as it is. `anchored`: whether the head joint is put where it was measured."""
        self._refines, self.refinement = refinement is not None, refinement or Refinement(0.0, None, False)
        self.fps, self.anchored = fps, anchored
        has_soles = all(patch in skeleton.sites for patch in FOOT_PATCHES)
        self._feet = self.refinement.feet if has_soles else None
        self._values = torch.zeros(0, 0)
        """Values to be averaged: of frames that are smooth already, as far as later ones need them, and of the others."""
        self._raw: tuple[Motion, Measured] | None = None
        """Frames that are not smooth yet."""
        self._smooth: tuple[Motion, Measured] | None = None
        """Frames that are smooth, but not final."""
        self._states = tuple(FootState() for _ in range(FEET))
        self._wrists: Measured | None = None
        """The last final frames, as far as later ones ask whether wrists were tracked."""

    def push(self, motion: Motion, measured: Measured) -> list[Motion]:
        """Take in the next frames; returns those that are final now, as a list of at most one motion.

        Raises WearcapError for contact probabilities that are not finite.
        """
        if not self._refines:
            return [motion]
        if self._feet is not None and motion.contact_prob is not None and not motion.contact_prob.isfinite().all():
            raise WearcapError("contact probabilities that are NaN or infinite", expected="values from 0 to 1")
        values = rotation.rot6d_from_matrix(motion.R_parent_joint).flatten(-2)
        values = torch.cat([values, motion.t_world_root - measured.t_world_head], -1)
        self._values = torch.cat([self._values.reshape(-1, values.shape[1]), values])
        self._raw = _joined(self._raw, (motion, measured))
        return self._advance(ended=False)

    def finish(self) -> list[Motion]:
        """The remaining frames, after which no others follow, as a list of at most one motion."""
        return self._advance(ended=True)

    def _advance(self, ended: bool) -> list[Motion]:
        if self._raw is not None:
            fresh, self._raw = _split(self._raw, len(self._raw[0]) - (0 if ended else self.refinement.half_width))
            self._smooth = _joined(self._smooth, self._smoothed(fresh)) if fresh else self._smooth
        if self._smooth is None:
            return []
        known = len(self._smooth[0])
        count = known if ended or self._feet is None else known - self._feet.lookahead
        if count <= 0:
            return []
        offsets = self._offsets(*self._smooth, count)
        final, self._smooth = _split(self._smooth, count)
        assert final is not None
        motion, measured = final
        wrists = share = None
        if self.refinement.wrists and measured.t_world_wrist.shape[1]:
            wrists, share = self._reached(measured)
        return [_except_given(with_limbs_bent(motion, offsets, wrists, share), motion, measured.given)]

    def _reached(self, measured: Measured) -> tuple[Rigid, Float[Tensor, "time wrist"] | None]:
        """Where wrists are or were last tracked, and the share by which arms reach there: of the last `FADE_S` in which each was
        tracked, so that it grows and falls as long. None: all by the whole."""
        fade = max(1, round(FADE_S * self.fps))
        before = measured.part(slice(0, 1)) if self._wrists is None else self._wrists
        known = Measured(*(torch.cat(both) for both in zip(before, measured)))
        self._wrists = known.part(slice(-fade, None))
        if known.seen.all():
            return Rigid(measured.R_world_wrist, measured.t_world_wrist), None
        count, whole = len(measured.seen), len(known.seen)
        missing = fade - 1 - (whole - count)
        seen = torch.cat([known.seen[:1].expand(max(0, missing), -1), known.seen]).float()
        share = F.avg_pool1d(seen.T[None], fade, 1)[0].T[-count:]
        last = torch.where(known.seen, torch.arange(whole)[:, None], 0).cummax(0).values[-count:]
        hand = torch.arange(last.shape[1])
        return Rigid(known.R_world_wrist[last, hand], known.t_world_wrist[last, hand]), share

    def _smoothed(self, piece: tuple[Motion, Measured]) -> tuple[Motion, Measured]:
        """The next frames with the average of their neighbours, anchored to the head."""
        motion, measured = piece
        half, count = self.refinement.half_width, len(motion)
        before = len(self._values) - count - (0 if self._raw is None else len(self._raw[0]))
        smooth = motion
        if half:
            shift = torch.arange(-half, half + 1)
            weight = torch.exp(-0.5 * (shift / self.refinement.smooth) ** 2)
            frames = torch.arange(before, before + count)[:, None] + shift
            inside = (frames >= 0) & (frames < len(self._values))
            weights = weight * inside
            weights = weights / weights.sum(1, keepdim=True)
            near = self._values[frames.clamp(0, len(self._values) - 1)]
            mean = torch.einsum("tk,tkv->tv", weights, near)
            R = rotation.matrix_from_rot6d(rearrange(mean[:, :-3], "time (joint six) -> time joint six", six=6))
            smooth = replace(motion, R_parent_joint=R, t_world_root=mean[:, -3:] + measured.t_world_head)
        self._values = self._values[max(before + count - half, 0) :]
        if self.anchored:
            smooth = anchored_to_head(smooth, Rigid(measured.R_world_head, measured.t_world_head))
        return _except_given(smooth, motion, measured.given), measured

    def _offsets(self, motion: Motion, measured: Measured, count: int) -> Float[Tensor, "time foot 3"] | None:
        if self._feet is None or motion.contact_prob is None:
            return None
        points = site_positions(motion.skeleton, motion.T_world_joint, FOOT_PATCHES)
        points = rearrange(points, "time (foot patch) xyz -> time foot patch xyz", foot=FEET)
        prob = reduce(motion.contact_prob, "time (foot patch) -> time foot", "max", foot=FEET)
        offsets, self._states = displacements(
            self._feet, points, prob, measured.floor_height, self.fps, self._states, count
        )
        return offsets


def refined_over(
    refinement: Refinement | None, motion: Motion, measured: Measured, path: HeadPath, fps: float, anchored: bool
) -> Motion:
    """A motion along a path, refined; frames between stretches keep the pose before them, `anchored` at the interpolated
    head. None: it stays."""
    if refinement is None:
        return motion
    motion = refinement.refined(motion, measured, path.stretches, fps, anchored)
    if len(path.stretches) == 1:
        return motion
    frames = torch.cat([torch.arange(start, stop) for start, stop in path.stretches])[path.held_frames]
    held = replace(motion, R_parent_joint=motion.R_parent_joint[frames], t_world_root=motion.t_world_root[frames])
    return anchored_to_head(held, path.T_world_head) if anchored else held


def with_limbs_bent(
    motion: Motion,
    foot_offset: Float[Tensor, "time foot 3"] | None = None,
    T_world_wrist: Rigid | None = None,
    share: Float[Tensor, "time wrist"] | None = None,
) -> Motion:
    """The motion with its ankles moved by an offset in the world (m), hips and knees following, feet turned as before, and
    with both wrists turned as measured, and where they were measured or as near as the arms reach; None: these stay.

    `share`: of the way from where each wrist is to there; None: all of it. Knees bend forward, and a leg never becomes straighter than it can.
    """
    feet_move = foot_offset is not None and bool(foot_offset.any())
    if not feet_move and T_world_wrist is None:
        return motion
    skeleton, T = motion.skeleton, motion.T_world_joint
    if T_world_wrist is not None and share is not None:
        own = skeleton.indices(*WRISTS)
        R = rotation.between(T.R[:, own], T_world_wrist.R, share)
        T_world_wrist = Rigid(R, torch.lerp(T.t[:, own], T_world_wrist.t, share[..., None]))
    limbs: list[_Limbs] = []
    if foot_offset is not None and feet_move:
        limbs.append(_legs(skeleton, T, foot_offset.double()))
    if T_world_wrist is not None:
        limbs.append(_arms(skeleton, T, T_world_wrist.t.double()))
    # All limbs at once, in double precision: the bend of a nearly straight one is the root of a small difference of squares.
    upper, lower, end = ([joint for each in limbs for joint in each.joints[k]] for k in range(3))
    goal, bias, moved = (torch.cat([each[k] for each in limbs], 1) for k in range(1, 4))
    points = (T.t[:, joints].double() for joints in (upper, lower, end))
    R, moved = T.R.clone(), moved[..., None, None]
    for joints, turn in zip((upper, lower), reach(*points, goal, bias)):
        R[:, joints] = torch.where(moved, turn.to(R) @ R[:, joints], R[:, joints])
    if T_world_wrist is not None:
        R[:, skeleton.indices(*WRISTS)] = T_world_wrist.R
    return replace(motion, R_parent_joint=local_rotations(skeleton, R))


class _Limbs(NamedTuple):
    """A pair of limbs, left and right, and where they are to end."""

    joints: tuple[list[int], ...]
    """Indices of hips or shoulders, knees or elbows, and ankles or wrists."""
    goal: Float[Tensor, "time limb 3"]
    bias: Float[Tensor, "time limb 3"]
    """As of `reach` (m)."""
    moved: Bool[Tensor, "time limb"]
    """False where a limb stays as it is."""


def _legs(skeleton: Skeleton, T: Rigid, offset: Float[Tensor, "time foot 3"]) -> _Limbs:
    joints = tuple(skeleton.indices(*(f"{side}_{joint}" for side in SIDES)) for joint in ("hip", "knee", "ankle"))
    start, middle, end = (T.t[:, each].double() for each in joints)
    # The thigh's x axis points forward: the farther a foot is moved, the more surely its knee bends that way.
    forward, distance = T.R[:, joints[0], :, 0].double(), offset.norm(dim=-1, keepdim=True)
    backward = ((torch.lerp(start, end, 0.5) - middle) * forward).sum(-1, keepdim=True).clamp_min(0)
    bias = forward * (distance + backward * (distance / _SURELY_M).clamp_max(1))
    return _Limbs(joints, _within_reach(start, middle, end, end + offset), bias, (offset != 0).any(-1))


def _arms(skeleton: Skeleton, T: Rigid, goal: Float[Tensor, "time wrist 3"]) -> _Limbs:
    sides = [wrist.partition("_")[0] for wrist in WRISTS]
    joints = [skeleton.indices(*(f"{side}_{joint}" for side in sides)) for joint in ("shoulder", "elbow")]
    unbiased, moved = torch.zeros_like(goal), torch.ones(goal.shape[:2], dtype=torch.bool)
    return _Limbs((*joints, skeleton.indices(*WRISTS)), goal, unbiased, moved)


def _within_reach(
    start: Float[Tensor, "*batch 3"],
    middle: Float[Tensor, "*batch 3"],
    end: Float[Tensor, "*batch 3"],
    goal: Float[Tensor, "*batch 3"],
) -> Float[Tensor, "*batch 3"]:
    """The goal, nearer to the hip where the leg would have to be stretched more than it is and more than softly."""
    length = (middle - start).norm(dim=-1) + (end - middle).norm(dim=-1)
    now, wanted = ((point - start).norm(dim=-1) / length for point in (end, goal))
    soft = _STRAIGHT + _SOFT * (1 - torch.exp(-(wanted - _STRAIGHT) / _SOFT))
    share = torch.where(wanted > _STRAIGHT, torch.maximum(torch.minimum(now, wanted), soft), wanted)
    return start + (goal - start) * (share / wanted.clamp_min(1e-9))[..., None]


def _joined(before: tuple[Motion, Measured] | None, new: tuple[Motion, Measured]) -> tuple[Motion, Measured]:
    if before is None:
        return new
    motion = joined([before[0], new[0]])
    assert motion is not None
    return motion, Measured(*(torch.cat(both) for both in zip(before[1], new[1])))


def _split(
    piece: tuple[Motion, Measured], count: int
) -> tuple[tuple[Motion, Measured] | None, tuple[Motion, Measured] | None]:
    """The first `count` frames, and the others; None for no frames."""
    motion, measured = piece
    if count <= 0 or count >= len(motion):
        return (None, piece) if count <= 0 else (piece, None)
    parts = ((0, count), (count, len(motion)))
    return tuple((motion.sliced(*part), measured.part(slice(*part))) for part in parts)  # pyright: ignore[reportReturnType]


def _except_given(changed: Motion, motion: Motion, given: Bool[Tensor, "time"]) -> Motion:
    """The changed motion, with the given frames as they were."""
    if not given.any():
        return changed
    R = torch.where(given[:, None, None, None], motion.R_parent_joint, changed.R_parent_joint)
    return replace(
        changed, R_parent_joint=R, t_world_root=torch.where(given[:, None], motion.t_world_root, changed.t_world_root)
    )
