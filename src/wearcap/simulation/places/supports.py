"""Supports of a captured motion: seats below sitters, steps and rungs below climbers.

Found by balance: a body that is still with bent hips while its centre of mass is not over the feet, or both feet
are off the floor, sits; a lower foot at rest above the floor while the body does not fly stands on a step.
The floor is at z = 0.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, product

import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Float

from wearcap.recording.motion import Motion
from wearcap.simulation.people.body_space import BodySpace, foot_points, mass_center
from wearcap.simulation.places.builder import Piece, WorldBuilder, entered, hue
from wearcap.simulation.places.furniture import BOTH, IRON, MAKERS, parts_of, wood
from wearcap.simulation.places.outline import rectangle, turn

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
class Sit:
    """An interval of sitting in one place."""

    start: int
    stop: int
    place: Float[np.ndarray, "3"]
    """Position of the buttocks (m)."""
    heading: float


@dataclass(frozen=True, eq=False)
class Tread:
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


def find_sits(motion: Motion) -> list[Sit]:
    """Every seat that the motion needs, the longest used first; sits in one place share one."""
    feet = foot_points(motion)
    pelvis = motion.joint("pelvis")
    place = pelvis.t.double().numpy()
    off_balance = _outside(mass_center(motion)[:, :2], feet[..., :2]) > OFF_BALANCE_M
    hanging = feet[..., 2].min(1) > LOWEST_STEP_M
    still = _speed(motion, place) < STILL
    angles = []  # of the thighs from vertical
    for side in ("left", "right"):
        thigh = (motion.joint(f"{side}_knee").t - motion.joint(f"{side}_hip").t).double().numpy()
        angles.append(np.arccos(np.clip(-thigh[:, 2] / np.linalg.norm(thigh, axis=1), -1.0, 1.0)))
    sitting = still & (np.minimum(*angles) > np.deg2rad(BENT_DEG)) & (off_balance | hanging)
    forward = pelvis.R[..., 0].double().numpy()
    sits: list[Sit] = []
    for start, stop in sorted(_stretches(sitting, motion, SIT_S), key=lambda span: span[0] - span[1]):
        middle = np.median(place[start:stop], axis=0) - [0.0, 0.0, PELVIS_OVER_SEAT_M]
        x, y, _ = forward[start:stop].sum(0)
        same = [k for k, other in enumerate(sits) if np.linalg.norm(middle - other.place) < 0.35]
        if not same:
            sits.append(Sit(start, stop, middle, float(np.arctan2(y, x))))
        elif middle[2] < sits[same[0]].place[2]:  # A seat does not reach into its lowest sitter.
            at = sits[same[0]].place
            sits[same[0]] = replace(sits[same[0]], place=np.array([at[0], at[1], middle[2]]))
    return sits


def find_treads(motion: Motion, sits: list[Sit]) -> list[Tread]:
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
    return _merged(soles, spans)


def _merged(soles: Float[np.ndarray, "time 2 2 3"], spans: list[tuple[int, int, int]]) -> list[Tread]:
    """Rectangles around the soles of the spans (side, start, stop), in axes that most of them point along."""
    if not spans:
        return []
    stances = [soles[start:stop, side] for side, start, stop in spans]
    along = np.array([(s[:, 1] - s[:, 0])[:, :2].mean(0) for s in stances])
    angle = np.arctan2(along[:, 1], along[:, 0])
    heading = float(np.angle(np.exp(2j * angle).sum()) / 2)
    treads: list[Tread] = []
    for stance in stances:
        xy = stance[..., :2].reshape(-1, 2) @ turn(heading)
        z = float(np.quantile(stance[..., 2].min(1), 0.3))
        new = Tread(xy.min(0) - SOLE_WIDTH_M / 2, xy.max(0) + SOLE_WIDTH_M / 2, z, heading)
        for other in list(treads):
            # One step: of one height, and near each other along it or overlapping.
            apart = np.maximum(np.maximum(other.low - new.high, new.low - other.high), 0.0)
            if abs(other.z - new.z) >= 0.08 or apart[0] != 0.0 or apart[1] >= 0.4:
                continue
            treads.remove(other)
            new = Tread(np.minimum(new.low, other.low), np.maximum(new.high, other.high), min(z, other.z), heading)
        treads.append(new)
    return sorted(treads, key=lambda tread: tread.z)


def build_seat(
    builder: WorldBuilder, body: BodySpace, sit: Sit, rng: np.random.Generator
) -> tuple[Piece, np.ndarray, float] | None:
    """Place a seat of fitting height that the body touches only with the parts it sits on.

    Returns the piece with its place and heading in the builder's frame; None where not even a stool fits.
    """
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
            if not meets(body, piece, position, about, 0.0, {"seat": soft, **NEAR_SEAT}):
                place = np.array([*builder.from_world(position[:2]), 0.0])
                builder.place(piece, tuple(place.tolist()), about - builder.heading)
                return piece, place, about - builder.heading
    return None


def meets(
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


STOOLS["small pedestal"] = partial(_pedestal, wide=0.18)


def _seat(wide: float, seat: float, rows: list[tuple]) -> Piece:
    return Piece("stool", (wide, wide), (0.0, seat), parts_of(rows), seats=((0.0, 0.0, seat, 0.0, wide / 2),))


def build_tread(builder: WorldBuilder, body: BodySpace, tread: Tread, rng: np.random.Generator) -> Tread | None:
    """Build a step down to the floor, else a board or a rung, as large as the body leaves room for.

    Returns what was built (`heading` and corners of the world); None where not even a rung fits.
    """
    body = body.around(np.array([*tread.center, tread.z / 2]), max(tread.z / 2, 1.0))
    for (solid, share), along, lower in product(_FORMS, (0.5, 0.75, 0.25, 1.0, 0.0), (0.0, 0.03)):
        low, high = tread.low.copy(), tread.high.copy()
        low[0] += along * (1 - share) * tread.size[0]
        high[0] = low[0] + share * tread.size[0]
        small = replace(tread, low=low, high=high, z=tread.z - lower)
        if _clear(body, small, solid):
            grown = _grown(body, small, solid, rng)
            _add_step(builder, body, grown, solid, rng)
            return grown
    return None


_FORMS = ((True, 1.0), (True, 0.7), (True, 0.45), (False, 1.0), (False, 0.6), (False, 0.35), (False, 0.15))
"""Forms of a step: whether solid or a board, and the share of the feet's length on it."""


def _clear(body: BodySpace, tread: Tread, solid: bool) -> bool:
    thick = tread.z if solid else THICK_M
    center = np.array([*tread.center, tread.z - thick / 2])
    return not body.meets(center, np.array([*tread.size, thick]), tread.heading, 0.0, ON_STEP)


def _grown(body: BodySpace, tread: Tread, solid: bool, rng: np.random.Generator) -> Tread:
    """The tread widened on all sides while the body is clear of it, up to a drawn size."""
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
    return tread


def _add_step(builder: WorldBuilder, body: BodySpace, tread: Tread, solid: bool, rng: np.random.Generator) -> None:
    """The step, and for a board the posts that carry it where the body leaves room."""
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


def _speed(motion: Motion, path: Float[np.ndarray, "time 3"]) -> Float[np.ndarray, "time"]:
    return np.linalg.norm(np.gradient(path, motion.timestamps.numpy(), axis=0), axis=1)


def _stretches(holds: Bool[np.ndarray, "time"], motion: Motion, least_s: float) -> list[tuple[int, int]]:
    """First frame and end of every run of true frames that lasts long enough."""
    edges = np.flatnonzero(np.diff(np.pad(holds, 1).astype(np.int8)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2]) if (b - a) / motion.fps >= least_s]


def _outside(
    points: Float[np.ndarray, "time 2"], corners: Float[np.ndarray, "time corner 2"]
) -> Float[np.ndarray, "time"]:
    """Distance (m) of each point from the convex hull of its corners."""
    count = corners.shape[1]
    best = np.full(len(points), np.inf)
    for i, j in combinations(range(count), 2):
        edge, offset = corners[:, j] - corners[:, i], points - corners[:, i]
        share = np.clip((offset * edge).sum(1) / np.maximum((edge * edge).sum(1), 1e-12), 0.0, 1.0)
        best = np.minimum(best, np.linalg.norm(offset - share[:, None] * edge, axis=1))
    for three in combinations(range(count), 3):
        sides = []
        for a, b in zip(three, (*three[1:], three[0])):
            edge, offset = corners[:, b] - corners[:, a], points - corners[:, a]
            sides.append(edge[:, 0] * offset[:, 1] - edge[:, 1] * offset[:, 0])
        best[(np.min(sides, 0) >= 0) | (np.max(sides, 0) <= 0)] = 0.0
    return best
