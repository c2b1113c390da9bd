"""The ground that a person walks on, for pictures: through the places where the feet stood, level where they are."""

from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Float, Int

from wearcap.body.kinematics import site_positions
from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.geometry.compiled import compiled
from wearcap.geometry.mesh import Mesh, checker_floor
from wearcap.recording.motion import Motion
from wearcap.sensors.contacts import contacts_from_motion

LEVEL_M = 0.10
"""Ground whose footfalls differ less in height (m, without the highest and lowest 5 %) is level throughout."""
SAME_M = 0.02
"""Where the nearest footfalls differ less in height (m), the ground is drawn level."""
NEAREST = 64
"""Number of footfalls, those nearest in time, that the ground around a person goes through."""
SIDEWAYS, NEAR_M = 0.5, 0.06
"""Weight of distances across the walking direction, in which stairs and slopes go on as they are, and the distance (m)
within which a footfall alone decides."""
STRIDE_S, WALKED_M = 0.6, 0.4
"""Half the time (s) over which the walking direction is taken, and the way (m) from which on it counts fully."""
HALF_M, TILE_M, CELLS = 3.0, 0.5, 4
"""Half the side of the drawn ground, the side of its tiles (m), and the number of cells along a tile that is not level."""


@dataclass(frozen=True, eq=False)
class Ground:
    """Heights of the ground by the footfalls of a motion: one alone where it is level throughout."""

    places: Float[np.ndarray, "footfall 3"]
    times: Float[np.ndarray, "footfall"]
    across: Float[np.ndarray, "footfall 2"]
    """Unit vectors across the walking direction, shorter where the person hardly walks."""

    @classmethod
    def of(cls, motion: Motion) -> "Ground":
        """The ground below a motion, by its contacts or, without them, by where its feet stand still."""
        frames, places = _footfalls(motion)
        low, level, high = np.quantile(places[:, 2], [0.05, 0.5, 0.95]) if len(places) else [_lowest(motion)] * 3
        if high - low < LEVEL_M:
            return cls(np.array([[0.0, 0.0, level]]), np.zeros(1), np.zeros((1, 2)))
        stride, root = round(STRIDE_S * motion.fps), motion.t_world_root.double().numpy()
        walked = root[(frames + stride).clip(max=len(root) - 1)] - root[(frames - stride).clip(min=0)]
        across = np.stack([-walked[:, 1], walked[:, 0]], -1)
        across /= np.linalg.norm(across, axis=1, keepdims=True).clip(WALKED_M)
        return cls(places, motion.timestamps.numpy()[frames], across)

    def mesh(
        self, center: Float[np.ndarray, "3"], time: float, colors: Float[np.ndarray, "2 3"], rim: Float[np.ndarray, "3"]
    ) -> Mesh:
        """Chequered ground around a point (m) at a time (s) of the motion, in the colour `rim` at its rim."""
        near = self._near(time)
        if np.ptp(self.places[near, 2]) < SAME_M:
            level = np.array([*center[:2], self.places[near, 2].mean()])
            return checker_floor(level, HALF_M, TILE_M, colors, rim)
        heights = partial(_heights, places=self.places[near], across=self.across[near])
        return checker_floor(center, HALF_M, TILE_M, colors, rim, CELLS, heights)

    def below(self, point: Float[np.ndarray, "3"], time: float) -> float:
        """Height (m) of the ground below a point at a time (s)."""
        near = self._near(time)
        return float(_heights(point[None, :2], self.places[near], self.across[near])[0])

    def _near(self, time: float) -> np.ndarray:
        return np.argsort(np.abs(self.times - time))[:NEAREST]


@compiled
def _heights(xy, places, across):
    """Means of the footfalls' heights, weighted by the inverse fourth power of their distances from each point."""
    height = np.empty(len(xy))
    for point in range(len(xy)):
        total, weights = 0.0, 0.0
        for fall in range(len(places)):
            x, y = xy[point, 0] - places[fall, 0], xy[point, 1] - places[fall, 1]
            aside = x * across[fall, 0] + y * across[fall, 1]
            weight = (x * x + y * y - (1 - SIDEWAYS**2) * aside * aside + NEAR_M**2) ** -2
            total, weights = total + weight * places[fall, 2], weights + weight
        height[point] = total / weights
    return height


def _footfalls(motion: Motion) -> tuple[Int[np.ndarray, "footfall"], Float[np.ndarray, "footfall 3"]]:
    """Middle frame and place (m) of each contact of each heel and toe tip; none for skeletons without these sites."""
    if not set(FOOT_PATCHES) <= set(motion.skeleton.sites) or len(motion) < 3:
        return np.zeros(0, int), np.zeros((0, 3))
    contact = contacts_from_motion(motion) if motion.contact_prob is None else motion.contact_prob > 0.5
    edges = np.diff(contact.T.numpy().astype(int), axis=1, prepend=0, append=0)
    (patch, start), (_, stop) = np.nonzero(edges > 0), np.nonzero(edges < 0)
    middle = (start + stop - 1) // 2
    return middle, site_positions(motion.skeleton, motion.T_world_joint, FOOT_PATCHES).double().numpy()[middle, patch]


def _lowest(motion: Motion) -> float:
    lowest = motion.T_world_joint.t[..., 2].amin(1)
    return float(torch.quantile(lowest[:: max(1, len(lowest) // 5000)], 0.05)) - 0.02
