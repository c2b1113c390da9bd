"""Surroundings for a motion that was captured in an empty hall: a room or a street that fits the activity.

Walls and furniture stand beside the path, some within arm's reach, and nothing ever meets the body; below sitters
stands a seat, below climbers a step. The floor is at z = 0, where `data_prep.shared.mocap` puts it.

Supports are found by balance: a body that is still with bent hips while its centre of mass is not over the feet, or
both feet are off the floor, sits; a lower foot at rest above the floor while the body does not fly stands on a step.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Float

from wearcap.recording.motion import Motion
from wearsim.people.body_space import BodySpace, SweptFloor, foot_points, mass_center, off_balance
from wearsim.places.builder import Piece, WorldBuilder, entered, hue
from wearsim.places.furniture import BOTH, IRON, MAKERS, ROOM_KINDS, Plan, parts_of, wood
from wearsim.places.outdoor import MEADOW, PAVEMENT_KINDS, SQUARE_KINDS
from wearsim.places.outline import Box, around, inset, middle_and_size, rectangle, turn
from wearsim.places.walls import HEIGHT, Wall, barrier, before_gap, build_facade
from wearsim.places.world import World

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
STILL = 0.3
"""Speed of the pelvis below which it may sit (m/s)."""
OFF_BALANCE_M = 0.06
SIT_S = 0.4
BENT_DEG = 35.0
"""Least angle of a sitter's thighs from vertical."""
PELVIS_OVER_SEAT_M = 0.10

RESTING = 0.5
"""Speed of a foot patch below which it carries weight (m/s) …"""
FLYING = -6.0
"""… unless the body accelerates downwards by more than this (m/s²)."""
STEP_S, LOWEST_STEP_M = 0.08, 0.09
FOOT_REST_S = 0.5
"""Least time for which a sitter's foot is at rest before a step is put below it."""
SOLE_WIDTH_M = 0.10
SOFT_M = (0.05, 0.08)
"""Depth to which thighs and buttocks may press into a seat: first try, and where nothing fits."""
ON_STEP = {"foot": 0.05, "hand": 0.05, "shin": 0.02}
"""Depth (m) to which feet may reach into a step (captured soles are centimetres off), hands into a handhold."""
NEAR_SEAT = {"hand": 0.08, "foot": 0.03, "shin": 0.02}
SEATS = ("chair", "bench", "armchair", "sofa", "bed", "stool", "stool", "pedestal")
THICK_M = 0.04
"""Thickness of boards and rungs."""
POST_M = 0.035


@dataclass(frozen=True, eq=False)
class _Sit:
    """An interval of sitting in one place."""

    start: int
    stop: int
    place: Float[np.ndarray, "3"]
    """Position of the buttocks (m)."""
    heading: float


@dataclass(frozen=True, eq=False)
class _Tread:
    """A level rectangle that feet stood on, along the axes of `heading`."""

    low: Float[np.ndarray, "2"]
    high: Float[np.ndarray, "2"]
    """Corners in axes turned by `heading` (m)."""
    z: float
    heading: float

    @property
    def size(self) -> Float[np.ndarray, "2"]:
        return self.high - self.low

    @property
    def center(self) -> Float[np.ndarray, "2"]:
        """Centre in the world (m)."""
        return turn(self.heading) @ ((self.low + self.high) / 2)


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
        if overhangs and _meets(self.body, piece, place, heading + self.builder.heading, MARGIN_M):
            return False
        return super().try_place(piece, x, y, heading, front)

    def place_beside(self, kinds: tuple[str, ...], path: np.ndarray, rng: np.random.Generator) -> None:
        """Furniture within `NEAR_M` of the body, about one piece per metre and a half of its path."""
        length = float(np.linalg.norm(np.diff(path[::30], axis=0), axis=1).sum())
        for _ in range(int(np.clip(2 + length / 1.5, 2, 7))):
            piece = MAKERS[str(rng.choice(kinds))](rng)
            for _ in range(40):
                angle, reach = rng.uniform(-np.pi, np.pi), rng.uniform(0.5, 2.2)
                x, y = path[rng.integers(len(path))] + reach * np.array([np.cos(angle), np.sin(angle)])
                heading = float(rng.integers(4) * np.pi / 2 + (rng.normal(0.0, 0.3) if piece.kind == "chair" else 0.0))
                near = self.distance(piece, float(x), float(y), heading)
                if NEAR_M[0] <= near <= NEAR_M[1] and self.try_place(piece, float(x), float(y), heading):
                    break

    def build_seat(self, sit: _Sit, rng: np.random.Generator) -> None:
        """Place a seat of fitting height that the body touches only with the parts it sits on; none if not even a stool
        fits."""
        body, builder = self.body, self.builder
        kinds = [str(kind) for kind in rng.permutation(SEATS)]
        for soft in SOFT_M:
            for kind in [*kinds, "small pedestal"]:
                piece = {**MAKERS, **STOOLS}[kind](rng)
                x, y, height, heading, _ = piece.seats[int(rng.integers(len(piece.seats)))]
                factor = float(sit.place[2]) / height
                if kind in MAKERS and not 0.8 < factor < 1.25:
                    continue
                piece, about = piece.stretched(factor), sit.heading - heading
                position = np.array([*(sit.place[:2] - turn(about) @ np.array([x, y])), 0.0])
                if not _meets(body, piece, position, about, 0.0, {"seat": soft, **NEAR_SEAT}):
                    place = np.array([*builder.from_world(position[:2]), 0.0])
                    builder.place(piece, tuple(place.tolist()), about - builder.heading)
                    outline = rectangle((place[0], place[1]), piece.size, about - builder.heading)
                    self.solid.append(around(outline))
                    return

    def build_tread(self, tread: _Tread, rng: np.random.Generator) -> None:
        """Build a step down to the floor, else a board or a rung, as large as the body leaves room for."""
        builder = self.builder
        body = self.body.around(np.array([*tread.center, tread.z / 2]), max(tread.z / 2, 1.0))
        for (solid, share), along, lower in product(_FORMS, (0.5, 0.75, 0.25, 1.0, 0.0), (0.0, 0.03)):
            low, high = tread.low.copy(), tread.high.copy()
            low[0] += along * (1 - share) * tread.size[0]
            high[0] = low[0] + share * tread.size[0]
            small = replace(tread, low=low, high=high, z=tread.z - lower)
            if _clear(body, small, solid):
                break
        else:
            return
        # widened on all sides while the body is clear of it, up to a drawn size
        tread = small
        most = (rng.uniform(0.27, 0.36), rng.uniform(0.6, 1.0)) if solid else (0.0, rng.uniform(0.45, 0.6))
        open_sides = [(axis, sign) for axis in (1, 0) for sign in (-1, 1)]
        while open_sides:
            for axis, sign in list(open_sides):
                low, high = tread.low.copy(), tread.high.copy()
                (low if sign < 0 else high)[axis] += 0.03 * sign
                wider = replace(tread, low=low, high=high)
                if wider.size[axis] > most[axis] or not _clear(body, wider, solid):
                    open_sides.remove((axis, sign))
                else:
                    tread = wider
        heading = tread.heading - builder.heading
        middle = builder.from_world(tread.center)
        shade = rng.uniform(0.8, 1.1)
        color = (0.5 * shade, 0.425 * shade, 0.35 * shade)
        outline = rectangle(tuple(middle.tolist()), tuple(tread.size.tolist()), heading)
        thick = tread.z if solid else THICK_M
        builder.add_surface("stairs_step", outline, color, plane=(0.0, 0.0, tread.z), texture=12.0, thickness=thick)
        for side in () if solid else (-1, 1):
            end = tread.center + turn(tread.heading) @ np.array([0.0, side * (tread.size[1] / 2 + POST_M / 2)])
            size = (POST_M, POST_M, tread.z)
            if not body.meets(np.array([*end, tread.z / 2]), np.array(size), tread.heading, 0.0, ON_STEP):
                x, y = builder.from_world(end).tolist()
                builder.add_box((x, y, tread.z / 2), size, color, 8.0, heading)
        outline = rectangle(tuple(tread.center.tolist()), tuple(tread.size.tolist()), tread.heading)
        self.solid.append(around(builder.from_world(outline)))

    def build_room(self, reach: Box, path: np.ndarray, rng: np.random.Generator) -> None:
        """Four walls with doors and windows, furniture beside the path, then along the walls."""
        builder = self.builder
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
                # the view through it: a bit of hallway
                deep = rng.uniform(1.3, 1.8)
                a, b = wall.at(-0.06, -deep), wall.at(wall.length + 0.06, -deep)
                outline = np.array([a, b, wall.at(wall.length + 0.06, -0.06), wall.at(-0.06, -0.06)])
                builder.add_surface("floor", outline, wood(rng), texture=1.5, thickness=0.05)
                for start, end in ((wall.start, a), (a, b), (b, wall.end)):
                    Wall(start, end).build(builder, color, rng)
            elif rng.uniform() < 0.7:
                count = max(1, int(wall.length / 3.0))
                wall.windows += [(wall.length * (k + 0.5) / count, float(rng.uniform(0.9, 1.4))) for k in range(count)]
            wall.build(builder, color, rng)
        self.room = inset(box, 0.07)
        self.kept_free += [before_gap(builder, door) for door in builder.places.doors]
        self.place_beside(NEAR_INDOORS, path, rng)
        self.furnish(str(rng.choice(list(ROOM_KINDS))), rng)

    def build_street(self, reach: Box, path: np.ndarray, rng: np.random.Generator) -> None:
        """A pavement before a house front, with a row of barriers across, open at its ends."""
        builder = self.builder
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
        self.room = (box[0] + 0.2, box[1] + 0.7, box[2] - 0.2, box[3] - 0.1)
        self.place_beside(NEAR_OUTDOORS, path, rng)
        for kind in (*PAVEMENT_KINDS, *SQUARE_KINDS)[:: int(rng.integers(1, 4))]:
            self.somewhere(kind, rng)


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
    offset = path - path.mean(0)
    if np.ptp(offset, axis=0).max() < 2.0:  # the body stays in one place
        heading = float(rng.uniform(-np.pi, np.pi))
    else:  # roughly along the path
        along = np.linalg.svd(offset, full_matrices=False)[2][0]
        heading = float(np.arctan2(along[1], along[0]) + rng.normal(0.0, 0.12))
    builder = WorldBuilder(name, heading, tuple(path.mean(0).tolist()), outdoors)
    turned = body.points.copy()
    turned[:, :2] = builder.from_world(turned[:, :2])
    here = BodySpace(turned, body.radius, body.part)
    swept = SweptFloor.of(here, BEYOND_M)
    plan = _FreePlan(builder, (0.0, 0.0, 0.0, 0.0), 0.0, body=body, swept=swept)
    sits = find_sits(motion)
    for sit in sits:
        plan.build_seat(sit, rng)
    for tread in find_treads(motion, sits):
        plan.build_tread(tread, rng)
    reach = around(np.concatenate([here.points[:, :2] + side * here.radius[:, None] for side in (-1, 1)]))
    (plan.build_street if outdoors else plan.build_room)(reach, builder.from_world(path), rng)
    return builder.finish()


def find_sits(motion: Motion) -> list[_Sit]:
    """Every seat that the motion needs, the longest used first; sits in one place share one."""
    feet = foot_points(motion)
    pelvis = motion.joint("pelvis")
    place = pelvis.t.double().numpy()
    unsupported = (off_balance(motion) > OFF_BALANCE_M) | (feet[..., 2].min(1) > LOWEST_STEP_M)
    still = _speed(motion, place) < STILL
    angles = []  # of the thighs from vertical
    for side in ("left", "right"):
        thigh = (motion.joint(f"{side}_knee").t - motion.joint(f"{side}_hip").t).double().numpy()
        angles.append(np.arccos(np.clip(-thigh[:, 2] / np.linalg.norm(thigh, axis=1), -1.0, 1.0)))
    sitting = still & (np.minimum(*angles) > np.deg2rad(BENT_DEG)) & unsupported
    forward = pelvis.R[..., 0].double().numpy()
    sits: list[_Sit] = []
    for start, stop in sorted(_stretches(sitting, motion, SIT_S), key=lambda span: span[0] - span[1]):
        middle = np.median(place[start:stop], axis=0) - [0.0, 0.0, PELVIS_OVER_SEAT_M]
        x, y, _ = forward[start:stop].sum(0)
        same = [k for k, other in enumerate(sits) if np.linalg.norm(middle - other.place) < 0.35]
        if not same:
            sits.append(_Sit(start, stop, middle, float(np.arctan2(y, x))))
        elif middle[2] < sits[same[0]].place[2]:  # A seat does not reach into its lowest sitter.
            at = sits[same[0]].place
            sits[same[0]] = replace(sits[same[0]], place=np.array([at[0], at[1], middle[2]]))
    return sits


def find_treads(motion: Motion, sits: list[_Sit]) -> list[_Tread]:
    """Rectangles below feet at rest above the floor, those of one step merged into one."""
    feet, mass = foot_points(motion), mass_center(motion)[:, 2]
    step_s = 1.0 / motion.fps
    smooth = scipy.ndimage.gaussian_filter1d(mass, 2.0, mode="nearest")
    flying = np.gradient(np.gradient(smooth, step_s), step_s) < FLYING
    seated = np.zeros(len(feet), bool)
    for sit in sits:
        near = np.linalg.norm(motion.t_world_root.double().numpy() - sit.place - [0, 0, PELVIS_OVER_SEAT_M], axis=1)
        seated |= near < 0.15
    soles = feet.reshape(len(feet), 2, 2, 3)
    patch = soles[..., 2].argmin(2)
    lowest = np.take_along_axis(soles, patch[..., None, None], 2)[:, :, 0]
    resting = np.stack([_speed(motion, lowest[:, side]) for side in (0, 1)], 1) < RESTING
    above = (lowest[..., 2] > LOWEST_STEP_M) & (motion.t_world_root.double().numpy()[:, None, 2] > lowest[..., 2] + 0.3)
    lower = lowest[..., 2] <= lowest[..., 2].min(1, keepdims=True) + 0.02
    stands = resting & above & lower & ~flying[:, None] & ~seated[:, None]
    rests = resting & above & seated[:, None]
    spans = [
        (side, start, stop)
        for holds, least_s in ((stands, STEP_S), (rests, FOOT_REST_S))
        for side in (0, 1)
        for start, stop in _stretches(holds[:, side], motion, least_s)
    ]
    if not spans:
        return []
    # rectangles around the soles of the spans, in axes that most of them point along
    stances = [soles[start:stop, side] for side, start, stop in spans]
    along = np.array([(s[:, 1] - s[:, 0])[:, :2].mean(0) for s in stances])
    angle = np.arctan2(along[:, 1], along[:, 0])
    heading = float(np.angle(np.exp(2j * angle).sum()) / 2)
    treads: list[_Tread] = []
    for stance in stances:
        xy = stance[..., :2].reshape(-1, 2) @ turn(heading)
        z = float(np.quantile(stance[..., 2].min(1), 0.3))
        new = _Tread(xy.min(0) - SOLE_WIDTH_M / 2, xy.max(0) + SOLE_WIDTH_M / 2, z, heading)
        for other in list(treads):
            # One step: of one height, and near each other along it or overlapping.
            apart = np.maximum(np.maximum(other.low - new.high, new.low - other.high), 0.0)
            if abs(other.z - new.z) >= 0.08 or apart[0] != 0.0 or apart[1] >= 0.4:
                continue
            treads.remove(other)
            new = _Tread(np.minimum(new.low, other.low), np.maximum(new.high, other.high), min(z, other.z), heading)
        treads.append(new)
    return sorted(treads, key=lambda tread: tread.z)


def _meets(
    body: BodySpace,
    piece: Piece,
    position: Float[np.ndarray, "3"],
    heading: float,
    margin: float,
    may_touch: dict[str, float] | None = None,
) -> bool:
    """Whether a body comes nearer than `margin` (m) to a piece at a place in the world, as `BodySpace.meets`."""
    corners = np.array([np.abs(part.center) + np.array(part.box_size) / 2 for part in piece.parts])
    body = body.around(position, float(np.linalg.norm(corners.max(0))) + margin)
    for part in piece.parts:
        center = position + np.append(turn(heading) @ np.array(part.center[:2]), part.center[2])
        if body.meets(center, np.array(part.box_size), heading, margin, may_touch):
            return True
    return False


STOOLS: dict[str, Callable[[np.random.Generator], Piece]] = {}
"""Makers of seats without a back by kind."""


@entered(STOOLS, "stool")
def _stool(rng: np.random.Generator) -> Piece:
    """A seat without a back on four legs or a block."""
    wide, seat, color = rng.uniform(0.32, 0.42), 0.45, wood(rng)
    tall, edge = seat - THICK_M, wide / 2 - 0.03
    rows = [(0, 0, tall / 2, 0.8 * wide, 0.8 * wide, tall, color, 8.0)]
    if rng.uniform() < 0.7:
        rows = [(x * edge, y * edge, tall / 2, 0.035, 0.035, tall, color, 8.0) for x in BOTH for y in BOTH]
    rows.append((0, 0, seat - THICK_M / 2, wide, wide, THICK_M, hue(rng), 20.0))
    return _seat(wide, seat, rows)


@entered(STOOLS, "pedestal")
def _pedestal(rng: np.random.Generator, wide: float = 0.30) -> Piece:
    """A round seat on a column."""
    seat = 0.45
    tall = seat - THICK_M
    rows = [
        (0, 0, 0.01, 0.8 * wide, 0, 0.02, IRON, 8.0, 8),
        (0, 0, tall / 2, 0.05, 0, tall, (0.5, 0.5, 0.52), 8.0, 8),
        (0, 0, seat - THICK_M / 2, wide, 0, THICK_M, hue(rng), 20.0, 8),
    ]
    return _seat(wide, seat, rows)


STOOLS["small pedestal"] = partial(STOOLS["pedestal"], wide=0.18)


def _seat(wide: float, seat: float, rows: list[tuple]) -> Piece:
    return Piece("stool", (wide, wide), (0.0, seat), parts_of(rows), seats=((0.0, 0.0, seat, 0.0, wide / 2),))


_FORMS = ((True, 1.0), (True, 0.7), (True, 0.45), (False, 1.0), (False, 0.6), (False, 0.35), (False, 0.15))
"""Forms of a step: whether solid or a board, and the share of the feet's length on it."""


def _clear(body: BodySpace, tread: _Tread, solid: bool) -> bool:
    thick = tread.z if solid else THICK_M
    center = np.array([*tread.center, tread.z - thick / 2])
    return not body.meets(center, np.array([*tread.size, thick]), tread.heading, 0.0, ON_STEP)


def _speed(motion: Motion, path: Float[np.ndarray, "time 3"]) -> Float[np.ndarray, "time"]:
    return np.linalg.norm(np.gradient(path, motion.timestamps.numpy(), axis=0), axis=1)


def _stretches(holds: Bool[np.ndarray, "time"], motion: Motion, least_s: float) -> list[tuple[int, int]]:
    """First frame and end of every run of true frames that lasts long enough."""
    edges = np.flatnonzero(np.diff(np.pad(holds, 1).astype(np.int8)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2]) if (b - a) / motion.fps >= least_s]
