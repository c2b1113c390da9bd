"""Objects rest while nothing touches them: what ECHO says of an object counts in the frames of its contacts (ours)."""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from wearcap.body.contact_points import BODY_POINTS
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.systems.echo.queue import Conditioning, Outputs

INSIDE = 10
"""Frames (at 30 Hz) by which a moment of a contact is away from its beginning and end, where objects are drawn worse."""
FADE = 20
"""Frames over which an object that is touched again comes from where it was left to where it is drawn."""


def is_touched(conditioning: Conditioning, outputs: Outputs, threshold: float) -> Bool[Tensor, "batch frame"]:
    """Whether something touches the active object with this probability, or its pose is observed."""
    touch = outputs.contact_prob[..., :BODY_POINTS].amax(-1) >= threshold
    return conditioning.has_object & (touch | conditioning.is_observed[..., 1])


def _ends(
    touched: Bool[Tensor, "batch frame"],
) -> tuple[Int64[Tensor, "batch frame"], Int64[Tensor, "batch frame"]]:
    """Of the contact that a frame belongs to, the first and the last frame."""
    count = touched.shape[1]
    frames = torch.arange(count).expand(touched.shape)
    start = torch.where(touched & ~F.pad(touched[:, :-1], (1, 0)), frames, 0).cummax(1).values
    stop = torch.where(touched & ~F.pad(touched[:, 1:], (0, 1)), frames, count - 1)
    return start, stop.flip(1).cummin(1).values.flip(1)


def inside(touched: Bool[Tensor, "batch frame"]) -> Bool[Tensor, "batch frame"]:
    """Without the first and last `INSIDE` frames of every contact; of a short one its middle is left. What is touched in
    the very first or last frame is taken to be so before or after it, too."""
    count = touched.shape[1]
    frames, far = torch.arange(count), 2 * count
    start, stop = _ends(touched)
    start, stop = torch.where(start > 0, start, -far), torch.where(stop < count - 1, stop, count + far)
    middle = ((start + stop) // 2).clamp(0, count - 1)
    deepest = torch.minimum(middle - start, stop - middle).clamp_max(INSIDE)
    return touched & (torch.minimum(frames - start, stop - frames) >= deepest)


def with_static_objects(conditioning: Conditioning, outputs: Outputs, threshold: float) -> Outputs:
    """With objects that do not move untouched: each is where it was last touched, before its first time where it will be,
    both `INSIDE` frames within the contact. Where the next contact has it elsewhere, it comes there over `FADE` frames. One
    that nothing touches is left as it is."""
    touched, observed = is_touched(conditioning, outputs, threshold), conditioning.is_observed[..., 1]
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
    return _static(outputs, _taken(R, t, at), _taken(R, t, left), _taken(R, t, found), weight)


def _taken(R: Tensor, t: Tensor, frame: Int64[Tensor, "batch frame"]) -> Rigid:
    return Rigid(R.take_along_dim(frame[..., None, None], 1), t.take_along_dim(frame[..., None], 1))


def _static(
    outputs: Outputs, drawn: Rigid, left: Rigid, found: Rigid, weight: Float[Tensor, "batch frame"]
) -> Outputs:
    """Objects as drawn, shifted and turned by a share of what lies between where they were left and where they are found
    (world axes, about their middles)."""
    turn = rotation.exp(weight[..., None] * rotation.log(left.R @ found.R.mT))
    return outputs._replace(R_world_object=turn @ drawn.R, t_world_object=drawn.t + weight[..., None] * (left.t - found.t))  # fmt: skip


class StaticObjects:
    """Frame by frame, for one lane, nothing known of later ones: an object rests where it was touched last and comes from
    there when it is touched again; before its first contact it is where it is drawn."""

    def __init__(self, threshold: float):
        self.threshold = threshold
        self._last: dict[float, Rigid] = {}
        """Where each object was when it was last touched."""
        self._fading: tuple[float, Rigid, Rigid, int] | None = None
        """What is touched now, where it was left and found, and how many frames ago."""

    def __call__(self, conditioning: Conditioning, outputs: Outputs) -> Outputs:
        """One frame."""
        number, drawn = (
            conditioning.object_number.item(),
            Rigid(outputs.R_world_object, outputs.t_world_object),
        )
        if not conditioning.has_object.item():
            self._fading = None
            return outputs
        if not is_touched(conditioning, outputs, self.threshold).item():
            self._fading = None
            last = self._last.get(number)
            return outputs if last is None else outputs._replace(R_world_object=last.R, t_world_object=last.t)
        if conditioning.is_observed[..., 1].item():
            self._fading = (number, drawn, drawn, 0)
        elif self._fading is None or self._fading[0] != number:
            self._fading = (number, self._last.get(number, drawn), drawn, 0)
        _, left, found, ago = self._fading
        self._fading = (number, left, found, ago + 1)
        static = _static(
            outputs, drawn, left, found, outputs.contact_prob.new_full((1, 1), max(0.0, 1 - ago / FADE))
        )
        self._last[number] = Rigid(static.R_world_object, static.t_world_object)
        return static
