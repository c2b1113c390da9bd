"""The suit's pose in the HPS data set: text written by Unity (`*_pose.txt`, `*_trans.txt`).

Unity's world is left-handed (x right, y up, z forward) and turns by Euler angles "ZXY": first about z, then x, then y,
all about fixed axes, in degrees. With x flipped it is SMPL's (x left, y up, z forward, right-handed): rotations about
x keep their sign, those about y and z change it, so R = Ry(-y) Rx(x) Rz(-z). SMPL's axes are then converted as in
io/datasets/amass.py; here the world's axes are, too, for Unity's world is y up.
"""

from array import array
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.skeletons import smpl24
from wearcap.errors import WearcapError
from wearcap.geometry.rotation import about_axis
from wearcap.io.datasets.hps import FPS, PELVIS_SMPL
from wearcap.io.formats.smpl_axes import A
from wearcap.io.formats.text import at_line, finite_floats, numbered_lines
from wearcap.recording import Motion

_ARM = ("collar", "shoulder", "elbow", "wrist", "hand")
_LEG = ("hip", "knee", "ankle", "foot")
JOINTS = (
    "pelvis",
    *(f"{side}_{joint}" for side in ("left", "right") for joint in _LEG),
    "spine1",
    "spine2",
    "spine3",
    *(f"left_{joint}" for joint in _ARM),
    "neck",
    "head",
    *(f"right_{joint}" for joint in _ARM),
)
"""Order of the file's Euler angles: Unity's hierarchy of SMPL, depth first."""
_WITH_INNER_ROOT = 3 * (len(JOINTS) + 1)
"""Files name the root twice: the avatar, which turns, and below it the model's own root, which does not."""


def read_unity_motion(
    pose_path: str | Path, trans_path: str | Path, t_template_pelvis: tuple[float, float, float] = PELVIS_SMPL
) -> Motion:
    """Read one sequence's `_pose.txt` and `_trans.txt` as a smpl24 motion at 30 Hz that begins at 0 s, z up.

    A last line that was cut short is left out. Raises WearcapError naming the line for a wrong count or what is no
    number, and for files whose lengths differ by more than one frame.
    """
    angles_deg = _table(pose_path, (_WITH_INNER_ROOT, 3 * len(JOINTS)))
    if angles_deg.shape[1] == _WITH_INNER_ROOT:
        angles_deg = np.delete(angles_deg, [3, 4, 5], 1)
    trans = _table(trans_path, (3,))
    if abs(len(angles_deg) - len(trans)) > 1:
        raise WearcapError(
            f"{len(trans)} positions for {len(angles_deg)} poses",
            where=trans_path,
            expected=f"as many lines as in {Path(pose_path).name}",
        )
    count = min(len(angles_deg), len(trans))
    R_smpl = rotations_from_unity(torch.from_numpy(angles_deg[:count]).unflatten(1, (-1, 3)))
    skeleton = smpl24()
    order = [JOINTS.index(name) for name in skeleton.joint_names]
    t_smpl = torch.from_numpy(trans[:count]) * torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    t_smpl = t_smpl + torch.tensor(t_template_pelvis, dtype=torch.float64)
    return Motion(
        torch.arange(count, dtype=torch.float64) / FPS,
        skeleton,
        (A @ R_smpl[:, order] @ A.T).float(),
        (t_smpl @ A.T).float(),
        provenance={"source": Path(pose_path).name, "format": "hps unity"},
    )


def rotations_from_unity(angles_deg: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotations in SMPL's axes from Unity's Euler angles (x, y, z in degrees)."""
    x, y, z = torch.deg2rad(angles_deg).unbind(-1)
    return about_axis("y", -y) @ about_axis("x", x) @ about_axis("z", -z)


def _table(path: str | Path, widths: tuple[int, ...]) -> np.ndarray:
    values, width = array("d"), 0
    short: WearcapError | None = None
    for number, line in numbered_lines(path):
        tokens = line.split()
        if not tokens:
            continue
        if short is not None:
            raise short
        width = width or len(tokens)
        if width not in widths or len(tokens) != width:
            short = WearcapError(
                f"{len(tokens)} numbers", where=at_line(path, number), expected=" or ".join(map(str, widths))
            )
            if len(tokens) >= width:
                raise short
            continue  # the recorder stops in the middle of a line: only the last may be short
        try:
            values.extend(finite_floats(tokens))
        except ValueError as error:
            raise WearcapError(f"what is no finite number ({error})"[:200], where=at_line(path, number)) from error
    if not values:
        raise WearcapError("no lines of numbers", where=path)
    return np.asarray(values).reshape(-1, width)
