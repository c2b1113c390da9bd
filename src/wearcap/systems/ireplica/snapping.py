"""Contact-based corrections of the wearer's path: as documented, and ours (thesis §5.3.1)."""

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.optimize.contact_correction import OffsetSettings, bend_contacts, offset_for
from wearcap.optimize.trajectory import BentPath
from wearcap.recording import Motion
from wearcap.scene.objects import SceneObject
from wearcap.systems.ireplica.attachment import Held
from wearcap.systems.ireplica.contact_intervals import ContactInterval

FIT_FRAMES = 60
"""Of an arc, evenly spread, are fitted: more tell no more."""


@dataclass(frozen=True)
class HingeFit:
    """How far a hand's path about a hinge is trusted to tell where the wearer is (standard deviations)."""

    radius_m: float = 0.015
    """Of the hand's distance from the hinge, from frame to frame."""
    touch_m: float = 0.03
    """Of the hand from the object's surface when it is taken, along the surface's normal."""
    place_m: float = 0.06
    """Of the wearer's place."""
    iterations: int = 6


class _Targets:
    """What both corrections gather: an offset (m) and a weight for each frame."""

    def start(self, palms_world: Float[Tensor, "time hand 3"], motion: Motion) -> None:
        self._palms, self._timestamps = palms_world, motion.timestamps
        self._path = motion.t_world_root[:, :2].double()
        self._targets = palms_world.new_zeros(len(palms_world), 2)
        self._weights = palms_world.new_zeros(len(palms_world))


@dataclass(eq=False)
class BendCorrection(_Targets):
    """The document's: the path is bent once more, with the touched point as the only control point (eq. 5.2)."""

    bend: Callable[..., BentPath]
    """`optimize.trajectory.bend` with its settings and solver."""
    transition_s: float = 1.5

    def offset(
        self,
        contact: ContactInterval,
        thing: SceneObject,
        points_world: Float[Tensor, "hand 3"],
        goes_on: bool,
    ) -> Float[Tensor, "frame 2"]:
        frames, hands = slice(contact.start, contact.stop), torch.tensor(contact.hands)
        shift = (points_world[hands] - self._palms[contact.start, hands])[:, :2].mean(0)
        self._targets[frames], self._weights[frames] = shift, 1.0
        alone = torch.zeros_like(self._weights)
        alone[frames] = 1.0
        return self._bent(alone)[frames]

    def finish(self, held: list[Held]) -> Float[Tensor, "time 2"]:
        return self._bent(self._weights)

    def _bent(self, weights: Float[Tensor, "time"]) -> Float[Tensor, "time 2"]:
        return bend_contacts(
            self._targets,
            weights,
            self._timestamps,
            self._path,
            bend=self.bend,
            transition_s=self.transition_s,
        )


@dataclass(eq=False)
class SnapCorrection(_Targets):
    """Ours: the wearer is moved as a whole by one offset per interaction, and smoothly from one to the next.

    While an object is held the offset stays, so that errors of a touch do not become motion of the object. About a
    hinge it is fitted to the whole arc, as hands must stay at one distance from the axis.
    """

    offset_settings: OffsetSettings = field(default_factory=OffsetSettings)
    hinge: HingeFit | None = field(default_factory=HingeFit)
    most_m: float = 0.3
    """No interaction moves the wearer by more: farther off, it is not the wearer that errs."""

    def offset(
        self,
        contact: ContactInterval,
        thing: SceneObject,
        points_world: Float[Tensor, "hand 3"],
        goes_on: bool,
    ) -> Float[Tensor, "frame 2"]:
        frames, hands = slice(contact.start, contact.stop), torch.tensor(contact.hands)
        held = self._palms[frames][:, hands][..., :2]
        if goes_on:
            shift = self._targets[contact.start - 1]
        else:
            touch = points_world[hands][:, :2].double() - held[0]
            shift = touch.mean(0)
            if thing.freedom.kind == "hinge" and self.hinge is not None:
                pivot = torch.tensor(thing.freedom.pivot, dtype=torch.float64)[:2]
                shift = fit_about_hinge(held.mean(1), pivot, shift, self.hinge)
            shift = shift * (self.most_m / shift.norm().clamp(min=1e-9)).clamp(max=1.0)
        self._targets[frames], self._weights[frames] = shift, 1.0
        return self._targets[frames]

    def finish(self, held: list[Held]) -> Float[Tensor, "time 2"]:
        if not held:
            return self._targets
        return offset_for(self._targets, self._weights, self._timestamps, self.offset_settings)


def fit_about_hinge(
    hand: Float64[Tensor, "frame 2"],
    pivot: Float64[Tensor, "2"],
    touch: Float64[Tensor, "2"],
    settings: HingeFit,
) -> Float64[Tensor, "2"]:
    """The offset (m) under which a hand's path keeps its distance from a hinge, starting at the touched point.

    Minimises Σ((|hand + δ − pivot| − r)/radius)²/frames·n + (n·(δ − touch)/touch_m)² + |δ|²/place_m² over δ and r by
    Gauss–Newton; n is the direction of `touch`.
    """
    picked = hand[torch.linspace(0, len(hand) - 1, min(FIT_FRAMES, len(hand))).long()] - pivot
    normal = touch / touch.norm().clamp(min=1e-9)
    radius = (picked[0] + touch).norm()
    # frames are correlated: an arc weighs as ten independent looks, spread over its frames
    weight = (10.0 / len(picked)) ** 0.5 / settings.radius_m
    unknown = torch.cat([touch, radius[None]])
    for _ in range(settings.iterations):
        arm = picked + unknown[:2]
        length = arm.norm(dim=-1)
        on_arc = weight * (length - unknown[2])
        J_arc = weight * torch.cat([arm / length[:, None], -torch.ones_like(length)[:, None]], 1)
        at_touch = (normal @ (unknown[:2] - touch))[None] / settings.touch_m
        J_touch = torch.nn.functional.pad(normal / settings.touch_m, (0, 1))[None]
        J_place = torch.nn.functional.pad(torch.eye(2, dtype=hand.dtype) / settings.place_m, (0, 1))
        J = torch.cat([J_arc, J_touch, J_place])
        residual = torch.cat([on_arc, at_touch, unknown[:2] / settings.place_m])
        unknown = unknown - torch.linalg.lstsq(J, residual[:, None]).solution[:, 0]
    return unknown[:2]
