"""Contact points of a body with its object: small balls on the skin, brighter with the contact's probability."""

import numpy as np
import trimesh
import viser
from jaxtyping import Float
from torch import Tensor

from wearcap.body.contact_points import BODY_POINTS, contact_points
from wearcap.body.model import BodyModel
from wearcap.geometry.mesh import Mesh, capsules
from wearcap.recording.motion import Motion
from wearcap.viewer.page_layers import nearest_frame

LIT_PROB = 0.5
"""Probability of contact above which points are shown."""
BALL_M = 0.018
"""Radius of a ball (m)."""
DIM, BRIGHT = np.array([0.55, 0.16, 0.02]), np.array([1.0, 0.86, 0.10])
"""Colours (RGB) at the threshold and at probability 1."""


def lit_color(prob: Float[Tensor, "point"]) -> Float[np.ndarray, "point 3"]:
    """Colours (RGB, 0…1) of points by their probability of contact."""
    share = ((prob.double().numpy() - LIT_PROB) / (1 - LIT_PROB)).clip(0.0, 1.0)
    return DIM + share[:, None] * (BRIGHT - DIM)


def lit_points(points: BodyModel, motion: Motion, frame: int) -> Mesh | None:
    """Balls at the contact points of one frame; None if there are none. `points` is a body of contact points alone."""
    if motion.body_contact_prob is None:
        return None
    prob = motion.body_contact_prob[frame]
    lit = prob > LIT_PROB
    if not lit.any():
        return None
    places = points.vertices(motion.T_world_joint[frame])[lit].double().numpy()
    size = np.full(len(places), BALL_M)
    return capsules(places, places, size, size, lit_color(prob[lit]), 8)


class BodyPointsLayer:
    """The balls of one motion on the page; a frame is their positions, sizes (0 without contact) and colours."""

    def __init__(self, server: viser.ViserServer, name: str, motion: Motion, body: BodyModel):
        self.motion, self.points, self.offset = motion, contact_points(body), np.zeros(3)
        ball = trimesh.creation.icosphere(subdivisions=2, radius=BALL_M)
        self.handle = server.scene.add_batched_meshes_simple(
            f"/{name}",
            np.asarray(ball.vertices),
            np.asarray(ball.faces),
            batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (BODY_POINTS, 1)),
            batched_positions=np.zeros((BODY_POINTS, 3)),
            batched_scales=np.zeros(BODY_POINTS),
            batched_colors=np.zeros((BODY_POINTS, 3), np.uint8),
            cast_shadow=False,
            lod="off",
        )

    def place(self, offset: Float[np.ndarray, "3"], visible: bool) -> None:
        self.offset = offset
        self.handle.visible = visible

    def show(self, time: float) -> None:
        frame = nearest_frame(self.motion.timestamps, time)
        assert self.motion.body_contact_prob is not None
        prob = self.motion.body_contact_prob[frame]
        size = (prob > LIT_PROB).float().numpy()
        if not size.any() and not np.any(self.handle.batched_scales):
            return
        pose = self.motion.T_world_joint[frame]
        # The balls' parent node is at the root, so that the browser's culling considers the body's position.
        root = pose.t[0].double().numpy()
        self.handle.position = root + self.offset
        self.handle.batched_positions = (self.points.vertices(pose).double().numpy() - root).astype(np.float32)
        self.handle.batched_scales = size
        self.handle.batched_colors = (255 * lit_color(prob)).round().astype(np.uint8)
