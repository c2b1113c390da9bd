"""A person of known bones who squats and swings the arms, and the markers of Plug-in Gait on the skin; a TRC file of them."""

import math
from pathlib import Path

import numpy as np
import torch

from data_prep.marker_fit import _ROWS
from wearcap.body.skeleton import Skeleton, skeleton_of_height
from wearcap.geometry.rotation import about_axis
from wearcap.io.formats.trc import Markers
from wearcap.recording import Motion

FPS = 100.0
NAMES = tuple(name for name in _ROWS if name != "SACR")


def person(shank: float = 1.05, height: float = 1.68) -> Skeleton:
    """An xsens23 of a height (m), its shanks longer by a factor."""
    skeleton = skeleton_of_height(height)
    offsets = skeleton.t_parent_joint.clone()
    offsets[skeleton.indices("left_ankle", "right_ankle")] *= shank
    return skeleton.with_offsets(offsets)


def squats(skeleton: Skeleton, seconds: float = 4.0, standing_deg: float = 5.0) -> Motion:
    """Two squats from standing with bent knees (degrees); arms swing forward, elbows bend; feet stay flat."""
    times = torch.arange(int(seconds * FPS), dtype=torch.float64) / FPS
    down = torch.sin(2 * math.pi * times / seconds).square()
    knee = math.radians(standing_deg) + 1.6 * down
    R = torch.eye(3, dtype=torch.float64).repeat(len(times), len(skeleton), 1, 1)
    lean = about_axis("y", 0.4 * down)
    for name in ("l5", "l3", "t12", "t8"):
        R[:, skeleton.index(name)] = about_axis("y", 0.1 * down)
    for side, out in (("left", 1.0), ("right", -1.0)):
        thigh, shank = about_axis("y", -0.5 * knee), about_axis("y", 0.5 * knee)
        R[:, skeleton.index(f"{side}_hip")] = lean.mT @ thigh
        R[:, skeleton.index(f"{side}_knee")] = thigh.mT @ shank
        R[:, skeleton.index(f"{side}_ankle")] = shank.mT
        hanging = about_axis("x", torch.full_like(times, -1.3 * out))
        R[:, skeleton.index(f"{side}_shoulder")] = about_axis("y", -1.4 * down) @ hanging
        R[:, skeleton.index(f"{side}_elbow")] = about_axis("z", -out * (0.3 + 0.8 * down))
    R[:, 0] = about_axis("z", 0.3 * torch.ones_like(times)) @ lean
    motion = Motion(times, skeleton, R.float(), torch.zeros(len(times), 3))
    root = torch.tensor([1.0, -2.0, 0.08]) - motion.joint("left_ankle").t
    return Motion(times, skeleton, R.float(), root)


def markers_of(motion: Motion, seed: int = 0, off_m: float = 0.004, noise_m: float = 0.001) -> Markers:
    """Markers where the tables place them, each off by some millimetres that are the same in all frames, and noise."""
    random, skeleton = np.random.default_rng(seed), motion.skeleton
    R, t = motion.T_world_joint.R.double().numpy(), motion.T_world_joint.t.double().numpy()
    columns = []
    for name in NAMES:
        a, b, offset, _ = _ROWS[name]
        o = np.array(offset) * skeleton.stature / 1.75 + random.normal(0, off_m, 3)
        columns.append([t[k, skeleton.index(a)] + R[k, skeleton.index(b)] @ o for k in range(len(t))])
    places = np.array(columns).transpose(1, 0, 2)
    return Markers(motion.timestamps, NAMES, torch.from_numpy(places + random.normal(0, noise_m, places.shape)))


def write_trc(markers: Markers, path: Path, prefix: str = "Anna:") -> None:
    """A TRC file in millimetres, y up, dropped markers as empty fields."""
    frames, count = markers.t_world_marker.shape[:2]
    rates = f"{FPS:.0f}\t{FPS:.0f}\t{frames}\t{count}\tmm\t{FPS:.0f}\t1\t{frames}"
    head = ["PathFileType\t4\t(X/Y/Z)\tmarkers.trc", "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate"]
    names = "Frame#\tTime\t" + "\t\t\t".join(prefix + name for name in markers.names)
    rows = [*head, rates, names, "\t\t" + "\t".join(f"X{k + 1}\tY{k + 1}\tZ{k + 1}" for k in range(count)), ""]
    for k, places in enumerate((1000 * markers.t_world_marker[..., [1, 2, 0]]).tolist()):
        cells = ["\t\t" if math.isnan(x) else f"{x:.3f}\t{y:.3f}\t{z:.3f}" for x, y, z in places]
        rows.append("\t".join([str(k + 1), f"{markers.timestamps[k]:.4f}", *cells]))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(rows) + "\n")
