"""Detections of hands and contacts in a head camera's pictures, as a detector makes them that judges each one alone.

What is in the picture is exact: the hands' vertices through the lens, without those that objects or walls hide. How
well a hand in sight is found and judged is Hand Object Detector's own record on egocentric pictures (Shan et al. 2020,
model 100K+ego on its ego test set): average precision of hands 90.5, with the right side 90.0, the right state 75.0.
These are pictures with hands at work in them; a hand before an object that it does not touch is what it mistakes most.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32

from benchmarks.tables.seen_flat import SeenFlat, depth_of, uncovered
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.sensors.simulated import smooth_noise


@dataclass(frozen=True)
class Detector:
    """A detector's record on hands in sight; all values are shares."""

    found: float = 0.905
    """Hands found, of those wholly in the picture; of others less, by the share of the hand in sight."""
    side: float = 0.90 / 0.905
    """Found hands with the right side."""
    state: float = 0.75 / 0.90
    """Hands with the right state: in contact or not."""
    apart: float = 0.95
    """The same, of hands that cover no object in the picture (ours: nothing there can be taken for touched)."""
    false_hands: float = 0.02
    """Pictures with a hand where there is none (ours; "occasional false positives" in its authors' words)."""
    lasting_s: float = 0.3
    """Time for which misses and wrong states last: consecutive pictures look alike (ours)."""
    whole: float = 0.35
    """Share of a hand in sight from which on it is found as a whole one is (ours)."""


HOD = Detector()
FPS = 10.0
"""Rate of the pictures that are looked at (the gaps between are far shorter than those the tracker fills)."""
GLANCE = Camera.pinhole(240, 160, 100.0)
"""The camera by which coverage is measured: smaller, and as wide as the head camera."""
NEAR_M = 3.0
"""Objects further away are not within a hand's reach."""


@dataclass(frozen=True, eq=False)
class SeenHands:
    """What the camera has of each hand (left, right) in each picture."""

    share: Float[np.ndarray, "picture hand"]
    """Share of the hand's vertices in the picture with nothing before them."""
    box: Float[np.ndarray, "picture hand 4"]
    """x1 y1 x2 y2 (px) around those; zeros where there are none."""
    object_box: Float[np.ndarray, "picture hand 4"]
    """Box of the object nearest in the picture; zeros where the hand covers none."""


def seen_hands(seen: SeenFlat, every: int) -> SeenHands:
    """The hands in every n-th picture of the head camera."""
    stream = seen.recording.camera
    assert stream is not None
    times = stream.timestamps[::every]
    motion, vertices = seen.wearer(times)
    cams, poses, hands = seen.T_world_cam(motion), seen.poses(times), seen.hand_vertices()
    share, box = np.zeros((len(times), 2)), np.zeros((len(times), 2, 4))
    objects = np.zeros_like(box)
    for k in range(len(times)):
        in_cam = [((vertices[k, rows] - cams.t[k].numpy()) @ cams.R[k].numpy()) for rows in hands]
        seen_pixels = [stream.camera.project(torch.from_numpy(points)) for points in in_cam]
        if not any(bool(valid.any()) for _, valid in seen_pixels):
            continue
        depth, around = _around(seen, poses, k, stream.camera, cams[k])
        for hand, (points, (pixels, valid)) in enumerate(zip(in_cam, seen_pixels)):
            at, glance = pixels.numpy(), GLANCE.project(torch.from_numpy(points))[0].numpy()
            visible = valid.numpy() & uncovered(depth, glance, points[:, 2])
            if not visible.any():
                continue
            share[k, hand] = visible.mean()
            box[k, hand] = *at[visible].min(0), *at[visible].max(0)
            objects[k, hand] = _covered_box(glance[visible], around)
    return SeenHands(share, box, objects)


def _around(
    seen: SeenFlat, poses: dict[str, Rigid], frame: int, camera: Camera, T_world_cam: Rigid
) -> tuple[Float32[np.ndarray, "height width"], list[tuple[Bool[np.ndarray, "height width"], list[float]]]]:
    """Depth (m) of walls and objects as `GLANCE` sees them; where each object in sight is, and its box (px of `camera`)."""
    depth, found = depth_of(GLANCE, T_world_cam, seen.world(poses, frame).mesh), []
    for item in seen.flat.environment.objects:
        if (poses[item.name].t[frame] - T_world_cam.t).norm() > NEAR_M:
            continue
        own = depth_of(GLANCE, T_world_cam, seen.mesh_at(item.name, poses[item.name][frame]))
        shown = np.isfinite(own) & (own < depth + 0.05)
        rows, columns = np.nonzero(shown)
        pixels, valid = camera.project(GLANCE.unproject(torch.from_numpy(np.stack([columns, rows], 1)).double()))
        if valid.any():
            found.append((shown, [*pixels[valid].amin(0).tolist(), *pixels[valid].amax(0).tolist()]))
    return depth, found


def _covered_box(hand: Float[np.ndarray, "vertex 2"], around: list) -> list[float]:
    """Box of the smallest object that a hand (in pixels of `GLANCE`) lies over or beside; zeros where there is none."""
    (left, top), (right, bottom) = np.floor(hand.min(0)).astype(int).clip(0), np.ceil(hand.max(0)).astype(int)
    covered = [(shown.sum(), box) for shown, box in around if shown[top : bottom + 1, left : right + 1].any()]
    return min(covered)[1] if covered else [0.0] * 4


def detections(
    seen: SeenHands,
    touching: Bool[np.ndarray, "picture hand"],
    detector: Detector,
    rng: np.random.Generator,
    every: int,
    size: tuple[int, int],
) -> list[dict]:
    """The detector's output in Hand Object Detector's layout (`io.formats.hand_detections`), one entry per picture."""
    count = len(seen.share)
    luck = [_lasting(rng, count, detector.lasting_s) for _ in range(3)]  # of finding, side and state
    frames = []
    for k in range(count):
        rows, objects = [], []
        for hand in range(2):
            covers = seen.object_box[k, hand].any()
            if luck[0][k, hand] >= detector.found * min(1.0, seen.share[k, hand] / detector.whole):
                continue
            right = luck[2][k, hand] < (detector.state if covers else detector.apart)
            contact = bool(touching[k, hand]) == right
            side = hand if luck[1][k, hand] < detector.side else 1 - hand
            rows.append(_hand(seen.box[k, hand], seen.object_box[k, hand], contact, side, rng))
            objects += [[*seen.object_box[k, hand].tolist(), 0.7, 0, 0, 0, 0, 0]] if covers and contact else []
        if rng.random() < detector.false_hands:
            corner = rng.uniform(0, 0.8, 2) * size
            rows.append(
                _hand(np.array([*corner, *(corner + 60)]), np.zeros(4), rng.random() < 0.5, rng.integers(2), rng)
            )
        frames.append({"frame": every * k, "hand_dets": rows or None, "obj_dets": objects or None})
    return frames


def _hand(box: np.ndarray, target: np.ndarray, contact: bool, side: int, rng: np.random.Generator) -> list[float]:
    """A row of the detector: box, score, state, offset to the object in its units, side."""
    offset = (target[:2] + target[2:] - box[:2] - box[2:]) / 2 if target.any() else np.zeros(2)
    length = float(np.linalg.norm(offset))
    unit = (offset / max(length, 1e-9)).tolist()
    score = float(np.clip(rng.beta(12, 1), 0.5, 1.0))  # hands that it shows at all are nearly certain ones
    return [*box.tolist(), score, 3.0 if contact else 0.0, *unit, length / 1000, float(side)]


def _lasting(rng: np.random.Generator, count: int, lasting_s: float) -> Float[np.ndarray, "picture hand"]:
    """Uniform random numbers that change over some time."""
    smooth = smooth_noise(rng, count, 2, lasting_s, FPS)
    return torch.special.ndtr(smooth).numpy()
