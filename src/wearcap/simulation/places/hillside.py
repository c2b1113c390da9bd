"""Seeded hillsides: three terraces, some four metres above each other, that stairs and long ramps lead between."""

from dataclasses import dataclass

import numpy as np

from wearcap.simulation.places.builder import WorldBuilder
from wearcap.simulation.places.furnish import Plan
from wearcap.simulation.places.outdoor import put_somewhere
from wearcap.simulation.places.street import STONE, slab, sloped_rail
from wearcap.simulation.places.walls import build_flight
from wearcap.simulation.places.world import Room, World

DEPTH_M = 6.2
"""Depth of the whole hillside, across the slope."""
STAIRS_M, RAMP_M = 2.4, 3.6
"""Across the slope, stairs and the path after them are below the first, the ramp above the second."""
PLATEAU_M = 6.0
KINDS = ("bench", "planter", "tree", "bin", "street_lamp", "low_wall")
GROUND = (0.60, 0.58, 0.54)


@dataclass(frozen=True)
class Layout:
    """Lengths in m; x rises with the slope, the middle terrace lies at z = 0 from x = 0 to `PLATEAU_M`."""

    rise: float
    """Height from each terrace to the next."""
    steps: int
    tread: float
    slope: float

    @property
    def stairs(self) -> float:
        return (self.steps - 1) * self.tread

    @property
    def ramp(self) -> float:
        return self.rise / self.slope


def build_hillside(rng: np.random.Generator, name: str) -> World:
    """Terraces at -4 … 4 m (3.4 m apart at least), stairs of 15–17 cm steps and ramps of 10–15 % between them."""
    builder = WorldBuilder(name, rng.uniform(-np.pi, np.pi), tuple(rng.uniform(-5.0, 5.0, 2).tolist()), outdoors=True)
    steps, rise = int(rng.integers(22, 25)), rng.uniform(0.155, 4.0 / 24)
    layout = Layout(steps * rise, steps, rng.uniform(0.28, 0.32), rng.uniform(0.10, 0.15))
    middle = (0.0, 0.0, PLATEAU_M, DEPTH_M)
    _terrace(builder, "middle", [middle], 0.0, rng)
    _stairs_and_ramp(builder, layout, PLATEAU_M, 0.0)
    _stairs_and_ramp(builder, layout, -layout.ramp, -layout.rise)
    start = PLATEAU_M + layout.stairs
    top = PLATEAU_M + layout.ramp
    upper = [(start, 0.0, top, STAIRS_M + 0.8), (top, 0.0, top + PLATEAU_M, DEPTH_M)]
    _terrace(builder, "upper", upper, layout.rise, rng)
    foot = -layout.ramp
    lower = [(foot, 0.0, -layout.stairs, STAIRS_M + 0.8), (foot - PLATEAU_M, 0.0, foot, DEPTH_M)]
    _terrace(builder, "lower", lower, -layout.rise, rng)
    return builder.finish(cell=0.1)


def _terrace(builder: WorldBuilder, name: str, boxes: list, z: float, rng: np.random.Generator) -> None:
    """Level ground; the last box is the place itself, with its furniture, and open to the paths that lead to it."""
    for box in boxes:
        slab(builder, "floor", box, z, 0.3, GROUND, 6.0)
    x_low, _, x_high, _ = boxes[-1]
    corners = np.array([[x_low, 0.0], [x_high, 0.0], [x_high, DEPTH_M], [x_low, DEPTH_M]])
    builder.rooms.append(Room(name, builder.to_world(corners), z))
    plan = Plan(builder, (x_low + 1.2, 0.3, x_high - 1.2, DEPTH_M - 0.3), z, [])
    for kind in rng.permutation(KINDS)[:3]:
        put_somewhere(plan, str(kind), rng)


def _stairs_and_ramp(builder: WorldBuilder, layout: Layout, x: float, base: float) -> None:
    """Stairs and a ramp from `base` to the next terrace: the ramp starts at x; above the middle the stairs do, too,
    below it they end where the ramp ends."""
    top = base + layout.rise
    ramp = (x, RAMP_M, x + layout.ramp, DEPTH_M)
    plane = (layout.slope, 0.0, base - layout.slope * x)
    slab(builder, "ramp", ramp, top, 0.3, GROUND, 6.0, plane)
    foot = x if base == 0.0 else x + layout.ramp - layout.stairs
    rise = layout.rise / layout.steps
    build_flight(
        builder, (foot, 0.1 + STAIRS_M / 2), 0.0, layout.steps, rise, layout.tread, STAIRS_M - 0.3, base, (-1, 1), STONE
    )
    beside = RAMP_M - 0.1
    sloped_rail(builder, (x, beside), (x + layout.ramp, beside), base, (base, top))
    sloped_rail(builder, (x, DEPTH_M - 0.05), (x + layout.ramp, DEPTH_M - 0.05), base, (base, top))
