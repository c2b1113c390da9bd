"""Objects of live motion, frame by frame, for sinks that send them."""

from typing import NamedTuple

import torch

from wearcap.geometry.rigid import Rigid
from wearcap.recording import Motion
from wearcap.recording.active_objects import SAME_S


class SeenObject(NamedTuple):
    """One object in one frame."""

    T_world_object: Rigid
    contact: float | None
    """Largest probability that a point of the body touches it; None where the system predicts no touch, or several objects
    have poses in the frame, as the prediction is of the active one."""


def objects_of(motion: Motion) -> list[dict[str, SeenObject]]:
    """The objects by name that have a pose in each frame of a motion."""
    found: list[dict[str, Rigid]] = [{} for _ in range(len(motion))]
    for name, track in (motion.object_motion or {}).items():
        rows = torch.searchsorted(track.timestamps, motion.timestamps - SAME_S)
        for frame, row in enumerate(rows.tolist()):
            if row < len(track) and track.timestamps[row] <= motion.timestamps[frame] + SAME_S:
                found[frame][name] = track.T_world_body[row]
    touch = None if motion.body_contact_prob is None else motion.body_contact_prob.amax(-1).tolist()
    return [
        {
            name: SeenObject(pose, touch[k] if touch is not None and len(poses) == 1 else None)
            for name, pose in poses.items()
        }
        for k, poses in enumerate(found)
    ]
