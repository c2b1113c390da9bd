"""The ground that a person walks on, for pictures: through the places where the feet stood, level where they are."""

from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from jaxtyping import Float

from wearcap.body.kinematics import site_positions
from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.geometry.mesh import Mesh, checker_floor
from wearcap.geometry.trajectory import nearest_frames
from wearcap.recording.motion import Motion
from wearcap.sensors.contacts import contacts_from_motion

LEVEL_M = 0.10
"""Ground whose footfalls differ less in height (m, without the highest and lowest 5 %) is drawn level."""
NEAREST = 64
"""Number of footfalls, those nearest in time, that the ground around a person goes through."""
SIDEWAYS, NEAR_M = 0.5, 0.06
"""Weight of distances across the walking direction, in which stairs and slopes go on as they are, and the distance (m)
within which a footfall alone decides."""
STRIDE_S, WALKED_M = 0.6, 0.4
"""Half the time (s) over which the walking direction is taken, and the way (m) from which on it counts fully."""
HALF_M, TILE_M, CELLS = 3.0, 0.5, 5
"""Half the side of the drawn ground, the side of its tiles (m), and the number of cells along a tile that is not level."""


@dataclass(frozen=True, eq=False)
class Ground:
    """Heights of the ground by the footfalls of a motion; without any it is level at `level`."""

    level: float
    places: Float[np.ndarray, "footfall 3"]
    times: Float[np.ndarray, "footfall"]
    across: Float[np.ndarray, "footfall 2"]
    """Unit vectors across the walking direction, shorter where the person hardly walks."""

    @classmethod
    def of(cls, motion: Motion) -> Self:
        """The ground below a motion, by its contacts or, without them, by where its feet stand still."""
        places, times = _footfalls(motion)
        if not len(places):
            lowest = motion.T_world_joint.t[..., 2].amin(1)
            lowest = float(torch.quantile(lowest[:: max(1, len(lowest) // 5000)], 0.05))
            return cls(lowest - 0.02, places, times, places[:, :2])
        low, level, high = np.quantile(places[:, 2], [0.05, 0.5, 0.95])
        if high - low < LEVEL_M:
            return cls(float(level), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 2)))
        frames = [nearest_frames(motion.timestamps, torch.from_numpy(times + s)) for s in (-STRIDE_S, STRIDE_S)]
        x, y = (motion.t_world_root[frames[1]] - motion.t_world_root[frames[0]])[:, :2].double().numpy().T
        across = np.stack([-y, x], -1) / np.hypot(x, y).clip(WALKED_M)[:, None]
        return cls(float(level), places, times, across)

    def mesh(
        self, center: Float[np.ndarray, "3"], time: float, colors: Float[np.ndarray, "2 3"], rim: Float[np.ndarray, "3"]
    ) -> Mesh:
        """Chequered ground around a point (m) at a time (s) of the motion, in the colour `rim` at its rim."""
        if not len(self.places):
            return checker_floor(np.array([*center[:2], self.level]), HALF_M, TILE_M, colors, rim)
        near = np.argsort(np.abs(self.times - time))[:NEAREST]
        return checker_floor(center, HALF_M, TILE_M, colors, rim, CELLS, lambda xy: self._heights(xy, near))

    def below(self, point: Float[np.ndarray, "3"], time: float) -> float:
        """Height (m) of the ground below a point at a time (s)."""
        near = np.argsort(np.abs(self.times - time))[:NEAREST]
        return float(self._heights(point[None, :2], near)[0]) if len(near) else self.level

    def _heights(self, xy: Float[np.ndarray, "point 2"], near: np.ndarray) -> Float[np.ndarray, "point"]:
        """Means of the footfalls' heights, weighted by the inverse fourth power of the distance."""
        apart = xy[:, None] - self.places[near, :2]
        square = (apart**2).sum(-1) - (1 - SIDEWAYS**2) * (apart * self.across[near]).sum(-1) ** 2
        weight = (square + NEAR_M**2) ** -2
        return weight @ self.places[near, 2] / weight.sum(1)


def _footfalls(motion: Motion) -> tuple[Float[np.ndarray, "footfall 3"], Float[np.ndarray, "footfall"]]:
    """Mean place (m) and time (s) of each contact of each heel and toe tip; none for skeletons without these sites."""
    if not set(FOOT_PATCHES) <= set(motion.skeleton.sites) or len(motion) < 3:
        return np.zeros((0, 3)), np.zeros(0)
    contact = contacts_from_motion(motion) if motion.contact_prob is None else motion.contact_prob > 0.5
    places = site_positions(motion.skeleton, motion.T_world_joint, FOOT_PATCHES).double().numpy()
    samples = np.concatenate([places, np.broadcast_to(motion.timestamps[:, None, None], (*places.shape[:2], 1))], -1)
    samples, contact = samples.transpose(1, 0, 2).reshape(-1, 4), contact.T.numpy()
    starts = np.diff(contact, axis=1, prepend=False)
    starts = (starts & contact).reshape(-1)[contact.reshape(-1)]
    samples = samples[contact.reshape(-1)]
    first = np.flatnonzero(starts)
    if not len(first):
        return np.zeros((0, 3)), np.zeros(0)
    falls = np.add.reduceat(samples, first) / np.diff(first, append=len(samples))[:, None]
    return falls[:, :3], falls[:, 3]
