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
    """With objects that do not move untouched: they are where they were last touched, before the first time in an act
    where they will be. An act in which nothing touches is left as it is."""
    touched = is_touched(told, said, threshold)
    active = torch.where(told.has_object, told.object_number, -1.0)
    count = active.shape[1]
    frames = torch.arange(count).expand_as(active)
    begins = torch.ones_like(touched)
    begins[:, 1:] = active.diff(dim=1) != 0
    begin = torch.where(begins, frames, 0).cummax(1).values
    last = torch.where(touched, frames, -1).cummax(1).values
    upcoming = torch.where(touched, frames, count).flip(1).cummin(1).values.flip(1)
    later = upcoming.clamp_max(count - 1)
    same_act = (upcoming < count) & (begin.gather(1, later) == begin)
    at = torch.where(last >= begin, last, torch.where(same_act, later, frames))
    return said._replace(
        R_world_object=said.R_world_object.take_along_dim(at[..., None, None], 1),
        t_world_object=said.t_world_object.take_along_dim(at[..., None], 1),
    )


class Resting:
    """The same frame by frame, for one lane: before an act's first contact the object is where it is drawn."""

    def __init__(self, threshold: float):
        self.threshold = threshold
        self._number = -1.0
        self._last: Said | None = None

    def __call__(self, told: Told, said: Said) -> Said:
        """One frame."""
        number = told.object_number.item() if told.has_object.item() else -1.0
        if number != self._number:
            self._number, self._last = number, None
        if is_touched(told, said, self.threshold).item():
            self._last = said
        if self._last is None:
            return said
        return said._replace(R_world_object=self._last.R_world_object, t_world_object=self._last.t_world_object)  # fmt: skip
