"""Hands that Aria's machine perception services (MPS) track, as poses of the skeleton's wrists, and their fingers.

MPS gives places of a wrist and a palm's centre in its device frame `aria`, and normals of both, or 21 landmarks. In the
sample's `hand_tracking_results_v2.csv` (projectaria_tools) the normals of both sides point out of the palm: as fingers curl,
their tips move along them (by up to 7 cm), and the thumb lies on the side where it then must. The wrist's normal is -y of
MPS' own wrist frame, whose axes z, x, y are x, y, z here, up to 3° with normals and 10° with landmarks alone.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from wearcap.body.hands import FINGER_NAMES, in_layout
from wearcap.body.skeleton import SIDES
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory, resample
from wearcap.io.formats.csv_table import read_columns, read_header
from wearcap.io.formats.poses import are_rotations, check_finite, check_rising, row_name
from wearcap.recording.recording import FingerStream

MIN_CONFIDENCE = 0.5
"""Least confidence of a hand, 0 … 1 (-1: not tracked). In the samples scores are beyond 0.9, and fall to this within half
a second where a hand is lost; below one half MPS itself finds it likelier that there is none (our choice)."""

_TIME = "tracking_timestamp_us"
_WRIST, _INDEX, _PINKY, _PALM = (f"landmark_{k}" for k in (5, 8, 17, 20))
"""Landmarks of MPS: wrist, first joints of index finger and pinky, centre of the palm."""
LANDMARKS = (
    *(f"{finger}_tip" for finger in FINGER_NAMES),
    *("wrist", "thumb_proximal", "thumb_distal"),
    *(f"{finger}_{bone}" for finger in FINGER_NAMES[1:] for bone in ("proximal", "intermediate", "distal")),
    "palm",
)
"""Joints of MPS' 21 landmarks, as its documentation lists them; there is none at the thumb's CMC joint."""


def read_hands(files: Sequence[Path], head: Trajectory) -> tuple[dict[str, Trajectory], str]:
    """(tracked wrists by joint, at MPS' own rate; what was left out, if anything, in a sentence).

    Of `files` (`wrist_and_palm_poses.csv`, `hand_tracking_results.csv`) the first that shows orientation is read. `head`
    is the path of the `aria` frame in a world with z up, which becomes the wrists'; rows at times outside it are left out,
    and so is a hand without rows. Raises WearcapError for missing columns, times that do not rise, and tracked rows with
    NaN or without a palm's normal.
    """
    for path in files:
        header = read_header(path)
        landmarks = any(f"_{_WRIST}_" in name for name in header)
        normals = any(name.startswith("nx_") for name in header)
        if landmarks or normals:
            wrists = _wrists(path, head, landmarks, normals)
            return wrists, "" if wrists else f"{path.name} tracks no hand at a time of the head's path"
    return {}, f"{files[0].name} has no normals or landmarks: hands are left out" if files else ""


def read_fingers(files: Sequence[Path]) -> dict[str, FingerStream]:
    """Tracked hands by side, in the axes of the `aria` frame; of `files` the first with all landmarks counts, else none.

    Raises WearcapError for missing columns, times that do not rise, and tracked rows with NaN.
    """
    names = {side: [f"t{axis}_{side}_landmark_{k}_device" for k in range(21) for axis in "xyz"] for side in SIDES}
    path = next((path for path in files if set(names["left"]) <= set(read_header(path))), None)
    if path is None:
        return {}
    scores = {side: f"{side}_tracking_confidence" for side in SIDES}
    table = read_columns(path, [_TIME, *scores.values(), *names["left"], *names["right"]])
    check_finite({name: table[name] for name in (_TIME, *scores.values())}, path)
    check_rising(table[_TIME] * 1e-6, path)
    hands, times = {}, torch.from_numpy(table[_TIME] * 1e-6)
    for side in SIDES:
        tracked, points = table[scores[side]] >= MIN_CONFIDENCE, np.stack([table[name] for name in names[side]], 1)
        check_finite({f"{side} landmarks": points[tracked]}, path)
        placed = in_layout(torch.from_numpy(points).float().unflatten(1, (-1, 3)), LANDMARKS)
        sure = torch.from_numpy(table[scores[side]].clip(0, 1)).float()
        hands[side] = FingerStream(times, placed, torch.from_numpy(tracked), sure)
    return {side: hand for side, hand in hands.items() if hand.valid.any()}


def _wrists(path: Path, head: Trajectory, landmarks: bool, normals: bool) -> dict[str, Trajectory]:
    parts = [f"t{{}}_{{}}_{name}_device" for name in ((_WRIST, _PALM) if landmarks else ("wrist", "palm"))]
    parts += ["n{}_{}_wrist_device"] if normals else [f"t{{}}_{{}}_{name}_device" for name in (_INDEX, _PINKY)]
    columns = {side: [[part.format(axis, side) for part in parts] for axis in "xyz"] for side in ("left", "right")}
    scores = {side: f"{side}_tracking_confidence" for side in columns}
    names = [name for axes in columns.values() for axis in axes for name in axis]
    table = read_columns(path, [_TIME, *scores.values(), *names])
    check_finite({name: table[name] for name in (_TIME, *scores.values())}, path)
    check_rising(table[_TIME] * 1e-6, path)
    wrists = {}
    for side, axes in columns.items():
        rows = np.flatnonzero(table[scores[side]] >= MIN_CONFIDENCE)
        if not len(rows):
            continue
        points = np.stack([[table[name][rows] for name in axis] for axis in axes]).T  # (row, part, axis)
        check_finite({f"{side} hand": points}, path, lambda k, rows=rows: row_name(int(rows[k])))
        wrist, palm, *rest = torch.from_numpy(points).unbind(1)
        left = 1.0 if side == "left" else -1.0
        normal = rest[0] if normals else left * torch.linalg.cross(rest[1] - wrist, rest[0] - wrist)
        R_aria_wrist = wrist_axes(left * (palm - wrist), normal)
        if not (good := are_rotations(R_aria_wrist, 1e-6).numpy()).all():
            what = f"{row_name(int(rows[good.argmin()]))}: the {side} palm has no normal"
            raise WearcapError(what, path, "a vector across the direction from wrist to palm")
        times = torch.from_numpy(table[_TIME][rows] * 1e-6)
        inside = (times >= head.timestamps[0]) & (times <= head.timestamps[-1])
        if inside.any():
            T_world_aria = resample(head, times[inside]).T_world_body
            T = T_world_aria @ Rigid(R_aria_wrist[inside], wrist[inside]).to(torch.float32)
            wrists[f"{side}_wrist"] = Trajectory(times[inside], T.R, T.t)
    return wrists


def wrist_axes(
    leftward: Float64[Tensor, "time 3"], palm_normal: Float64[Tensor, "time 3"]
) -> Float64[Tensor, "time 3 3"]:
    """Axes of wrist joints, in the rest pose the world's: x to the thumb's side, y along the hand, z out of its back.

    `leftward` is the direction from wrist to palm of left hands, from palm to wrist of right ones. It is made orthogonal
    to the normal, since the palm's centre lies 14° palmward of the line from wrist to knuckles. Vectors that are zero or
    parallel give no rotations.
    """
    z = -torch.nn.functional.normalize(palm_normal, dim=-1)
    x = torch.nn.functional.normalize(torch.linalg.cross(leftward, z), dim=-1)
    return torch.stack([x, torch.linalg.cross(z, x), z], -1)
