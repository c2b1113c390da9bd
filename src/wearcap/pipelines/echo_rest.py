"""Objects rest while nothing touches them: what ECHO says of an object counts in the frames of its contacts (ours)."""

import torch
from jaxtyping import Bool
from torch import Tensor

from wearcap.body.contact_points import BODY_POINTS
from wearcap.pipelines.echo_queue import Said, Told


def is_touched(told: Told, said: Said, threshold: float) -> Bool[Tensor, "lane frame"]:
    """Whether something touches the active object with this probability, or its pose is observed."""
    touch = said.contact_prob[..., :BODY_POINTS].amax(-1) >= threshold
    return told.has_object & (touch | told.is_known[..., 1])


def rested(told: Told, said: Said, threshold: float) -> Said:
    """With objects that do not move untouched: each is where it was last touched, before its first time where it will be.
    One that nothing touches is left as it is."""
    touched = is_touched(told, said, threshold)
    active = torch.where(told.has_object, told.object_number, -1.0)
    count = active.shape[1]
    frames = torch.arange(count).expand_as(active)
    at = frames
    for number in active.unique():
        hit = touched & (active == number)
        last, first = torch.where(hit, frames, -1).cummax(1).values, torch.where(hit, frames, count).amin(1)
        beside = torch.where(last >= 0, last, first[:, None])
        at = torch.where((active == number) & (beside < count), beside, at)
    return said._replace(
        R_world_object=said.R_world_object.take_along_dim(at[..., None, None], 1),
        t_world_object=said.t_world_object.take_along_dim(at[..., None], 1),
    )


class Resting:
    """The same frame by frame, for one lane: before its first contact an object is where it is drawn."""

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
