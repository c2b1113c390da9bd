"""Contact-based corrections of the wearer's path (thesis §5.3.1): the thesis's and ours."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.body.kinematics import site_positions
from wearcap.recording import Motion
from wearcap.recording.motion import HANDS
from wearcap.scene.objects import Environment, SceneObject
from wearcap.systems.ireplica.contact_correction import OffsetSettings, bend_contacts, offset_for
from wearcap.systems.ireplica.object_tracker import PALMS, ContactInterval, Correction, Held
from wearcap.systems.ireplica.trajectory import BentPath
from wearcap.tracking.anchor import with_hand_moved

FIT_FRAMES = 60
"""Number of evenly spread frames of an arc that are fitted; more add no information."""


@dataclass(frozen=True)
class HingeFit:
    """Standard deviations (m) with which a hand's arc about a hinge determines the wearer's position."""

    radius_m: float = 0.015
    """Standard deviation of the hand's distance from the hinge, from frame to frame."""
    touch_m: float = 0.03
    """Standard deviation of the hand's distance from the surface when the object is taken, along the surface normal."""
    place_m: float = 0.06
    """Standard deviation of the wearer's position."""
    iterations: int = 6


@dataclass(eq=False)
class BendCorrection(Correction):
    """The thesis's correction: the path is bent again, with the touched point as the only control point (eq. 5.2)."""

    bend: Callable[..., BentPath]
    """`systems.ireplica.trajectory.bend` with its settings and solver."""
    transition_s: float = 3.0

    def offset(
        self, contact: ContactInterval, scene_object: SceneObject, points_world: Float[Tensor, "hand 3"], goes_on: bool
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
            self._targets, weights, self._timestamps, self._path, bend=self.bend, transition_s=self.transition_s
        )


@dataclass(eq=False)
class SnapCorrection(Correction):
    """Moves the whole wearer by one offset per interaction, with smooth transitions (ours).

    The offset is constant while an object is held, so that errors of the touched point do not become object motion. For
    a hinge it is fitted to the whole arc, as hands must keep their distance from the axis.
    """

    offset_settings: OffsetSettings = field(default_factory=OffsetSettings)
    hinge: HingeFit | None = field(default_factory=HingeFit)
    most_m: float = 0.3
    """Largest offset (m) of an interaction; larger ones are not due to an error of the wearer's position."""

    def offset(
        self, contact: ContactInterval, scene_object: SceneObject, points_world: Float[Tensor, "hand 3"], goes_on: bool
    ) -> Float[Tensor, "frame 2"]:
        frames, hands = slice(contact.start, contact.stop), torch.tensor(contact.hands)
        held = self._palms[frames][:, hands][..., :2]
        if goes_on:
            shift = self._targets[contact.start - 1]
        else:
            touch = points_world[hands][:, :2].double() - held[0]
            shift = touch.mean(0)
            if scene_object.freedom.kind == "hinge" and self.hinge is not None:
                pivot = torch.tensor(scene_object.freedom.pivot, dtype=torch.float64)[:2]
                shift = fit_about_hinge(held.mean(1), pivot, shift, self.hinge)
            shift = shift * (self.most_m / shift.norm().clamp(min=1e-9)).clamp(max=1.0)
        self._targets[frames], self._weights[frames] = shift, 1.0
        return self._targets[frames]

    def finish(self, held: list[Held]) -> Float[Tensor, "time 2"]:
        return offset_for(self._targets, self._weights, self._timestamps, self.offset_settings)


def fit_about_hinge(
    hand: Float64[Tensor, "frame 2"], pivot: Float64[Tensor, "2"], touch: Float64[Tensor, "2"], settings: HingeFit
) -> Float64[Tensor, "2"]:
    """Fit the offset δ (m) under which a hand's path keeps its distance r from a hinge and starts at the touched point.

    Minimises Σ((|hand + δ − pivot| − r)/radius)²/frames·n + (n·(δ − touch)/touch_m)² + |δ|²/place_m² over δ and r by
    Gauss–Newton; n is the direction of `touch`.
    """
    picked = hand[torch.linspace(0, len(hand) - 1, min(FIT_FRAMES, len(hand))).long()] - pivot
    normal = touch / touch.norm().clamp(min=1e-9)
    radius = (picked[0] + touch).norm()
    # frames are correlated: an arc counts as ten independent measurements
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


@dataclass(frozen=True)
class HandSnapping:
    """Moves holding hands onto the object by bending the arms."""

    offset_settings: OffsetSettings = field(default_factory=lambda: OffsetSettings(transition_s=0.4))
    most_m: float = 0.15
    """Largest displacement (m) of a hand."""

    def __call__(self, motion: Motion, held: Sequence[Held], environment: Environment) -> Motion:
        """Bend the arms so that each holding palm stays at its point of the object: the one nearest to it when its hold
        begins. Hands keep their world orientation."""
        palms = site_positions(motion.skeleton, motion.T_world_joint, PALMS)
        for hand, side in enumerate(HANDS):
            targets, weights = self._targets(palms[:, hand].double(), hand, held, environment)
            if bool(weights.any()):
                offset = offset_for(targets, weights, motion.timestamps, self.offset_settings)
                motion = with_hand_moved(motion, side, offset.to(motion.t_world_root.dtype))
        return motion

    def _targets(
        self, palm: Float64[Tensor, "time 3"], hand: int, held: Sequence[Held], environment: Environment
    ) -> tuple[Float64[Tensor, "time 3"], Float64[Tensor, "time"]]:
        """Displacement (m) of a palm to its point of the object, and weight 1 at frames in which it holds."""
        targets, weights = torch.zeros_like(palm), torch.zeros_like(palm[:, 0])
        before: Held | None = None
        point = palm.new_zeros(3)
        for row in held:
            if not row.interval.hands[hand]:
                continue
            start, frames = row.interval.start, slice(row.interval.start, row.interval.stop)
            on = before is not None and before.interval.stop == start and before.scene_object is row.scene_object
            if not on:
                _, nearest = environment.distance(row.scene_object.name, palm[[start]], row.state.T_world_object)
                start_pose = row.T_world_object[0].to(torch.float64)
                point = start_pose.R.mT @ (nearest[0] - start_pose.t)
            T = row.T_world_object.to(torch.float64)
            missing = (T.R @ point) + T.t - palm[frames]
            length = missing.norm(dim=-1, keepdim=True).clamp(min=1e-9)
            targets[frames], weights[frames] = missing * (self.most_m / length).clamp(max=1.0), 1.0
            before = row
        return targets, weights
