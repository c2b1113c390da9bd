"""The current state of an interactive flat: where every object stands, and the handlings so far."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float

from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory
from wearcap.recording.interactions import Interactions
from wearcap.recording.motion import Motion
from wearcap.simulation.handling.grips import GripPlace
from wearcap.simulation.handling.handlings import Handling, interactions_of, object_motion
from wearcap.simulation.people.plan import Plan
from wearcap.simulation.places.interactive_flat import InteractiveFlat, obstacle
from wearcap.simulation.places.movables import Movable
from wearcap.simulation.places.openables import Openable
from wearcap.simulation.places.world import World, WorldObject

Distractor = Callable[[Plan, dict[str, GripPlace], Rigid, float, np.random.Generator], None]
"""An act that resembles handling an object: given places for the hands, the object's pose and its height (m)."""


@dataclass
class House:
    """State of an interactive flat; it changes with every interaction that is planned."""

    flat: InteractiveFlat
    values: dict[str, float] = field(default_factory=dict)
    """Current value of each openable, relative to its initial pose (rad or m)."""
    poses: dict[str, Rigid] = field(default_factory=dict)
    """Current pose of each movable object."""
    handlings: list[Handling] = field(default_factory=list)
    """Handlings so far, in the order of time."""

    def __post_init__(self):
        self.values = {item.name: 0.0 for item in self.flat.openables}
        self.poses = {item.name: item.object.T_world_object.to(torch.float64) for item in self.flat.movables}

    def pose(self, item: Movable | Openable) -> Rigid:
        """Pose of an object at the end of the plan."""
        return item.pose(self.values[item.name]) if isinstance(item, Openable) else self.poses[item.name]

    def obstacles(self, without: tuple[str, ...] = ()) -> tuple[WorldObject, ...]:
        """Everything that can be moved, at its current place."""
        items = (*self.flat.movables, *self.flat.openables)
        return tuple(obstacle(item, self.pose(item)) for item in items if item.name not in without)

    def world(self, around: Float[np.ndarray, "3"], without: tuple[str, ...] = ()) -> World:
        """The flat's current state, walkable where one gets to from a floor point (m); seats are the fixed ones."""
        static, extra = self.flat.static, self.obstacles(without)
        grid = static.navigation.barred(extra, around)
        near = lambda point: _beside(grid.node_points, np.array(point))  # noqa: E731
        now = replace(
            static,
            objects=(*static.objects, *extra),
            seats=tuple(seat for seat in static.seats if near(seat.standing_point())),
            reach_targets=tuple(target for target in static.reach_targets if near(target.stand)),
        )
        now.__dict__["navigation"] = grid
        return now

    def interactions(self, until_s: float) -> Interactions:
        """Intervals in which hands hold objects, up to the end of a recording (s)."""
        rows = interactions_of(self.handlings)
        kept = torch.nonzero(rows.start_s < until_s)[:, 0]
        pick = lambda names: tuple(names[k] for k in kept.tolist())  # noqa: E731
        return Interactions(
            rows.start_s[kept],
            rows.stop_s[kept].clamp(max=until_s),
            rows.hands[kept],
            pick(rows.objects),
            pick(rows.classes),
        )

    def object_motion(self, motion: Motion) -> dict[str, Trajectory]:
        """Poses of all movable objects and openables on a motion's timestamps; each stays where it was left."""
        return {
            item.name: object_motion(
                item.object.T_world_object, [h for h in self.handlings if h.name == item.name], motion
            )
            for item in (*self.flat.movables, *self.flat.openables)
        }


def _beside(points: Float[np.ndarray, "node 3"], point: Float[np.ndarray, "3"], within_m: float = 0.3) -> bool:
    return bool(len(points)) and float(np.linalg.norm(points[:, :2] - point[:2], axis=1).min()) < within_m
