"""Surroundings for a motion that was captured in an empty hall: a room or a street that fits the activity.

Walls and furniture stand beside the path, some within arm's reach, and nothing ever meets the body; below sitters
stands a seat, below climbers a step. The floor is at z = 0, where `prepare.mocap` puts it.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from wearcap.recording.motion import Motion
from wearcap.simulation.people.body_space import BodySpace, SweptFloor
from wearcap.simulation.places.builder import Piece, WorldBuilder, hue
from wearcap.simulation.places.furniture import MAKERS, ROOM_KINDS, Plan, wood
from wearcap.simulation.places.outdoor import MEADOW, PAVEMENT_KINDS, SQUARE_KINDS
from wearcap.simulation.places.outline import Box, around, inset, middle_and_size, rectangle
from wearcap.simulation.places.supports import build_seat, build_tread, find_sits, find_treads, meets
from wearcap.simulation.places.walls import HEIGHT, Wall, barrier, before_gap, build_facade, build_wall
from wearcap.simulation.places.world import World

MARGIN_M = 0.12
"""Least distance of anything from the body, except its supports."""
NEAR_M = (0.3, 0.8)
"""Distance of furniture from the body beside its path."""
WALL_M = (0.6, 3.0)
"""Distance from the body to walls."""
BEYOND_M = 5.0
"""Margin of the checked floor around the body."""
FAST, TALL_M = 2.0, HEIGHT - 0.25
"""Speed (m/s) and reach above which a motion is mostly, or always, outdoors."""
NEAR_INDOORS = ("table", "chair", "coffee_table", "armchair", "plant", "lamp", "cabinet", "desk", "shelf", "sofa")
NEAR_OUTDOORS = ("bench", "bin", "bollard", "planter", "bush", "street_lamp", "low_wall", "tree", "letter_box", "board")


@dataclass(kw_only=True)
class _FreePlan(Plan):
    """A plan that also keeps off the space that a moving body occupies."""

    body: BodySpace
    """Space of the body in the world."""
    swept: SweptFloor
    """Floor swept by the body, in the builder's frame."""

    def distance(self, piece: Piece, x: float, y: float, heading: float) -> float:
        """Distance from the body to a piece's outline up to its height (m)."""
        return self.swept.distance((x, y), piece.size, heading, piece.z_range[1])

    def try_place(self, piece: Piece, x: float, y: float, heading: float, front: float = 0.0) -> bool:
        if self.distance(piece, x, y, heading) < MARGIN_M:
            return False
        place = np.array([*self.builder.to_world(np.array([x, y])), self.z])
        # Parts may reach beyond the piece's outline, or above its height, as the crown of a tree does.
        within = np.array([*piece.size, 2 * piece.z_range[1]]) / 2 + 0.03
        overhangs = any((np.abs(part.center) + np.array(part.box_size) / 2 > within).any() for part in piece.parts)
        if overhangs and meets(self.body, piece, place, heading + self.builder.heading, MARGIN_M):
            return False
        return super().try_place(piece, x, y, heading, front)


def surround(motion: Motion, rng: np.random.Generator, name: str) -> World:
    """A world around a motion, deterministic for its motion and generator; `motion` needs xsens23's joints and sites.

    Raises WearcapError for another skeleton.
    """
    body = BodySpace.of(motion)
    path = motion.t_world_root[:, :2].double().numpy()
    duration_s = (motion.timestamps[-1] - motion.timestamps[0]).item()
    fast = float(np.linalg.norm(path[-1] - path[0])) / max(duration_s, 0.1) > FAST
    tall = bool((body.points[:, 2] + body.radius).max() > TALL_M)
    outdoors = bool(rng.uniform() < (0.75 if fast else 0.12)) | tall
    builder = WorldBuilder(name, _heading(path, rng), tuple(path.mean(0).tolist()), outdoors)
    turned = body.points.copy()
    turned[:, :2] = builder.from_world(turned[:, :2])
    here = BodySpace(turned, body.radius, body.part)
    swept = SweptFloor.of(here, BEYOND_M)
    plan = _FreePlan(builder, (0.0, 0.0, 0.0, 0.0), 0.0, body=body, swept=swept)
    sits = find_sits(motion)
    for sit in sits:
        if (built := build_seat(builder, body, sit, rng)) is not None:
            piece, place, heading = built
            plan.solid.append(around(rectangle((place[0], place[1]), piece.size, heading)))
    for tread in find_treads(motion, sits):
        if (step := build_tread(builder, body, tread, rng)) is not None:
            outline = rectangle(tuple(step.center.tolist()), tuple(step.size.tolist()), step.heading)
            plan.solid.append(around(builder.from_world(outline)))
    reach = around(np.concatenate([here.points[:, :2] + side * here.radius[:, None] for side in (-1, 1)]))
    (_build_street if outdoors else _build_room)(plan, reach, builder.from_world(path), rng)
    return builder.finish()


def _heading(path: Float[np.ndarray, "time 2"], rng: np.random.Generator) -> float:
    """Heading of a room: roughly along the path; random for a body that stays in one place."""
    offset = path - path.mean(0)
    if np.ptp(offset, axis=0).max() < 2.0:
        return float(rng.uniform(-np.pi, np.pi))
    along = np.linalg.svd(offset, full_matrices=False)[2][0]
    return float(np.arctan2(along[1], along[0]) + rng.normal(0.0, 0.12))


def _build_room(plan: _FreePlan, reach: Box, path: np.ndarray, rng: np.random.Generator) -> None:
    """Four walls with doors and windows, furniture beside the path, then along the walls."""
    builder = plan.builder
    gap = rng.uniform(*WALL_M, 4)
    box = (reach[0] - gap[0], reach[1] - gap[1], reach[2] + gap[2], reach[3] + gap[3])
    builder.add_slab("floor", box, 0.0, 0.05, wood(rng), 1.5)
    builder.add_room("room", rectangle(*middle_and_size(box)), 0.0)
    color = hue(rng, (0.0, 0.15))
    with_door = rng.permutation(4)[: rng.integers(1, 3)]
    corners = [(box[0], box[1]), (box[2], box[1]), (box[2], box[3]), (box[0], box[3])]
    for side, wall in enumerate(Wall(a, b) for a, b in zip(corners, (*corners[1:], corners[0]))):
        if side in with_door:
            wall.doors.append((float(rng.uniform(0.7, wall.length - 0.7)), float(rng.uniform(0.8, 0.95))))
            _build_passage(builder, wall, color, rng)
        elif rng.uniform() < 0.7:
            count = max(1, int(wall.length / 3.0))
            wall.windows += [(wall.length * (k + 0.5) / count, float(rng.uniform(0.9, 1.4))) for k in range(count)]
        build_wall(builder, wall, color, rng)
    plan.room = inset(box, 0.07)
    plan.kept_free += [before_gap(builder, door) for door in builder.doors]
    _beside(plan, NEAR_INDOORS, path, rng)
    plan.furnish(str(rng.choice(list(ROOM_KINDS))), rng)


def _build_passage(builder: WorldBuilder, wall: Wall, color: tuple, rng: np.random.Generator) -> None:
    """The view through a door: a bit of hallway."""
    deep = rng.uniform(1.3, 1.8)
    a, b = wall.at(-0.06, -deep), wall.at(wall.length + 0.06, -deep)
    outline = np.array([a, b, wall.at(wall.length + 0.06, -0.06), wall.at(-0.06, -0.06)])
    builder.add_surface("floor", outline, wood(rng), texture=1.5, thickness=0.05)
    for start, end in ((wall.start, a), (a, b), (b, wall.end)):
        build_wall(builder, Wall(start, end), color, rng)


def _beside(plan: _FreePlan, kinds: tuple[str, ...], path: np.ndarray, rng: np.random.Generator) -> None:
    """Furniture within `NEAR_M` of the body, about one piece per metre and a half of its path."""
    length = float(np.linalg.norm(np.diff(path[::30], axis=0), axis=1).sum())
    for _ in range(int(np.clip(2 + length / 1.5, 2, 7))):
        piece = MAKERS[str(rng.choice(kinds))](rng)
        for _ in range(40):
            angle, reach = rng.uniform(-np.pi, np.pi), rng.uniform(0.5, 2.2)
            x, y = path[rng.integers(len(path))] + reach * np.array([np.cos(angle), np.sin(angle)])
            heading = float(rng.integers(4) * np.pi / 2 + (rng.normal(0.0, 0.3) if piece.kind == "chair" else 0.0))
            near = plan.distance(piece, float(x), float(y), heading)
            if NEAR_M[0] <= near <= NEAR_M[1] and plan.try_place(piece, float(x), float(y), heading):
                break


def _build_street(plan: _FreePlan, reach: Box, path: np.ndarray, rng: np.random.Generator) -> None:
    """A pavement before a house front, with a row of barriers across, open at its ends."""
    builder = plan.builder
    ends, front, across = rng.uniform(2.5, 5.0, 2), rng.uniform(0.8, 3.0), rng.uniform(1.0, 4.0)
    box = (reach[0] - ends[0], reach[1] - across, reach[2] + ends[1], reach[3] + front)
    light = rng.uniform(0.32, 0.7)
    warm = 1.0 + rng.uniform(0.0, 0.12)
    color, texture = (light * warm, light, light * 0.98), float(rng.choice([3.0, 5.0, 6.0]))
    builder.add_slab("floor", box, 0.0, 0.05, color, texture)
    middle, size = middle_and_size(box)
    builder.add_room("street", rectangle(middle, size), 0.0, open_air=True)
    builder.add_box((*middle, -0.11), (size[0] + 24.0, size[1] + 24.0, 0.1), MEADOW, 1.0)
    doors = [(float(rng.uniform(box[0] + 1.2, box[2] - 1.2)), 0.0)]
    build_facade(builder, (box[0], box[3], box[2], box[3] + 0.4), rng.uniform(4.5, 7.5), doors, 0.0, rng)
    gap = rng.uniform(box[0], box[2])
    for low, high in ((box[0], gap - 0.8), (gap + 0.8, box[2])):
        barrier(builder, (float(low), float(high)), box[1], (0.0, 0.0), rng, True)
    for x in rng.uniform(box[0] - 4.0, box[2] + 4.0, 6):
        builder.place(MAKERS["tree"](rng), (float(x), float(box[1] - rng.uniform(3.0, 9.0)), -0.06), 0.0)
    plan.room = (box[0] + 0.2, box[1] + 0.7, box[2] - 0.2, box[3] - 0.1)
    _beside(plan, NEAR_OUTDOORS, path, rng)
    for kind in (*PAVEMENT_KINDS, *SQUARE_KINDS)[:: int(rng.integers(1, 4))]:
        plan.somewhere(kind, rng)
