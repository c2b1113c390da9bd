"""The space that a moving body occupies: limbs as capsules, its centre of mass, and the floor it sweeps by height."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
import scipy.ndimage
from jaxtyping import Float, Int

from wearcap.body.kinematics import site_positions
from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.recording.motion import Motion
from wearsim.places.outline import turn

_MIDDLE = (
    ("pelvis", "l3", 0.14, 0.17, "seat"),
    ("l3", "t8", 0.13, 0.14, "trunk"),
    ("t8", "neck", 0.12, 0.124, "trunk"),
    ("neck", "head", 0.07, 0.01, "trunk"),
    ("head", "crown", 0.10, 0.06, "trunk"),
    ("left_hip", "right_hip", 0.11, 0.0, "seat"),
    ("left_shoulder", "right_shoulder", 0.07, 0.0, "trunk"),
)
_SIDE = (
    ("hip", "knee", 0.08, 0.14, "seat"),
    ("knee", "ankle", 0.05, 0.045, "shin"),
    ("heel", "toe_tip", 0.03, 0.014, "foot"),
    ("shoulder", "elbow", 0.055, 0.027, "arm"),
    ("elbow", "wrist", 0.045, 0.016, "arm"),
    ("wrist", "fingertip", 0.035, 0.006, "hand"),
)
LIMBS: tuple[tuple[str, str, float, float, str], ...] = (
    *_MIDDLE,
    *(
        (f"{side}_{a}", f"{side}_{b}", radius, mass, part)
        for side in ("left", "right")
        for a, b, radius, mass, part in _SIDE
    ),
)
"""Capsules of an adult: joint or site at either end, radius (m), share of the body's mass (after de Leva), part."""

PARTS = ("seat", "trunk", "shin", "foot", "arm", "hand")
SOLE_M = 0.03
"""Height of a foot's capsule above the soles' sites, which touch the floor."""

SPACING_M = 0.04
"""Spacing of the points that represent a capsule."""
VOXEL_M = 0.02
"""Side of the cubes within which points are merged."""
CELL_M = 0.06
TOPS_M = (0.12, 0.25, 0.35, 0.5, 0.65, 0.8, 0.95, 1.1, 1.4, 1.7, 2.1, 2.6, np.inf)
"""Heights up to which the floor's cells are checked."""


@dataclass(frozen=True, eq=False)
class BodySpace:
    """Points that represent the capsules of all frames, at most `VOXEL_M` off, and their capsules' radii (m)."""

    points: Float[np.ndarray, "point 3"]
    radius: Float[np.ndarray, "point"]
    part: Int[np.ndarray, "point"]
    """Index into `PARTS`."""

    @classmethod
    def of(cls, motion: Motion) -> "BodySpace":
        """Raises WearcapError for a skeleton without the joints and sites of `LIMBS`."""
        groups: dict[tuple[float, int], list[np.ndarray]] = {}
        for (_, _, radius, _, part), (start, end) in zip(LIMBS, limb_ends(motion)):
            longest = float(np.linalg.norm(end - start, axis=1).max())
            share = np.linspace(0.0, 1.0, max(2, int(np.ceil(longest / SPACING_M)) + 1))[:, None, None]
            points = (start + share * (end - start)).reshape(-1, 3)
            points[:, 2] += SOLE_M if part == "foot" else 0.0
            groups.setdefault((radius, PARTS.index(part)), []).append(points)
        thinned = {}
        for kind, parts in groups.items():  # one point for each cube of side `VOXEL_M` that contains any
            points = np.concatenate(parts)
            cube = np.floor(points / VOXEL_M).astype(np.int64)
            cube -= cube.min(0)
            key = (cube[:, 0] * (cube[:, 1].max() + 1) + cube[:, 1]) * (cube[:, 2].max() + 1) + cube[:, 2]
            thinned[kind] = points[np.unique(key, return_index=True)[1]]
        counts = [len(points) for points in thinned.values()]
        radius, part = (np.repeat(column, counts) for column in zip(*thinned))
        return cls(np.concatenate(list(thinned.values())), radius, part)

    def around(self, center: Float[np.ndarray, "3"], reach: float) -> "BodySpace":
        """The part of the body that comes within `reach` (m) of a point, along any of the world's axes."""
        near = (np.abs(self.points - center) < reach + self.radius[:, None]).all(1)
        return BodySpace(self.points[near], self.radius[near], self.part[near])

    def meets(
        self,
        center: Float[np.ndarray, "3"],
        size: Float[np.ndarray, "3"],
        heading: float,
        margin: float,
        may_touch: dict[str, float] | None = None,
    ) -> bool:
        """Whether the body comes nearer than `margin` (m) to a box.

        Parts in `may_touch` may reach into it by these depths (m).
        """
        body = self.around(center, float(np.linalg.norm(size)) / 2 + margin)
        least = np.array([-(may_touch or {}).get(part, -margin) for part in PARTS])[body.part]
        return bool((body.gap(center, size, heading) < least).any())

    def gap(
        self, center: Float[np.ndarray, "3"], size: Float[np.ndarray, "3"], heading: float
    ) -> Float[np.ndarray, "point"]:
        """Distance (m) of each point's ball from a box, negative where they meet."""
        x, y, z = (self.points - center).T
        cos, sin = np.cos(heading), np.sin(heading)
        local = np.abs(np.stack([cos * x + sin * y, cos * y - sin * x, z], 1)) - size / 2
        return np.linalg.norm(np.maximum(local, 0.0), axis=1) + np.minimum(local.max(1), 0.0) - self.radius


def limb_ends(motion: Motion) -> list[tuple[Float[np.ndarray, "time 3"], Float[np.ndarray, "time 3"]]]:
    """Both ends of each of `LIMBS` (m)."""
    names = sorted({name for a, b, *_ in LIMBS for name in (a, b)})
    sites = tuple(name for name in names if name in motion.skeleton.sites)
    at = dict(zip(sites, site_positions(motion.skeleton, motion.T_world_joint, sites).unbind(1)))
    at |= {name: motion.joint(name).t for name in names if name not in at}
    return [(at[a].double().numpy(), at[b].double().numpy()) for a, b, *_ in LIMBS]


def mass_center(motion: Motion) -> Float[np.ndarray, "time 3"]:
    """Centre of mass (m), each limb's in its middle."""
    shares = np.array([share for _, _, _, share, _ in LIMBS])
    middles = np.stack([(start + end) / 2 for start, end in limb_ends(motion)])
    return np.einsum("l,ltx->tx", shares / shares.sum(), middles)


def foot_points(motion: Motion) -> Float[np.ndarray, "time patch 3"]:
    """Positions of `FOOT_PATCHES` (m)."""
    return site_positions(motion.skeleton, motion.T_world_joint, FOOT_PATCHES).double().numpy()


def off_balance(motion: Motion) -> Float[np.ndarray, "time"]:
    """Horizontal distance (m) of the centre of mass from the convex hull of `foot_points`."""
    points, corners = mass_center(motion)[:, :2], foot_points(motion)[..., :2]
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


@dataclass(frozen=True, eq=False)
class SweptFloor:
    """Distance of every floor cell from a body that passes over or beside it, by height."""

    origin: Float[np.ndarray, "2"]
    clear: Float[np.ndarray, "top i j"]
    """Distance (m) from a cell's middle to the body below each of `TOPS_M`."""

    @classmethod
    def of(cls, body: BodySpace, beyond: float) -> "SweptFloor":
        """A grid along the axes of `body`'s points (z = 0 the floor), `beyond` metres wider than the body."""
        xy = body.points[:, :2]
        origin = xy.min(0) - beyond
        shape = np.ceil((xy.max(0) + beyond - origin) / CELL_M).astype(int)
        cell = tuple(((xy - origin) / CELL_M).astype(int).T)
        size = _SIZES[np.searchsorted(_SIZES, body.radius)]
        clear = np.full((len(TOPS_M), *shape), np.inf)
        for radius in np.unique(size):
            lowest = np.full(shape, np.inf)
            np.minimum.at(lowest, tuple(c[size == radius] for c in cell), body.points[size == radius, 2] - radius)
            away, count = np.full(shape, np.inf), 0
            for layer, top in zip(clear, TOPS_M):
                taken = lowest < top
                if taken.sum() > count:
                    away, count = (np.asarray(scipy.ndimage.distance_transform_edt(~taken)) * CELL_M, taken.sum())
                np.minimum(layer, away - radius - _CELL_ERROR_M, out=layer)
        return cls(origin, clear)

    def distance(self, center: tuple[float, float], size: tuple[float, float], heading: float, top: float) -> float:
        """Distance from a rectangle up to a height (m) to the nearest part of the body; never too large."""
        rows, columns = (np.linspace(-0.5, 0.5, max(2, int(np.ceil(s / CELL_M)) + 1)) * s for s in size)
        points = np.stack(np.meshgrid(rows, columns), -1).reshape(-1, 2) @ turn(heading).T + np.array(center)
        i, j = ((points - self.origin) / CELL_M).astype(int).T
        layer = self.clear[np.searchsorted(TOPS_M, top)]
        return float(layer[np.clip(i, 0, layer.shape[0] - 1), np.clip(j, 0, layer.shape[1] - 1)].min())


_SIZES = np.array([0.055, 0.08, 0.14])
"""Classes of radii (m): each limb is assigned the next larger one."""
_CELL_ERROR_M = CELL_M
"""Bound on the distance between points and the middles of the cells to which they are rounded, at both ends."""
