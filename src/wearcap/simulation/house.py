"""An interactive flat while somebody lives in it: where everything stands now, and what was moved when."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float

from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory
from wearcap.recording.interactions import HANDS, Interactions
from wearcap.simulation.interactive_flat import InteractiveFlat, obstacle
from wearcap.simulation.openables import Openable
from wearcap.simulation.things import Thing
from wearcap.simulation.world import World, WorldObject

Poses = Callable[[Float[np.ndarray, "time"]], Rigid]
"""Of a thing at times within the stretch in which it is moved (s)."""


@dataclass(frozen=True)
class Use:
    """A stretch of time in which hands hold something."""

    start_s: float
    stop_s: float
    hands: tuple[str, ...]
    name: str


@dataclass
class House:
    """Changes with every interaction that is planned."""

    flat: InteractiveFlat
    values: dict[str, float] = field(default_factory=dict)
    """How far each openable is from its initial pose (rad or m)."""
    poses: dict[str, Rigid] = field(default_factory=dict)
    """Where each thing stands."""
    uses: list[Use] = field(default_factory=list)
    moves: list[tuple[float, float, str, Poses]] = field(default_factory=list)
    """(start, stop, name, poses) in the order of time."""

    def __post_init__(self):
        self.values = {item.name: 0.0 for item in self.flat.openables}
        self.poses = {item.name: item.object.T_world_object.to(torch.float64) for item in self.flat.things}

    def pose(self, item: Thing | Openable) -> Rigid:
        """Where something is at the end of the plan."""
        return item.pose(self.values[item.name]) if isinstance(item, Openable) else self.poses[item.name]

    def obstacles(self, without: tuple[str, ...] = ()) -> tuple[WorldObject, ...]:
        """Everything that can be moved, where it is now."""
        items = (*self.flat.things, *self.flat.openables)
        return tuple(obstacle(item, self.pose(item)) for item in items if item.name not in without)

    def world(self, around: Float[np.ndarray, "3"], without: tuple[str, ...] = ()) -> World:
        """The flat as it is now, walkable where one gets to from a floor point (m); seats are the fixed ones."""
        static, extra = self.flat.static, self.obstacles(without)
        grid = static.navigation.barred(extra, around)
        near = lambda point: _beside(grid.node_points, np.array(point))  # noqa: E731
        now = replace(
            static, objects=(*static.objects, *extra),
            seats=tuple(seat for seat in static.seats if near(seat.standing_point())),
            reach_targets=tuple(target for target in static.reach_targets if near(target.stand)),
        )  # fmt: skip
        now.__dict__["navigation"] = grid
        return now

    def record(self, start_s: float, stop_s: float, hands: tuple[str, ...], name: str) -> None:
        """Enter that hands hold something for a while."""
        self.uses.append(Use(start_s, stop_s, hands, name))

    def interactions(self, until_s: float) -> Interactions:
        """What was held when, up to the end of a recording (s)."""
        classes = {
            item.name: item.object.freedom.contact_class for item in (*self.flat.things, *self.flat.openables)
        }
        uses = sorted((use for use in self.uses if use.start_s < until_s), key=lambda use: use.start_s)
        return Interactions(
            torch.tensor([use.start_s for use in uses], dtype=torch.float64),
            torch.tensor([min(use.stop_s, until_s) for use in uses], dtype=torch.float64),
            torch.tensor([[hand in use.hands for hand in HANDS] for use in uses]).reshape(-1, len(HANDS)),
            tuple(use.name for use in uses), tuple(classes[use.name] for use in uses),
        )  # fmt: skip

    def object_motion(self, times: Float[np.ndarray, "time"]) -> dict[str, Trajectory]:
        """Poses of everything that can be moved at rising times (s); it stays where it was left."""
        stamps, tracks = torch.from_numpy(times), {}
        for item in (*self.flat.things, *self.flat.openables):
            first = item.object.T_world_object.to(torch.float64)
            R, t = first.R.repeat(len(times), 1, 1), first.t.repeat(len(times), 1)
            for start, stop, name, poses in self.moves:
                begin, end = np.searchsorted(times, (start, stop))
                if name == item.name and begin < len(times):
                    span = np.append(times[begin:end], stop)
                    moved = poses(span)
                    R[begin:end], t[begin:end] = moved.R[:-1].double(), moved.t[:-1].double()
                    R[end:], t[end:] = moved.R[-1].double(), moved.t[-1].double()
            tracks[item.name] = Trajectory(stamps, R.float(), t.float())
        return tracks


def _beside(
    points: Float[np.ndarray, "node 3"], point: Float[np.ndarray, "3"], within_m: float = 0.3
) -> bool:
    return bool(len(points)) and float(np.linalg.norm(points[:, :2] - point[:2], axis=1).min()) < within_m
