"""Motions for OpenSim: coordinates (.mot) named after the full-body model of Rajagopal et al. 2016, and joint angles as CSV.

OpenSim's ground is x forward, y up, z right. Its joints turn about z, x and y, the left ones mirrored, as ISB's do; the
model's oblique axes of ankle, subtalar joint and forearm are taken to be ISB's.
"""

from pathlib import Path

import numpy as np

from wearcap.body.landmarks import landmarks
from wearcap.body.skeleton import SIDES
from wearcap.files import write_text
from wearcap.io.formats.poses import check_finite
from wearcap.io.formats.trc import R_WORLD_FILE, exact
from wearcap.recording.joint_angles import euler_deg, joint_angles, relative_rotations
from wearcap.recording.motion import Motion

_CENTRAL = {
    "pelvis": ("pelvis_tilt", "pelvis_list", "pelvis_rotation"),
    "trunk": ("lumbar_extension", "lumbar_bending", "lumbar_rotation"),
}
_SIDED = {
    "hip": ("hip_flexion", "hip_adduction", "hip_rotation"),
    "knee": ("knee_angle", "", ""),
    "ankle": ("ankle_angle", "", ""),
    "shoulder": ("arm_flex", "arm_add", "arm_rot"),
    "elbow": ("elbow_flex", "", "pro_sup"),
}
"""Coordinates of turns about z, x and y; the model has none where there is no name."""
_PELVIS_M = (0.056276, 0.07849, 0.0)
_MODEL_STATURE_M = 1.70
"""The pelvis' origin, between the ASIS, from the middle of the hips (x forward, y up, z right) of a model so tall."""


def opensim_coordinates(motion: Motion) -> dict[str, np.ndarray]:
    """Coordinates over time by OpenSim's names: metres of the pelvis (`pelvis_tx`, …), else degrees without jumps of 360°.

    Knees are bent at positive angles, as in Rajagopal's model (gait2392 has the opposite sign). Raises WearcapError where
    limbs are not recognised.
    """
    rotations, found = relative_rotations(motion), dict[str, np.ndarray]()
    for joint, R in rotations.items():
        side, _, name = joint.partition("_")
        names = _CENTRAL.get(joint) or [each and f"{each}_{side[0]}" for each in _SIDED[name]]
        angles = [np.unwrap(angle.numpy(), period=360) for angle in euler_deg("ZXY", R)]
        found |= {each: angle for each, angle in zip(names, angles) if each}
        if name == "knee":
            found[names[0]] = -found[names[0]]
        if joint == "pelvis":
            legs = [landmarks(motion.skeleton).limb[f"{each}_leg"][0] for each in SIDES]
            hips = motion.T_world_joint.t[:, legs].double().mean(1)
            forward = R.numpy() @ np.array(_PELVIS_M) * motion.skeleton.stature / _MODEL_STATURE_M
            place = hips.numpy() @ R_WORLD_FILE["y"] + forward
            found |= {f"pelvis_t{axis}": place[:, k] for k, axis in enumerate("xyz")}
    return found


def write_mot(motion: Motion, path: str | Path) -> None:
    """Write OpenSim's coordinates of a motion atomically. Raises WearcapError as `opensim_coordinates` does, and for NaN."""
    columns = opensim_coordinates(motion)
    head = [Path(path).stem, "version=1", f"nRows={len(motion)}", f"nColumns={1 + len(columns)}", "inDegrees=yes"]
    _write(motion, columns, path, "\t", [*head, "endheader", "\t".join(["time", *columns])])


def write_angles(motion: Motion, path: str | Path) -> None:
    """Write `joint_angles` as CSV, columns `time_s` and `…_deg`. Raises WearcapError where limbs are not recognised, and for NaN."""
    columns = {f"{name}_deg": angle.numpy() for name, angle in joint_angles(motion).items()}
    _write(motion, columns, path, ",", [",".join(["time_s", *columns])])


def _write(motion: Motion, columns: dict[str, np.ndarray], path: str | Path, comma: str, head: list[str]) -> None:
    rows = np.stack(list(columns.values()), 1)
    check_finite({"an angle": rows}, path)
    cells = (
        comma.join([exact(time), *(f"{x:.6f}" for x in row)]) for time, row in zip(motion.timestamps.tolist(), rows)
    )
    write_text(path, "\n".join([*head, *cells]) + "\n")
