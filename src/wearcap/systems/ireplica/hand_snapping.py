"""Correction of the arms that keeps holding hands on the object, smoothly in and out (ours)."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float64
from torch import Tensor

from wearcap.body.kinematics import site_positions
from wearcap.optimize.contact_correction import OffsetSettings, offset_for
from wearcap.recording import Motion
from wearcap.recording.interactions import HANDS
from wearcap.scene.environment import Environment
from wearcap.systems.ireplica.attachment import Held
from wearcap.tracking.anchor import with_hand_moved


@dataclass(frozen=True)
class HandSnapping:
    """Moves holding hands onto the object by bending the arms."""

    offset_settings: OffsetSettings = field(default_factory=lambda: OffsetSettings(transition_s=0.4))
    most_m: float = 0.15
    """Largest displacement (m) of a hand."""

    def __call__(self, motion: Motion, held: Sequence[Held], environment: Environment) -> Motion:
        """Bend the arms so that each holding palm stays at its point of the object.

        That point is the object's point nearest to the palm when its hold begins. Hands keep their world orientation.
        """
        palms = site_positions(motion.skeleton, motion.T_world_joint, tuple(f"{side}_palm" for side in HANDS))
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
