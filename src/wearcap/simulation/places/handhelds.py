"""Objects carried in one hand or both: suitcases, backpacks, bottles, tools and balls, and where hands hold them.

Each maker draws sizes and colours and returns a Handheld: front +x, origin on the floor below its middle.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from wearcap.geometry.mesh import Mesh, merged
from wearcap.simulation.handling.grips import SKIN_M, GripPlace
from wearcap.simulation.places.builder import hue
from wearcap.simulation.places.furniture import wood
from wearcap.simulation.places.outline import rectangle, turn

Color = tuple[float, float, float]
Side = tuple[GripPlace, GripPlace, float]

DARK: Color = (0.13, 0.13, 0.15)
STEEL: Color = (0.62, 0.63, 0.66)
ROUND = 20
"""Number of corners of a round outline."""
QUARTERS = (0.0, np.pi / 2, np.pi, -np.pi / 2)


@dataclass(frozen=True)
class Grasp:
    """A grasp of an object with one hand."""

    side: str
    """Side of the hand."""
    place: GripPlace
    facing: float
    """Heading of the holder relative to the object's (rad)."""


@dataclass(frozen=True, eq=False)
class Handheld:
    """Shape of a hand-held object, as it stands or lies on the floor."""

    mesh: Mesh
    size: tuple[float, float]
    """Size of its outline along its x and y (m)."""
    height: float
    sides: tuple[Side, ...] = ()
    """Options for holding it between both palms."""
    grasps: tuple[Grasp, ...] = ()


def suitcase(rng: np.random.Generator) -> Handheld:
    """A suitcase, long along x; a bar on top is held by a hand beside the body."""
    length, thick = rng.uniform(0.36, 0.50), rng.uniform(0.18, 0.24)
    body, handle = rng.uniform(0.34, 0.50), rng.uniform(0.035, 0.05)
    wheel, color = rng.uniform(0.02, 0.03), hue(rng, (0.3, 0.8))
    top = wheel + body
    outline = _squircle(length, thick, 6.0)
    parts = [_loft(outline, [(0.94, wheel), (1.0, wheel + 0.02), (1.0, top - 0.02), (0.94, top)], color)]
    parts += [
        _box((x, 0.0, wheel + body / 2), (0.012, thick + 0.004, 0.92 * body), DARK) for x in (-length / 4, length / 4)
    ]
    parts += [_box((x, 0.0, top + handle / 2), (0.018, 0.02, handle), DARK) for x in (-0.065, 0.065)]
    parts.append(_box((0.0, 0.0, top + handle), (0.148, 0.022, 0.022), DARK))
    for x in (-length / 2 + 0.05, length / 2 - 0.05):
        for y in (-thick / 2 + 0.03, thick / 2 - 0.03):
            parts.append(_lying(_disc(wheel, 0.02, DARK), "y", (x, y, wheel)))
    level = top + handle
    grasps = _beside_body((0.0, 0.0, level), (0.0, np.pi))
    return Handheld(merged(parts), (length, thick + 0.004), level + 0.011, (), grasps)


def backpack(rng: np.random.Generator) -> Handheld:
    """A backpack, upright on the floor, its pocket at the front; held by the loop on top, or between both palms."""
    depth, width = rng.uniform(0.17, 0.24), rng.uniform(0.27, 0.34)
    body, color = rng.uniform(0.38, 0.48), hue(rng, (0.2, 0.8))
    outline = _squircle(depth, width, 4.0)
    shares = [(0.86, 0.0), (0.97, 0.05), (1.0, 0.2), (1.0, 0.55), (0.97, 0.75), (0.86, 0.9), (0.6, 0.98), (0.3, 1.0)]  # fmt: skip
    parts = [_loft(outline, [(scale, share * body) for scale, share in shares], color)]
    shade: Color = (0.75 * color[0], 0.75 * color[1], 0.75 * color[2])
    pocket = _loft(
        _squircle(0.08, 0.72 * width, 4.0), [(0.85, 0.04), (1.0, 0.08), (1.0, 0.4 * body), (0.7, 0.46 * body)], shade
    )
    parts.append(_moved(pocket, (depth / 2 - 0.01, 0.0, 0.0)))
    parts += [_box((-depth / 2 - 0.004, y, 0.5 * body), (0.016, 0.05, 0.72 * body), DARK) for y in (-0.09, 0.09)]
    loop = body + 0.045
    parts += [_box((0.0, y, body + 0.015), (0.022, 0.014, 0.06), DARK) for y in (-0.05, 0.05)]
    parts.append(_box((0.0, 0.0, loop), (0.022, 0.114, 0.014), DARK))
    level = float(rng.uniform(0.42, 0.55)) * body
    sides = _between({0.0: width / 2, np.pi: width / 2}, level)
    grasps = _beside_body((0.0, 0.0, loop), (np.pi / 2, -np.pi / 2))
    return Handheld(merged(parts), (depth + 0.06, width), loop + 0.007, sides, grasps)


def bottle(rng: np.random.Generator) -> Handheld:
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
    grasps = []
    for facing in np.arange(8) * np.pi / 4:
        for side, sign in (("left", 1.0), ("right", -1.0)):
            grasps.append(_grasp(side, (0.0, sign * reach, level), (0.0, sign, 0.0), (0.9, 0.0, -0.44), facing))
    return Handheld(merged(parts), (2 * radius, 2 * radius), height, (), tuple(grasps))


def tool(rng: np.random.Generator) -> Handheld:
    """A hammer or a mop, which lie on the floor along x, or a drill, which stands on its battery."""
    return (hammer, drill, mop)[int(rng.integers(3))](rng)


def hammer(rng: np.random.Generator) -> Handheld:
    """A hammer with its head at +x, held at the other end of the handle from above."""
    length, head = rng.uniform(0.26, 0.36), rng.uniform(0.09, 0.13)
    thick = rng.uniform(0.024, 0.034)
    z, x = thick / 2, length / 2 - thick / 2
    parts = [
        _box((-thick / 2, 0.0, z), (length - thick, 0.028, 0.9 * thick), wood(rng)),
        _box((-length / 2 + 0.07, 0.0, z), (0.13, 0.031, thick), hue(rng, (0.3, 0.9))),
        _box((x, 0.0, z), (thick, 0.6 * head, thick), STEEL),
        _lying(_disc(thick / 2, 0.25 * head, STEEL), "y", (x, 0.38 * head, z)),
        _lying(_disc(thick / 2, 0.25 * head, STEEL), "y", (x, -0.38 * head, z)),
    ]
    grasps = _from_above(-length / 2 + 0.08, thick)
    return Handheld(merged(parts), (length, head), thick, (), grasps)


def drill(rng: np.random.Generator) -> Handheld:
    """A cordless drill: its chuck is at +x, the grip held from behind."""
    color, grip, scale = hue(rng, (0.5, 0.9)), (0.2, 0.2, 0.22), rng.uniform(0.9, 1.15)
    barrel = _loft(_round(0.03 * scale), [(0.8, -0.09), (1.0, -0.07), (1.0, 0.06), (0.7, 0.09)], color)
    chuck = _loft(_round(0.019 * scale), [(1.0, 0.085), (0.6, 0.125)], DARK)
    bit = _loft(_round(0.004), [(1.0, 0.12), (1.0, 0.175)], STEEL)
    z = 0.19 * scale
    parts = [
        _loft(_squircle(0.115 * scale, 0.074 * scale, 5.0), [(1.0, 0.0), (1.0, 0.045 * scale)], grip),
        _loft(_squircle(0.046 * scale, 0.036 * scale, 3.0), [(1.1, 0.04 * scale), (1.0, z)], grip),
        *(_lying(part, "x", (0.0, 0.0, z)) for part in (barrel, chuck, bit)),
    ]
    reach, level = 0.018 * scale + SKIN_M, 0.115 * scale
    grasps = (
        _grasp("left", (0.0, reach, level), (0.0, 1.0, 0.0), (0.96, 0.0, -0.28), 0.0),
        _grasp("right", (0.0, -reach, level), (0.0, -1.0, 0.0), (0.96, 0.0, -0.28), 0.0),
    )
    return Handheld(merged(parts), (0.35, 0.074 * scale), z + 0.03 * scale, (), grasps)


def mop(rng: np.random.Generator) -> Handheld:
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
    parts = [_turned(_moved(rag, (0.0, 0.0, 0.0)), R, tail), _turned(rod, R, tail + (head - 0.02) * ahead)]
    mesh = merged(parts)
    low = float(mesh.vertices[:, 2].min())
    mesh = _moved(mesh, (0.0, 0.0, -low))
    x = far - rng.uniform(0.16, 0.24)
    level = radius - low + (x + far) * ahead[2]
    grasps = _from_above(x, level + stick)
    return Handheld(mesh, (length, 2 * radius), 2 * radius, (), grasps)


def ball(rng: np.random.Generator) -> Handheld:
    """A ball, held between both palms."""
    radius = rng.uniform(0.095, 0.125)
    angle = np.linspace(0.0, np.pi, 15)[1:-1]
    profile = [(np.sin(a), radius * (1.0 - np.cos(a))) for a in angle]
    colors = [hue(rng, (0.4, 0.9)), hue(rng, (0.0, 0.4))]
    mesh = _loft(_round(radius, 24), profile, colors[0], poles=(0.0, 2 * radius))
    wedge = np.arctan2(mesh.vertices[:, 1], mesh.vertices[:, 0]) // (np.pi / 3) % 2 == 0
    rows = np.where(wedge[:, None], np.array(colors[0]), np.array(colors[1])).astype(np.float32)
    mesh = Mesh(mesh.vertices, mesh.faces, rows)
    return Handheld(mesh, (2 * radius, 2 * radius), 2 * radius, _between(dict.fromkeys(QUARTERS, radius), radius))


MAKERS: dict[str, Callable[[np.random.Generator], Handheld]] = {
    "suitcase": suitcase,
    "backpack": backpack,
    "bottle": bottle,
    "tool": tool,
    "ball": ball,
}


def _beside_body(bar: tuple[float, float, float], facings: Sequence[float]) -> tuple[Grasp, ...]:
    """Grasps of either hand on a bar along the holder's heading, beside the body, fingers down, palm inwards."""
    x, y, z = bar
    out = 0.011 + SKIN_M
    return tuple(
        _grasp(side, (x, y + sign * out, z + 0.008), (0.0, sign, 0.0), (0.2, 0.0, -0.98), facing)
        for facing in facings
        for side, sign in (("left", 1.0), ("right", -1.0))
    )


def _from_above(x: float, top: float) -> tuple[Grasp, ...]:
    """Grasps of either hand across a handle that lies along x, thumb towards +x."""
    up, z = (0.0, 0.0, 1.0), top + SKIN_M
    return (
        Grasp("left", GripPlace((x, 0.0, z), up, (0.0, 1.0, 0.0)), np.pi / 2),
        Grasp("right", GripPlace((x, 0.0, z), up, (0.0, -1.0, 0.0)), -np.pi / 2),
    )


def _between(halves: dict[float, float], level: float) -> tuple[Side, ...]:
    """Both palms on opposite faces at a height; `halves` maps the holder's facing to half their distance (m)."""
    sides = []
    for facing, half in halves.items():
        left, right = (
            _grasp(side, (0.0, sign * (half + SKIN_M), level), (0.0, sign, 0.0), (0.94, 0.0, -0.33), facing).place
            for side, sign in (("left", 1.0), ("right", -1.0))
        )
        sides.append((left, right, facing))
    return tuple(sides)


def _grasp(side: str, point, normal, fingers, facing: float) -> Grasp:
    """A grasp given in the holder's axes (x ahead) about the object's origin."""
    R = np.eye(3)
    R[:2, :2] = turn(facing)
    unit = np.array(fingers) / np.linalg.norm(fingers)
    point, normal, unit = (tuple(float(v) for v in R @ np.array(vector)) for vector in (point, normal, unit))
    return Grasp(side, GripPlace(point, normal, unit), float(facing))


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
    vertices = [np.concatenate([scale * outline, np.full((count, 1), z)], 1) for scale, z in profile]
    low, high = poles if poles is not None else (profile[0][1], profile[-1][1])
    vertices += [np.array([[0.0, 0.0, low], [0.0, 0.0, high]])]
    k = np.arange(count)
    nxt = (k + 1) % count
    faces = []
    for ring in range(rings - 1):
        a, b = ring * count, (ring + 1) * count
        faces += [np.stack([a + k, a + nxt, b + nxt], 1), np.stack([a + k, b + nxt, b + k], 1)]
    bottom, top, last = rings * count, rings * count + 1, (rings - 1) * count
    faces += [np.stack([np.full(count, bottom), nxt, k], 1), np.stack([np.full(count, top), last + k, last + nxt], 1)]
    return _mesh(np.concatenate(vertices), np.concatenate(faces), color)


def _box(center: tuple[float, float, float], size: tuple[float, float, float], color: Color) -> Mesh:
    x, y, z = center
    low, high = z - size[2] / 2, z + size[2] / 2
    return _moved(_loft(rectangle((0.0, 0.0), size[:2]), [(1.0, low), (1.0, high)], color), (x, y, 0.0))


def _disc(radius: float, thick: float, color: Color) -> Mesh:
    """A disc about z, its middle at the origin."""
    return _loft(_round(radius), [(1.0, -thick / 2), (1.0, thick / 2)], color)


def _lying(mesh: Mesh, axis: str, at: tuple[float, float, float]) -> Mesh:
    """A mesh made about z, turned to another axis and moved (m)."""
    R = {"x": [[0, 0, 1], [1, 0, 0], [0, 1, 0]], "y": [[0, 1, 0], [0, 0, 1], [1, 0, 0]]}[axis]
    return _turned(mesh, np.array(R, np.float64), np.array(at))


def _moved(mesh: Mesh, by: tuple[float, float, float]) -> Mesh:
    return _turned(mesh, np.eye(3), np.array(by))


def _turned(mesh: Mesh, R: Float[np.ndarray, "3 3"], t: Float[np.ndarray, "3"]) -> Mesh:
    return Mesh((mesh.vertices @ R.T + t).astype(np.float32), mesh.faces, mesh.color, mesh.smooth)


def _mesh(vertices: np.ndarray, faces: np.ndarray, color: Color) -> Mesh:
    return Mesh(vertices.astype(np.float32), faces.astype(np.int32), np.tile(np.float32(color), (len(vertices), 1)))
