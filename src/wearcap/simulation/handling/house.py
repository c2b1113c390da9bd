"""The current state of an interactive flat: where every object stands, what it keeps free, and the handlings so far."""

from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float

from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory
from wearcap.recording.motion import HANDS, Interactions, Motion
from wearcap.simulation.handling.grips import Handling, object_motion
from wearcap.simulation.places.interactive_flat import InteractiveFlat, obstacle
from wearcap.simulation.places.movables import Movable
from wearcap.simulation.places.world import World, WorldObject

NEAR_WALKABLE_M = 0.3
"""Distance from the walkable floor within which seats and reach targets can be used."""
BEFORE_M = 0.45
"""Depth kept free in front of openables, beyond their sweep."""


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

    def obstacles(self, without: tuple[str, ...] = ()) -> tuple[WorldObject, ...]:
        """Everything that can be moved, at its current place."""
        poses = [(item, self.poses[item.name]) for item in self.flat.movables]
        poses += [(item, item.pose(self.values[item.name])) for item in self.flat.openables]
        return tuple(obstacle(item, pose) for item, pose in poses if item.name not in without)

    def world(self, around: Float[np.ndarray, "3"], without: tuple[str, ...] = ()) -> World:
        """The flat's current state, walkable where one gets to from a floor point (m); seats are the fixed ones."""
        static, extra = self.flat.static, self.obstacles(without)
        grid = static.navigation.barred(extra, around)

        def near(point) -> bool:
            away = np.linalg.norm(grid.node_points[:, :2] - np.array(point)[:2], axis=1)
            return bool((away < NEAR_WALKABLE_M).any())

        now = replace(
            static,
            objects=(*static.objects, *extra),
            seats=tuple(seat for seat in static.seats if near(seat.standing_point())),
            reach_targets=tuple(target for target in static.reach_targets if near(target.stand)),
        )
        now.__dict__["navigation"] = grid
        return now

    def floor_place(self, movable: Movable) -> Float[np.ndarray, "3"]:
        """Floor pose of an object: x, y (m) and heading (rad)."""
        pose = self.poses[movable.name]
        return np.array([*pose.t[:2].tolist(), float(np.arctan2(pose.R[1, 0], pose.R[0, 0]))])

    def kept_free(self) -> list[Float[np.ndarray, "4 2"]]:
        """Outlines of the floor before doors, windows and cabinets, and behind doors."""
        zones = []
        for item in self.flat.openables:
            if item.hinged:  # a square over the leaf's quarter circle
                width, sign = float(item.outline[:, 0].max()), item.opening_sign
                behind = -0.9 if item.category == "door" else 0.0
                low, high = sorted((sign * (width + 0.1), sign * behind))
                pose, depth = item.pose(item.closed), width + BEFORE_M
            else:
                high = float(item.outline[:, 1].max())
                low, pose, depth = -high, item.object.T_world_object, abs(item.opened - item.closed) + BEFORE_M
            corners = np.array([[0.0, low], [depth, low], [depth, high], [0.0, high]])
            zones.append(corners @ pose.R[:2, :2].double().numpy().T + pose.t[:2].double().numpy())
        return zones

    def interactions(self, until_s: float) -> Interactions:
        """Intervals in which hands hold objects, ordered by their start, up to the end of a recording (s)."""
        rows = sorted(
            ((row, handling) for handling in self.handlings for row in handling.rows if row[0] < until_s),
            key=lambda pair: pair[0][:2],
        )
        return Interactions(
            torch.tensor([row[0] for row, _ in rows], dtype=torch.float64),
            torch.tensor([min(row[1], until_s) for row, _ in rows], dtype=torch.float64),
            torch.tensor([row[2] for row, _ in rows], dtype=torch.bool).reshape(-1, len(HANDS)),
            tuple(handling.name for _, handling in rows),
            tuple(handling.contact_class for _, handling in rows),
        )

    def object_motion(self, motion: Motion) -> dict[str, Trajectory]:
        """Poses of all movable objects and openables on a motion's timestamps; each stays where it was left."""
        return {
            item.name: object_motion(
                item.object.T_world_object, [h for h in self.handlings if h.name == item.name], motion
            )
            for item in (*self.flat.movables, *self.flat.openables)
        }
