"""The ground that a person walks on, for pictures: through the places where the feet stood, on stairs and hills too."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.distance import cdist

from wearcap.body.kinematics import site_positions
from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.geometry.mesh import Mesh, checker_floor
from wearcap.recording.motion import Motion
from wearcap.sensors.contacts import contacts_from_motion

LEVEL_M, SAME_M = 0.10, 0.02
"""Ground is level if its footfalls (but the highest and lowest 5 %) differ less in height (m), or those of a place."""
NEAREST, NEAR_M = 64, 0.06
"""Number of footfalls, the nearest in time, that make the ground at a time, and the distance (m) within which one decides."""
HALF_M, TILE_M, CELLS = 3.0, 0.5, 4
"""Half the side of the drawn ground, the side of its tiles (m), and the number of cells along a tile that is not level."""


@dataclass(frozen=True, eq=False)
class Ground:
    """Footfalls of a motion, in any order: one alone where the ground is level throughout."""

    places: Float[np.ndarray, "footfall 3"]
    times: Float[np.ndarray, "footfall"]

    @classmethod
    def of(cls, motion: Motion) -> "Ground":
        """The ground below a motion: by its contacts, or where its feet stand still, or its lowest joints."""
        lowest = motion.T_world_joint.t[..., 2].amin(1)
        level = float(torch.quantile(lowest[:: max(1, len(lowest) // 5000)], 0.05)) - 0.02
        if set(FOOT_PATCHES) <= set(motion.skeleton.sites) and len(motion) > 2:
            contact = contacts_from_motion(motion) if motion.contact_prob is None else motion.contact_prob > 0.5
            edges = np.diff(contact.T.numpy().astype(int), axis=1, prepend=0, append=0)
            (patch, start), (_, stop) = np.nonzero(edges > 0), np.nonzero(edges < 0)
            middle = (start + stop - 1) // 2
            places = site_positions(motion.skeleton, motion.T_world_joint, FOOT_PATCHES).double().numpy()[middle, patch]
            if len(places):
                low, level, high = np.quantile(places[:, 2], [0.05, 0.5, 0.95])
                if high - low > LEVEL_M:
                    return cls(places, motion.timestamps.numpy()[middle])
        return cls(np.array([[0.0, 0.0, level]]), np.zeros(1))

    def heights(self, xy: Float[np.ndarray, "point 2"], time: float) -> Float[np.ndarray, "point"]:
        """Heights (m) at a time (s): means of the footfalls', weighted by the inverse fourth power of the distance."""
        places = self._near(time)
        weight = (cdist(xy, places[:, :2], "sqeuclidean") + NEAR_M**2) ** -2
        return weight @ places[:, 2] / weight.sum(1)

    def mesh(
        self, center: Float[np.ndarray, "3"], time: float, colors: Float[np.ndarray, "2 3"], rim: Float[np.ndarray, "3"]
    ) -> Mesh:
        """Chequered ground around a point (m) at a time (s) of the motion, in the colour `rim` at its rim."""
        heights = self._near(time)[:, 2]
        if np.ptp(heights) < SAME_M:
            return checker_floor(np.array([*center[:2], heights.mean()]), HALF_M, TILE_M, colors, rim)
        return checker_floor(center, HALF_M, TILE_M, colors, rim, CELLS, lambda xy: self.heights(xy, time))

    def _near(self, time: float) -> Float[np.ndarray, "footfall 3"]:
        return self.places[np.argsort(np.abs(self.times - time))[:NEAREST]]
