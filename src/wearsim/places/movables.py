"""Objects that a wearer slides or carries: their shape, their support, and the places where hands hold them.

Each maker draws sizes and colours and returns a Movable without a name of its own: front +x, origin on the floor below
its middle. Sofas, tables and chairs slide, boxes are carried between both palms, `HANDHELDS` in one hand or both.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float

from wearcap.geometry import rotation
from wearcap.geometry.mesh import Mesh, merged
from wearcap.geometry.rigid import Rigid
from wearcap.scene.objects import Freedom, SceneObject
from wearsim.handling.grips import SKIN_M, GripPlace, Handled, Vector, vector
from wearsim.places.builder import Color, Part, Piece, entered, hue
from wearsim.places.furniture import MAKERS, wood
from wearsim.places.outline import rectangle, turn

Side = tuple[GripPlace, GripPlace, float]
HANDHELDS = ("suitcase", "backpack", "bottle", "tool", "ball")
"""Categories of objects that are carried, in one hand or both."""
DARK: Color = (0.13, 0.13, 0.15)
STEEL: Color = (0.62, 0.63, 0.66)
ROUND = 20
"""Number of corners of a round outline."""
QUARTERS = (0.0, np.pi / 2, np.pi, -np.pi / 2)
HANDS = (("left", 1.0), ("right", -1.0))
"""Hands with the sign of their side."""
UP: Vector = (0.0, 0.0, 1.0)
ALONG_X, ALONG_Y = (np.roll(np.eye(3), 1, axis) for axis in (0, 1))
"""Rotations that lay a mesh made about z along x or y."""


@dataclass(frozen=True)
class Rail:
    """A straight segment of an object on which hands rest, for a holder on one side of it; in the object's axes."""

    start: Vector
    """End on the holder's left (m)."""
    stop: Vector
    normal: Vector
    fingers: Vector
    facing: float
    """Heading of the holder relative to the object's (rad)."""
    stand_off: float
    """Distance from the middle of the rail back to the footprint's edge, against `facing` (m)."""
    both_hands: bool = True
    spare: Vector = (0.0, 0.0, 0.0)
    """Displacement to the far edge of the band along the rail in which hands can rest (m)."""

    @property
    def length(self) -> float:
        return float(np.linalg.norm(np.subtract(self.stop, self.start)))

    def at(self, along: float, tilt: float = 0.0, across: float = 0.0) -> GripPlace:
        """A place `along` the rail from its start (m), the hand tipped towards the holder by `tilt` (rad).

        `across` is its share of the way to the far edge of the rail's band.
        """
        share = along / self.length if self.length > 0 else 0.0
        point = np.array(self.start) + share * np.subtract(self.stop, self.start) + across * np.array(self.spare)
        normal, fingers = np.array(self.normal), np.array(self.fingers)
        cos, sin = np.cos(tilt), np.sin(tilt)
        normal, fingers = cos * normal - sin * fingers, cos * fingers + sin * normal
        return GripPlace(vector(point + SKIN_M * normal), vector(normal), vector(fingers))


@dataclass(frozen=True)
class _Grasp:
    """A grasp of an object with one hand."""

    side: str
    """Side of the hand."""
    place: GripPlace
    facing: float
    """Heading of the holder relative to the object's (rad)."""


@dataclass(frozen=True, eq=False)
class Movable(Handled):
    """An object to be moved by hand; its own axes have the front at +x, the origin on the floor below its middle."""

    half_size: tuple[float, float]
    """Half size of the footprint along the object's x and y (m)."""
    height: float
    rails: tuple[Rail, ...] = ()
    """Rails where it is pushed and pulled."""
    sides: tuple[Side, ...] = ()
    """Options for lifting it between both hands: the left and right palm's places and the holder's relative heading."""
    grasps: tuple[_Grasp, ...] = ()
    """Options for lifting it with one hand."""

    @property
    def outline(self) -> Float[np.ndarray, "4 2"]:
        """Outline from above, in its own axes, counter-clockwise (m)."""
        return rectangle((0.0, 0.0), (2 * self.half_size[0], 2 * self.half_size[1]))

    def placed(self, x: float, y: float, heading: float, z: float = 0.0) -> "Movable":
        """The same object with another initial pose (m, rad)."""
        R, t = rotation.about_axis("z", torch.tensor(heading)), torch.tensor([x, y, z])
        return replace(self, object=replace(self.object, R_world_object=R, t_world_object=t))


MOVABLES: dict[str, Callable[[np.random.Generator], Movable]] = {}
"""Makers by category."""
TOOLS: dict[str, Callable[[np.random.Generator], Movable]] = {}
"""Makers of the kinds of tool."""


def floor_pose(place: Float[np.ndarray, "*batch 3"], z: float | np.ndarray = 0.0) -> Rigid:
    """Pose of an object that stands at x, y with a heading (m, m, rad), `z` above the world's zero (m)."""
    at = torch.from_numpy(np.asarray(place, np.float64))
    height = torch.as_tensor(np.asarray(z, np.float64)).expand(at.shape[:-1])
    return Rigid(rotation.about_axis("z", at[..., 2]), torch.cat([at[..., :2], height[..., None]], -1))


def make_movable(category: str, name: str, rng: np.random.Generator) -> Movable:
    """A movable object of a category of `MOVABLES` with drawn size and colour, at the world's origin."""
    made = MOVABLES[category](rng)
    return replace(made, object=replace(made.object, name=name, category=category))


def _made(kind: str, mesh: Mesh, size: tuple[float, float], height: float, **holds) -> Movable:
    """A movable of a size along its x and y (m); `holds` are its ways to be held."""
    scene_object = SceneObject("", "", mesh, torch.eye(3), torch.zeros(3), Freedom(kind))
    return Movable(scene_object, (size[0] / 2, size[1] / 2), height, **holds)


def _sliding(piece: Piece, rails: list[Rail]) -> Movable:
    return _made("plane", piece.mesh(), piece.size, piece.z_range[1], rails=tuple(rails))


@entered(MOVABLES, "sofa")
def _sofa(rng: np.random.Generator) -> Movable:
    """A sofa, held at the upper edge of its back from behind, or of an arm from that side."""
    piece = MAKERS["armchair" if rng.random() < 0.3 else "sofa"](rng)
    half_depth, half_width = piece.size[0] / 2, piece.size[1] / 2
    x, y = -half_depth + 0.012, half_width - 0.1
    rails = [Rail((x, y, 0.85), (x, -y, 0.85), UP, (1.0, 0.0, 0.0), 0.0, 0.012, spare=(0.18, 0.0, 0.0))]
    for sign in (1.0, -1.0):
        y = sign * (half_width - 0.015)
        ends = (half_depth - 0.06, y, 0.62), (-half_depth + 0.3, y, 0.62)
        # who looks at the right arm (sign < 0) has the sofa's back on the left
        spare = (0.0, -0.12 * sign, 0.0)
        rails.append(Rail(*ends[:: int(sign)], UP, (0.0, -sign, 0.0), -sign * np.pi / 2, 0.015, spare=spare))
    return _sliding(piece, rails)


@entered(MOVABLES, "table")
def _table(rng: np.random.Generator) -> Movable:
    """A table, held at its top's edges."""
    piece = MAKERS["table"](rng)
    bare = replace(piece, parts=piece.parts[:5])  # The four legs and the top; nothing stands on a table that is moved.
    half, top = np.array(piece.size) / 2, piece.z_range[1]
    rails = []
    for facing in QUARTERS:
        ahead, left = turn(facing).T
        deep, wide = abs(ahead @ half), abs(left @ half) - 0.08
        edge = -(deep - 0.012) * ahead
        start, stop = (vector(np.append(edge + sign * wide * left, top)) for sign in (1.0, -1.0))
        fingers, spare = (float(ahead[0]), float(ahead[1]), 0.0), vector(np.append(0.22 * ahead, 0.0))
        rails.append(Rail(start, stop, UP, fingers, facing, 0.012, spare=spare))
    return _sliding(bare, rails)


@entered(MOVABLES, "chair")
def _chair(rng: np.random.Generator) -> Movable:
    """A chair, held at the top of its backrest, from behind or, with one hand, from beside it."""
    piece = MAKERS["chair"](rng)
    half_depth, half_width, top = piece.size[0] / 2, piece.size[1] / 2, piece.z_range[1]
    x = -half_depth + 0.02
    rails = [Rail((x, half_width - 0.04, top), (x, 0.04 - half_width, top), UP, (1.0, 0.0, 0.0), 0.0, 0.02)]
    for sign in (1.0, -1.0):
        end = (x, sign * (half_width - 0.06), top)
        rails.append(Rail(end, end, UP, (0.0, -sign, 0.0), -sign * np.pi / 2, 0.06, both_hands=False))
    return _sliding(piece, rails)


@entered(MOVABLES, "box")
def _carton(rng: np.random.Generator) -> Movable:
    """A box, lifted between the palms, which press on two opposite faces."""
    depth, width = rng.uniform(0.20, 0.45), rng.uniform(0.25, 0.55)
    height, color = (rng.uniform(0.20, 0.50), hue(rng, (0.2, 0.6)) if rng.random() < 0.4 else (0.68, 0.52, 0.35))
    piece = Piece("box", (depth, width), (0.0, height), (Part((0, 0, height / 2), (depth, width, height), color),))
    level = float(rng.uniform(0.35, 0.6) + 0.6 * max(height - 0.3, 0.0)) * height
    sides = []
    for facing, half in ((0.0, width / 2), (np.pi, width / 2), (np.pi / 2, depth / 2), (-np.pi / 2, depth / 2)):
        ahead, left = (np.append(axis, 0.0) for axis in turn(facing).T)
        fingers = vector((ahead - 0.35 * np.array(UP)) / np.hypot(1.0, 0.35))
        hands = (
            GripPlace(vector(sign * (half + SKIN_M) * left + [0.0, 0.0, level]), vector(sign * left), fingers)
            for _, sign in HANDS
        )
        sides.append((*hands, facing))
    return _made("free", piece.mesh(), piece.size, height, sides=tuple(sides))


@entered(MOVABLES, "suitcase")
def _suitcase(rng: np.random.Generator) -> Movable:
    """A suitcase, long along x; a bar on top is held by a hand beside the body."""
    length, thick = rng.uniform(0.36, 0.50), rng.uniform(0.18, 0.24)
    body, handle = rng.uniform(0.34, 0.50), rng.uniform(0.035, 0.05)
    wheel, color = rng.uniform(0.02, 0.03), hue(rng, (0.3, 0.8))
    top = wheel + body
    level = top + handle
    profile = [(0.94, wheel), (1.0, wheel + 0.02), (1.0, top - 0.02), (0.94, top)]
    parts = [
        _loft(_squircle(length, thick, 6.0), profile, color),
        *_boxes((x, 0.0, wheel + body / 2, 0.012, thick + 0.004, 0.92 * body) for x in (-length / 4, length / 4)),
        *_boxes((x, 0.0, top + handle / 2, 0.018, 0.02, handle) for x in (-0.065, 0.065)),
        *_boxes([(0.0, 0.0, level, 0.148, 0.022, 0.022)]),
    ]
    for x in (-length / 2 + 0.05, length / 2 - 0.05):
        for y in (-thick / 2 + 0.03, thick / 2 - 0.03):
            parts.append(_disc(wheel, 0.02, DARK, (x, y, wheel)))
    grasps = _beside_body((0.0, 0.0, level), (0.0, np.pi))
    return _made("free", merged(parts), (length, thick + 0.004), level + 0.011, grasps=grasps)


@entered(MOVABLES, "backpack")
def _backpack(rng: np.random.Generator) -> Movable:
    """A backpack, upright on the floor, its pocket at the front; held by the loop on top, or between both palms."""
    depth, width = rng.uniform(0.17, 0.24), rng.uniform(0.27, 0.34)
    body, color = rng.uniform(0.38, 0.48), hue(rng, (0.2, 0.8))
    shares = [(0.86, 0.0), (0.97, 0.05), (1.0, 0.2), (1.0, 0.55), (0.97, 0.75), (0.86, 0.9), (0.6, 0.98), (0.3, 1.0)]  # fmt: skip
    shade: Color = (0.75 * color[0], 0.75 * color[1], 0.75 * color[2])
    of_pocket = [(0.85, 0.04), (1.0, 0.08), (1.0, 0.4 * body), (0.7, 0.46 * body)]
    pocket = _loft(_squircle(0.08, 0.72 * width, 4.0), of_pocket, shade)
    loop = body + 0.045
    parts = [
        _loft(_squircle(depth, width, 4.0), [(scale, share * body) for scale, share in shares], color),
        _turned(pocket, np.eye(3), (depth / 2 - 0.01, 0.0, 0.0)),
        *_boxes((-depth / 2 - 0.004, y, 0.5 * body, 0.016, 0.05, 0.72 * body) for y in (-0.09, 0.09)),
        *_boxes((0.0, y, body + 0.015, 0.022, 0.014, 0.06) for y in (-0.05, 0.05)),
        *_boxes([(0.0, 0.0, loop, 0.022, 0.114, 0.014)]),
    ]
    sides = _between({0.0: width / 2, np.pi: width / 2}, float(rng.uniform(0.42, 0.55)) * body)
    grasps = _beside_body((0.0, 0.0, loop), (np.pi / 2, -np.pi / 2))
    return _made("free", merged(parts), (depth + 0.06, width), loop + 0.007, sides=sides, grasps=grasps)


@entered(MOVABLES, "bottle")
def _bottle(rng: np.random.Generator) -> Movable:
    """A cylinder with a neck and a cap, held about its middle."""
    radius, height = rng.uniform(0.031, 0.042), rng.uniform(0.20, 0.30)
    neck, color = rng.uniform(0.012, 0.016), hue(rng, (0.2, 0.9))
    share = neck / radius
    profile = [(0.92, 0.0), (1.0, 0.008), (1.0, 0.66 * height), (0.8, 0.76 * height), (share, 0.84 * height)]
    parts = [
        _loft(_round(radius), [*profile, (share, 0.94 * height)], color),
        _loft(_round(1.25 * neck), [(1.0, 0.93 * height), (1.0, height)], hue(rng, (0.0, 0.3))),
    ]
    level, reach = 0.42 * height, radius + SKIN_M
    grasps = tuple(
        _grasp(side, (0.0, sign * reach, level), (0.0, sign, 0.0), (0.9, 0.0, -0.44), facing)
        for facing in np.arange(8) * np.pi / 4
        for side, sign in HANDS
    )
    return _made("free", merged(parts), (2 * radius, 2 * radius), height, grasps=grasps)


@entered(MOVABLES, "tool")
def _tool(rng: np.random.Generator) -> Movable:
    """A hammer or a mop, which lie on the floor along x, or a drill, which stands on its battery."""
    return list(TOOLS.values())[int(rng.integers(3))](rng)


@entered(TOOLS, "hammer")
def _hammer(rng: np.random.Generator) -> Movable:
    """A hammer with its head at +x, held at the other end of the handle from above."""
    length, head = rng.uniform(0.26, 0.36), rng.uniform(0.09, 0.13)
    thick = rng.uniform(0.024, 0.034)
    z, x = thick / 2, length / 2 - thick / 2
    parts = [
        *_boxes([(-thick / 2, 0.0, z, length - thick, 0.028, 0.9 * thick)], wood(rng)),
        *_boxes([(-length / 2 + 0.07, 0.0, z, 0.13, 0.031, thick)], hue(rng, (0.3, 0.9))),
        *_boxes([(x, 0.0, z, thick, 0.6 * head, thick)], STEEL),
        *(_disc(thick / 2, 0.25 * head, STEEL, (x, sign * 0.38 * head, z)) for sign in (1, -1)),
    ]
    return _made("free", merged(parts), (length, head), thick, grasps=_from_above(-length / 2 + 0.08, thick))


@entered(TOOLS, "drill")
def _drill(rng: np.random.Generator) -> Movable:
    """A cordless drill: its chuck is at +x, the grip held from behind."""
    color, grip, scale = hue(rng, (0.5, 0.9)), (0.2, 0.2, 0.22), rng.uniform(0.9, 1.15)
    barrel = _loft(_round(0.03 * scale), [(0.8, -0.09), (1.0, -0.07), (1.0, 0.06), (0.7, 0.09)], color)
    chuck = _loft(_round(0.019 * scale), [(1.0, 0.085), (0.6, 0.125)], DARK)
    bit = _loft(_round(0.004), [(1.0, 0.12), (1.0, 0.175)], STEEL)
    z = 0.19 * scale
    parts = [
        _loft(_squircle(0.115 * scale, 0.074 * scale, 5.0), [(1.0, 0.0), (1.0, 0.045 * scale)], grip),
        _loft(_squircle(0.046 * scale, 0.036 * scale, 3.0), [(1.1, 0.04 * scale), (1.0, z)], grip),
        *(_turned(part, ALONG_X, (0.0, 0.0, z)) for part in (barrel, chuck, bit)),
    ]
    reach, level = 0.018 * scale + SKIN_M, 0.115 * scale
    grasps = tuple(
        _grasp(side, (0.0, sign * reach, level), (0.0, sign, 0.0), (0.96, 0.0, -0.28), 0.0) for side, sign in HANDS
    )
    return _made("free", merged(parts), (0.35, 0.074 * scale), z + 0.03 * scale, grasps=grasps)


@entered(TOOLS, "mop")
def _mop(rng: np.random.Generator) -> Movable:
    """A stick with a round head at -x, held near its other end from above."""
    length, radius = rng.uniform(1.15, 1.35), rng.uniform(0.04, 0.06)
    stick, head = 0.012, 0.09
    rod = _loft(_round(stick), [(1.0, 0.0), (1.0, length - head + 0.02)], wood(rng))
    rag = _loft(_round(radius), [(1.0, 0.0), (1.0, 0.6 * head), (0.4, head)], hue(rng, (0.1, 0.6)))
    far = length / 2
    # along x, sloping from the head's middle down to the stick's other end, which lies on the floor
    slope = np.arcsin((radius - stick) / (length - head))
    ahead = np.array([np.cos(slope), 0.0, -np.sin(slope)])
    R = np.stack([np.array([-ahead[2], 0.0, ahead[0]]), np.array([0.0, -1.0, 0.0]), ahead], 1)
    tail = np.array([-far, 0.0, radius])
    mesh = merged([_turned(rag, R, tail), _turned(rod, R, tail + (head - 0.02) * ahead)])
    low = float(mesh.vertices[:, 2].min())
    x = far - rng.uniform(0.16, 0.24)
    grasps = _from_above(x, radius - low + (x + far) * ahead[2] + stick)
    return _made("free", _turned(mesh, np.eye(3), (0.0, 0.0, -low)), (length, 2 * radius), 2 * radius, grasps=grasps)


@entered(MOVABLES, "ball")
def _ball(rng: np.random.Generator) -> Movable:
    """A ball, held between both palms."""
    radius = rng.uniform(0.095, 0.125)
    angle = np.linspace(0.0, np.pi, 15)[1:-1]
    profile = [(np.sin(a), radius * (1.0 - np.cos(a))) for a in angle]
    colors = [hue(rng, (0.4, 0.9)), hue(rng, (0.0, 0.4))]
    mesh = _loft(_round(radius, 24), profile, colors[0], poles=(0.0, 2 * radius))
    wedge = np.arctan2(mesh.vertices[:, 1], mesh.vertices[:, 0]) // (np.pi / 3) % 2 == 0
    rows = np.where(wedge[:, None], np.array(colors[0]), np.array(colors[1])).astype(np.float32)
    sides = _between(dict.fromkeys(QUARTERS, radius), radius)
    return _made("free", replace(mesh, color=rows), (2 * radius, 2 * radius), 2 * radius, sides=sides)


def _beside_body(bar: Vector, facings: Sequence[float]) -> tuple[_Grasp, ...]:
    """Grasps of either hand on a bar along the holder's heading, beside the body, fingers down, palm inwards."""
    x, y, z = bar
    out = 0.011 + SKIN_M
    return tuple(
        _grasp(side, (x, y + sign * out, z + 0.008), (0.0, sign, 0.0), (0.2, 0.0, -0.98), facing)
        for facing in facings
        for side, sign in HANDS
    )


def _from_above(x: float, top: float) -> tuple[_Grasp, ...]:
    """Grasps of either hand across a handle that lies along x, thumb towards +x."""
    return tuple(
        _Grasp(side, GripPlace((x, 0.0, top + SKIN_M), UP, (0.0, sign, 0.0)), sign * np.pi / 2) for side, sign in HANDS
    )


def _between(halves: dict[float, float], level: float) -> tuple[Side, ...]:
    """Both palms on opposite faces at a height; `halves` maps the holder's facing to half their distance (m)."""
    sides = []
    for facing, half in halves.items():
        left, right = (
            _grasp(side, (0.0, sign * (half + SKIN_M), level), (0.0, sign, 0.0), (0.94, 0.0, -0.33), facing).place
            for side, sign in HANDS
        )
        sides.append((left, right, facing))
    return tuple(sides)


def _grasp(side: str, point, normal, fingers, facing: float) -> _Grasp:
    """A grasp given in the holder's axes (x ahead) about the object's origin."""
    R = np.eye(3)
    R[:2, :2] = turn(facing)
    unit = np.array(fingers) / np.linalg.norm(fingers)
    return _Grasp(side, GripPlace(*(vector(R @ np.array(part)) for part in (point, normal, unit))), float(facing))


def _round(radius: float, corners: int = ROUND) -> Float[np.ndarray, "corner 2"]:
    angle = np.arange(corners) * 2 * np.pi / corners
    return radius * np.stack([np.cos(angle), np.sin(angle)], 1)


def _squircle(length: float, width: float, power: float) -> Float[np.ndarray, "corner 2"]:
    """A rectangle with rounded corners: |x|ᵖ + |y|ᵖ = 1."""
    angle = np.arange(32) * 2 * np.pi / 32
    cos, sin = np.cos(angle), np.sin(angle)
    radius = (np.abs(cos) ** power + np.abs(sin) ** power) ** (-1 / power)
    return np.stack([cos * radius * length / 2, sin * radius * width / 2], 1)


def _loft(
    outline: Float[np.ndarray, "corner 2"],
    profile: Sequence[tuple[float, float]],
    color: Color,
    poles: tuple[float, float] | None = None,
) -> Mesh:
    """A closed solid of an outline (counter-clockwise) scaled at rising heights (m), capped flat or by `poles`."""
    count, rings = len(outline), len(profile)
    low, high = poles if poles is not None else (profile[0][1], profile[-1][1])
    vertices = [np.concatenate([scale * outline, np.full((count, 1), z)], 1) for scale, z in profile]
    points = np.concatenate([*vertices, np.array([[0.0, 0.0, low], [0.0, 0.0, high]])]).astype(np.float32)
    k = np.arange(count)
    nxt = (k + 1) % count
    faces = []
    for ring in range(rings - 1):
        a, b = ring * count, (ring + 1) * count
        faces += [np.stack([a + k, a + nxt, b + nxt], 1), np.stack([a + k, b + nxt, b + k], 1)]
    bottom, top, last = rings * count, rings * count + 1, (rings - 1) * count
    faces += [np.stack([np.full(count, bottom), nxt, k], 1), np.stack([np.full(count, top), last + k, last + nxt], 1)]
    return Mesh(points, np.concatenate(faces).astype(np.int32), np.tile(np.float32(color), (len(points), 1)))


def _boxes(rows: Iterable[tuple[float, ...]], color: Color = DARK) -> list[Mesh]:
    """Boxes of one colour: the middle of each, then its size (m)."""
    solids = []
    for x, y, z, *size in rows:
        profile = [(1.0, z - size[2] / 2), (1.0, z + size[2] / 2)]
        solids.append(_turned(_loft(rectangle((0.0, 0.0), (size[0], size[1])), profile, color), np.eye(3), (x, y, 0.0)))
    return solids


def _disc(radius: float, thick: float, color: Color, at: Vector) -> Mesh:
    """A disc about an axis along y (m)."""
    return _turned(_loft(_round(radius), [(1.0, -thick / 2), (1.0, thick / 2)], color), ALONG_Y, at)


def _turned(mesh: Mesh, R: Float[np.ndarray, "3 3"], t: Vector | Float[np.ndarray, "3"]) -> Mesh:
    return Mesh((mesh.vertices @ R.T + np.array(t)).astype(np.float32), mesh.faces, mesh.color, mesh.smooth)
