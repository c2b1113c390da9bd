"""Motions of one recording on the page, each with its feet, contact points, objects and name."""

from collections.abc import Sequence
from itertools import pairwise, product

import numpy as np
import torch
import viser
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.geometry.trajectory import Trajectory, nearest_frames
from wearcap.recording import Motion, Recording
from wearcap.scene.environment import Environment
from wearcap.scene.objects import SceneObject
from wearcap.viewer.objects import BodyPointsLayer, ObjectsLayer, poses_at, with_objects
from wearcap.viewer.page_layers import BodyLayer, FeetLayer, LabelLayer, Placed, surface_or_sticks

TRUTH = "truth"
TRUTH_COLOR = (150, 155, 160)
CAPTURE_COLOR = (70, 160, 150)
COLORS = (CAPTURE_COLOR, (215, 140, 75), (155, 110, 170), (120, 165, 85), (80, 125, 200), (205, 95, 110))
"""Colours of captures, in order."""
ASIDE_M = 1.2
"""Least distance (m) from one motion to the next, side by side."""
FLESH_M, NEAR_M = 0.2, 1.0
"""Extent (m) of a body beyond its joints, and distance (m) from the root beyond which objects are not part of a motion."""
STILL_M, STILL_RAD = 0.02, 0.05
"""Changes of pose (m, rad) below which an object is static."""


def motions_shown(
    recording: Recording, captures: dict[str, Motion], environment: Environment | None
) -> dict[str, Motion]:
    """The ground truth, if there is one, and the captures that have frames."""
    truth = with_objects(recording, environment)
    shown = ({} if truth is None else {TRUTH: truth}) | captures
    return {name: motion for name, motion in shown.items() if len(motion)}


def moving_objects(motions: Sequence[Motion], environment: Environment | None) -> list[SceneObject]:
    """Objects that move in any of the motions."""
    if environment is None:
        return []
    tracks = [motion.object_motion or {} for motion in motions]
    return [item for item in environment.objects if any(_moves(of.get(item.name), item) for of in tracks)]


def _moves(track: Trajectory | None, item: SceneObject) -> bool:
    if track is None or not len(track):
        return False
    R, t = track.R_world_body, track.t_world_body
    turned = (R - item.R_world_object.to(R)).flatten(1).norm(dim=1).max()
    shifted = (t - item.t_world_object.to(t)).norm(dim=1).max()
    # A small angle is the matrices' distance divided by √2.
    return float(shifted) > STILL_M or float(turned) > 2**0.5 * STILL_RAD


def placed_motions(
    server: viser.ViserServer, recording: Recording, motions: dict[str, Motion], items: Sequence[SceneObject]
) -> dict[str, Placed]:
    """All motions by name, each with its own moving objects, tinted like its body if there are several motions."""
    placed, captures = {}, 0
    for name, motion in motions.items():
        color = TRUTH_COLOR if name == TRUTH else COLORS[captures % len(COLORS)]
        captures += name != TRUTH
        body = surface_or_sticks(motion.skeleton, recording.shape)
        several, points, objects = len(motions) > 1, None, None
        if motion.body_contact_prob is not None:
            points = BodyPointsLayer(server, f"{name}_points", motion, body)
        if items and motion.object_motion:
            tint = color if several else None
            objects = ObjectsLayer(server, f"{name}_objects", items, motion.object_motion, tint)
        placed[name] = Placed(
            BodyLayer(server, name, motion, body, color),
            _feet(server, name, motion, recording),
            points,
            objects,
            LabelLayer(server, name, motion) if several else None,
        )
    return placed


def _feet(server: viser.ViserServer, name: str, motion: Motion, recording: Recording) -> FeetLayer | None:
    """Foot contacts: the motion's own, or the recording's for the ground truth."""
    if not set(FOOT_PATCHES) <= set(motion.skeleton.sites):
        return None
    if motion.contact_prob is not None:
        return FeetLayer(server, f"{name}_feet", motion, motion.contact_prob > 0.5, motion.timestamps)
    track = recording.contacts if name == TRUTH else None
    if track is None or not set(FOOT_PATCHES) <= set(track.parts):
        return None
    columns = [track.parts.index(patch) for patch in FOOT_PATCHES]
    return FeetLayer(server, f"{name}_feet", motion, track.contact[:, columns], track.timestamps)


def spacing_m(motions: Sequence[Motion], items: Sequence[SceneObject] = ()) -> float:
    """Distance (m, along y) of neighbours at which none covers the next one at any time.

    The first has the greatest y. A motion occupies its body and the objects near it.
    """
    start = min(motion.timestamps[0].item() for motion in motions)
    stop = max(motion.timestamps[-1].item() for motion in motions)
    times = torch.linspace(start, stop, 400, dtype=torch.float64)
    spans = [_span(motion, items, times) for motion in motions]
    overlaps = [float((behind[1] - ahead[0]).max()) for ahead, behind in pairwise(spans)]
    return max(ASIDE_M, *overlaps)


def _span(
    motion: Motion, items: Sequence[SceneObject], times: Float64[Tensor, "time"]
) -> tuple[Float[Tensor, "time"], Float[Tensor, "time"]]:
    """Least and greatest y (m) of a motion and its near objects, at some times."""
    joints = motion.T_world_joint.t[nearest_frames(motion.timestamps, times)].double()
    low, high = joints[..., 1].amin(1) - FLESH_M, joints[..., 1].amax(1) + FLESH_M
    for item in items if motion.object_motion else ():
        T = poses_at((motion.object_motion or {}).get(item.name), item, times)
        corners = torch.from_numpy(_corners(item)).to(T.t)
        placed = (corners @ T.R.mT + T.t[:, None]).double()
        y, middle = placed[..., 1], placed.mean(1)
        radius = (corners - corners.mean(0)).norm(dim=1).max()
        near = (middle - joints[:, 0])[:, :2].norm(dim=1) < radius + NEAR_M
        low = torch.where(near, torch.minimum(low, y.amin(1)), low)
        high = torch.where(near, torch.maximum(high, y.amax(1)), high)
    return low, high


def _corners(item: SceneObject) -> Float[np.ndarray, "8 3"]:
    """Corners of an object's bounding box in its own axes (m)."""
    low, high = item.mesh.vertices.min(0), item.mesh.vertices.max(0)
    return np.array(list(product(*zip(low, high, strict=True))))
