"""Detections of hands and contacts in a head camera's pictures, as a detector makes them that judges each one alone.

A hand is in the picture where its palm is. How well a hand in sight is found and judged is Hand Object Detector's own record
on egocentric pictures (Shan et al. 2020, model 100K+ego on its ego test set): average precision of hands 90.5, with the right
side 90.0, the right state 75.0. These are pictures with hands at work in them; a hand before an object that it does not touch
is what it mistakes most.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float

from wearcap.body.kinematics import site_positions
from wearcap.geometry.rigid import Rigid
from wearcap.recording import Recording
from wearcap.recording.timing import at_times
from wearcap.scene.objects import Environment
from wearcap.sensors.simulated import smooth_noise
from wearcap.systems.ireplica.object_tracker import PALMS
from wearcap.systems.ireplica.scores import poses_at


@dataclass(frozen=True)
class Detector:
    """A detector's record on hands in sight; all values are shares."""

    found: float = 0.905
    """Hands found, of those in the picture."""
    side: float = 0.90 / 0.905
    """Found hands with the right side."""
    state: float = 0.75 / 0.90
    """Hands with the right state: in contact or not."""
    apart: float = 0.95
    """The same, of hands that are near no object (ours: nothing there can be taken for touched)."""
    false_hands: float = 0.02
    """Pictures with a hand where there is none (ours; "occasional false positives" in its authors' words)."""
    lasting_s: float = 0.3
    """Time for which misses and wrong states last: consecutive pictures look alike (ours)."""


HOD = Detector()
FPS = 10.0
"""Rate of the pictures that are looked at (the gaps between are far shorter than those the tracker fills)."""
NEAR_M = 0.3
"""Distance of a palm within which an object may be taken for touched."""
BOX_PX = 60.0


@dataclass(frozen=True, eq=False)
class SeenHands:
    """What the camera has of each hand (left, right) in each picture."""

    pixel: Float[np.ndarray, "picture hand 2"]
    inside: Bool[np.ndarray, "picture hand"]
    near: Bool[np.ndarray, "picture hand"]
    """Whether an object is within `NEAR_M`."""


def seen_hands(recording: Recording, environment: Environment, every: int) -> SeenHands:
    """The hands in every n-th picture of the head camera. Raises nothing: recordings of interactions have all that it reads."""
    stream, motion = recording.camera, recording.motion
    assert stream is not None
    assert motion is not None
    times = stream.timestamps[::every].clamp(motion.timestamps[0], motion.timestamps[-1])
    seen = at_times(motion, times)
    palms = site_positions(seen.skeleton, seen.T_world_joint, PALMS)
    T_world_cam = seen.joint("head") @ Rigid(stream.R_head_cam, stream.t_head_cam)[None]
    pixel, inside = stream.camera.project(T_world_cam.inverse()[:, None] @ palms)
    near = torch.zeros(palms.shape[:2], dtype=torch.bool)
    for item in environment.objects:
        T = poses_at(recording.object_motion.get(item.name), item, times)
        for hand in range(2):
            near[:, hand] |= environment.distance(item.name, palms[:, hand], T)[0] < NEAR_M
    return SeenHands(pixel.numpy(), inside.numpy(), near.numpy())


def detections(
    seen: SeenHands,
    touching: Bool[np.ndarray, "picture hand"],
    detector: Detector,
    rng: np.random.Generator,
    every: int,
    size: tuple[int, int],
) -> list[dict]:
    """The detector's output in Hand Object Detector's layout (`io.formats.hand_detections`), one entry per picture."""
    count = len(seen.inside)
    noise = (smooth_noise(rng, count, 2, detector.lasting_s, FPS) for _ in range(3))
    find, side, state = (torch.special.ndtr(each).numpy() for each in noise)
    found = seen.inside & (find < detector.found)
    contact = touching == (state < np.where(seen.near, detector.state, detector.apart))
    sides = np.where(side < detector.side, [0, 1], [1, 0])
    frames = []
    for k in range(count):
        rows = [_hand(seen.pixel[k, h], contact[k, h], sides[k, h], rng) for h in range(2) if found[k, h]]
        if rng.random() < detector.false_hands:
            rows.append(_hand(rng.uniform(0, 1, 2) * size, rng.random() < 0.5, rng.integers(2), rng))
        frames.append({"frame": every * k, "hand_dets": rows or None, "obj_dets": None})
    return frames


def _hand(pixel: Float[np.ndarray, "2"], contact: bool, side: int, rng: np.random.Generator) -> list[float]:
    """A row of the detector: box, score, state, offset to the object in its units, side."""
    box = [*(pixel - BOX_PX / 2).tolist(), *(pixel + BOX_PX / 2).tolist()]
    score = float(np.clip(rng.beta(12, 1), 0.5, 1.0))  # hands that it shows at all are nearly certain ones
    return [*box, score, 3.0 if contact else 0.0, 0.0, 0.0, 0.0, float(side)]
