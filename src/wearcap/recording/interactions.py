"""Interactions: which hands hold which object at which time."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

HANDS = ("left", "right")


@dataclass(frozen=True)
class Interactions:
    """Time intervals in which a fixed set of hands holds one object, ordered by start."""

    start_s: Float64[Tensor, "interval"]
    stop_s: Float64[Tensor, "interval"]
    hands: Bool[Tensor, "interval hand"]
    """Whether each of `HANDS` holds the object."""
    objects: tuple[str, ...]
    """Names of the objects in the environment; "" if unknown."""
    classes: tuple[str, ...]
    """Contact class of each interval, of `scene.objects.CONTACT_CLASSES`; "" if unknown."""

    def __len__(self) -> int:
        return len(self.start_s)

    def hand_contact(
        self, timestamps: Float64[Tensor, "time"], contact_class: str | None = None
    ) -> Bool[Tensor, "time hand"]:
        """Whether each hand holds an object (of `contact_class`, if given) at each time (start ≤ t < stop)."""
        times = timestamps[:, None]
        within = (self.start_s <= times) & (times < self.stop_s)
        if contact_class is not None:
            within = within & torch.tensor([name == contact_class for name in self.classes], dtype=torch.bool)
        return (within[..., None] & self.hands).any(1)
