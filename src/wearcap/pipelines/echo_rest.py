"""Objects rest while nothing touches them: what ECHO says of an object counts in the frames of its contacts (ours)."""

import torch
from jaxtyping import Bool
from torch import Tensor

from wearcap.body.contact_points import BODY_POINTS
from wearcap.pipelines.echo_queue import Said, Told

INSIDE = 10
"""Frames (at 30 Hz) by which a moment of a contact is away from its beginning and end, where objects are drawn worse."""


def is_touched(told: Told, said: Said, threshold: float) -> Bool[Tensor, "lane frame"]:
    """Whether something touches the active object with this probability, or its pose is observed."""
    touch = said.contact_prob[..., :BODY_POINTS].amax(-1) >= threshold
    return told.has_object & (touch | told.is_known[..., 1])


def inside(touched: Bool[Tensor, "lane frame"]) -> Bool[Tensor, "lane frame"]:
    """Without the first and last `INSIDE` frames of every contact; of a short one its middle is left. What is touched in
    the very first or last frame is taken to be so before or after it, too."""
    count = touched.shape[1]
    frames, far = torch.arange(count).expand(touched.shape), 2 * count
    begins = touched & ~torch.cat([touched[:, :1], touched[:, :-1]], 1)
    ends = touched & ~torch.cat([touched[:, 1:], touched[:, -1:]], 1)
    start = torch.where(begins, frames, -far).cummax(1).values
    stop = torch.where(ends, frames, count + far).flip(1).cummin(1).values.flip(1)
    middle = ((start + stop) // 2).clamp(0, count - 1)
    deepest = torch.minimum(middle - start, stop - middle).clamp_max(INSIDE)
    return touched & (torch.minimum(frames - start, stop - frames) >= deepest)


def rested(told: Told, said: Said, threshold: float) -> Said:
    """With objects that do not move untouched: each is where it was last touched, before its first time where it will be;
    within a contact, `INSIDE` frames from its ends. One that nothing touches is left as it is."""
    touched = is_touched(told, said, threshold)
    active = torch.where(told.has_object, told.object_number, -1.0)
    count = active.shape[1]
    frames = torch.arange(count).expand_as(active)
    at = frames
    for number in active.unique():
        mine = active == number
        hit = inside(touched & mine) | (told.is_known[..., 1] & mine)
        last, first = torch.where(hit, frames, -1).cummax(1).values, torch.where(hit, frames, count).amin(1)
        beside = torch.where(last >= 0, last, first[:, None])
        at = torch.where(mine & (beside < count), beside, at)
    return said._replace(
        R_world_object=said.R_world_object.take_along_dim(at[..., None, None], 1),
        t_world_object=said.t_world_object.take_along_dim(at[..., None], 1),
    )


class Resting:
    """Frame by frame, for one lane, nothing known of later ones: an object rests where it was touched last, and before its
    first contact it is where it is drawn."""

    def __init__(self, threshold: float):
        self.threshold = threshold
        self._last: dict[float, Said] = {}
        """What was said of each object when it was last touched."""

    def __call__(self, told: Told, said: Said) -> Said:
        """One frame."""
        number = told.object_number.item()
        if is_touched(told, said, self.threshold).item():
            self._last[number] = said
        if not told.has_object.item() or number not in self._last:
            return said
        last = self._last[number]
        return said._replace(R_world_object=last.R_world_object, t_world_object=last.t_world_object)
