"""Static-object constraint (ours): an object moves only in frames with contact; elsewhere its pose is constant."""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from wearcap.body.contact_points import BODY_POINTS
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.systems.echo.queue import Conditioning, Outputs

INSIDE = 10
"""Frames (at 30 Hz) to trim from both ends of a contact, where predicted object poses are less accurate."""
FADE = 20
"""Frames over which an object that is touched again blends from its static pose to its predicted pose."""


def _is_touched(conditioning: Conditioning, outputs: Outputs, threshold: float) -> Bool[Tensor, "batch frame"]:
    """Whether a contact probability on the active object reaches the threshold, or the object's pose is observed."""
    touch = outputs.contact_prob[..., :BODY_POINTS].amax(-1) >= threshold
    return conditioning.has_object & (touch | conditioning.is_observed[..., 1])


def _ends(touched: Bool[Tensor, "batch frame"]) -> tuple[Int64[Tensor, "batch frame"], Int64[Tensor, "batch frame"]]:
    """First and last frame of the contact that each frame belongs to."""
    count = touched.shape[1]
    frames = torch.arange(count).expand(touched.shape)
    start = torch.where(touched & ~F.pad(touched[:, :-1], (1, 0)), frames, 0).cummax(1).values
    stop = torch.where(touched & ~F.pad(touched[:, 1:], (0, 1)), frames, count - 1)
    return start, stop.flip(1).cummin(1).values.flip(1)


def inside(touched: Bool[Tensor, "batch frame"]) -> Bool[Tensor, "batch frame"]:
    """Contacts without their first and last `INSIDE` frames; of a short contact the middle remains. Contacts at the
    first or last frame count as continuing beyond it."""
    count = touched.shape[1]
    frames, far = torch.arange(count), 2 * count
    start, stop = _ends(touched)
    start, stop = torch.where(start > 0, start, -far), torch.where(stop < count - 1, stop, count + far)
    middle = ((start + stop) // 2).clamp(0, count - 1)
    deepest = torch.minimum(middle - start, stop - middle).clamp_max(INSIDE)
    return touched & (torch.minimum(frames - start, stop - frames) >= deepest)


def with_static_objects(conditioning: Conditioning, outputs: Outputs, threshold: float) -> Outputs:
    """Outputs in which untouched objects are static: at their pose in the last contact or, before their first
    contact, at its pose, both `INSIDE` frames within the contact. At the start of the next contact an object blends
    to its predicted pose over `FADE` frames. Objects without any contact are unchanged."""
    touched, observed = _is_touched(conditioning, outputs, threshold), conditioning.is_observed[..., 1]
    active = torch.where(conditioning.has_object, conditioning.object_number, -1.0)
    count = active.shape[1]
    frames = torch.arange(count).expand_as(active)
    at, left, found, weight = frames, frames, frames, torch.zeros_like(active)
    for number in active.unique():
        mine = active == number
        hit = inside(touched & mine) | (observed & mine)
        last, first = torch.where(hit, frames, -1).cummax(1).values, torch.where(hit, frames, count).amin(1)
        beside = torch.where(last >= 0, last, first[:, None])
        at = torch.where(mine & (beside < count), beside, at)
        begin, end = _ends(hit)
        before = F.pad(last[:, :-1], (1, 0), value=-1).take_along_dim(begin, 1)
        seen = torch.where(observed & mine, frames, -1).cummax(1).values >= begin
        fades = hit & (before >= 0) & (frames < end) & ~seen
        left, found = torch.where(fades, before, left), torch.where(fades, begin, found)
        share = 1 - (frames - begin) / (end - begin).clamp(1, FADE)
        weight = torch.where(fades, share.clamp_min(0), weight)
    R, t = outputs.R_world_object, outputs.t_world_object
    predicted, left, found = (
        Rigid(R.take_along_dim(frame[..., None, None], 1), t.take_along_dim(frame[..., None], 1))
        for frame in (at, left, found)
    )
    return _static(outputs, predicted, left, found, weight)


def _static(
    outputs: Outputs, predicted: Rigid, left: Rigid, found: Rigid, weight: Float[Tensor, "batch frame"]
) -> Outputs:
    """Predicted object poses, corrected by the share `weight` of the difference between the static pose (`left`) and
    the predicted pose at the contact's start (`found`); rotation in world axes about the centre."""
    turn = rotation.exp(weight[..., None] * rotation.log(left.R @ found.R.mT))
    return outputs._replace(
        R_world_object=turn @ predicted.R, t_world_object=predicted.t + weight[..., None] * (left.t - found.t)
    )


class StaticObjects:
    """The causal static-object constraint, frame by frame for one batch item: an untouched object keeps its last
    touched pose and blends from it when touched again; before its first contact it is unchanged."""

    def __init__(self, threshold: float):
        self.threshold = threshold
        self._last: dict[float, Rigid] = {}
        """Pose of each object in its last frame with contact, by object number."""
        self._fading: tuple[float, Rigid, Rigid, int] | None = None
        """The object in contact, its static pose, its predicted pose at the contact's start, and frames since then."""

    def __call__(self, conditioning: Conditioning, outputs: Outputs) -> Outputs:
        """Outputs of one frame with static objects."""
        number, predicted = (conditioning.object_number.item(), Rigid(outputs.R_world_object, outputs.t_world_object))
        if not conditioning.has_object.item():
            self._fading = None
            return outputs
        if not _is_touched(conditioning, outputs, self.threshold).item():
            self._fading = None
            last = self._last.get(number)
            return outputs if last is None else outputs._replace(R_world_object=last.R, t_world_object=last.t)
        if conditioning.is_observed[..., 1].item():
            self._fading = (number, predicted, predicted, 0)
        elif self._fading is None or self._fading[0] != number:
            self._fading = (number, self._last.get(number, predicted), predicted, 0)
        _, left, found, ago = self._fading
        self._fading = (number, left, found, ago + 1)
        weight = outputs.contact_prob.new_full((1, 1), max(0.0, 1 - ago / FADE))
        static = _static(outputs, predicted, left, found, weight)
        self._last[number] = Rigid(static.R_world_object, static.t_world_object)
        return static
