"""TotalCapture's files, written as they are documented, of a body that sways and turns."""

from pathlib import Path

import numpy as np
import torch

from data_prep.totalcapture import INCH_M, PARENTS, SENSORS
from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import Skeleton
from wearcap.geometry import rotation
from wearcap.geometry.rotation import quat_wxyz_from_matrix
from wearcap.sensors.imu import acceleration

OFFSETS = {
    "Spine": (0, 0.10, 0), "Spine1": (0, 0.09, 0), "Spine2": (0, 0.09, 0), "Spine3": (0, 0.09, 0), "Neck": (0, 0.17, 0),
    "Head": (0, 0.11, 0.02), "LeftShoulder": (0.03, 0.10, 0), "LeftArm": (0.15, 0, 0), "LeftForeArm": (0.28, 0, 0),
    "LeftHand": (0.25, 0, 0), "LeftUpLeg": (0.09, -0.02, 0), "LeftLeg": (0, -0.42, 0), "LeftFoot": (0, -0.41, 0),
}  # fmt: skip
"""In Vicon's rest pose: y up, facing z (m); the right side is mirrored."""
JOINT_OF = {
    "head": "Head", "t8": "Spine3", "pelvis": "Hips", "shoulder": "Arm", "wrist": "Hand", "hip": "UpLeg", "knee": "Leg",
    "ankle": "Foot",
}  # fmt: skip


def vicon(frames: int) -> tuple[torch.Tensor, torch.Tensor]:
    """World rotations and positions (m), y up, of somebody who turns by a quarter while all joints sway."""
    rows = []
    for name in PARENTS:
        x, y, z = OFFSETS.get(name.replace("Right", "Left"), (0, 0, 0))
        rows.append((-x if name.startswith("Right") else x, y, z))
    parents = tuple(list(PARENTS).index(parent) if parent else -1 for parent in PARENTS.values())
    skeleton = Skeleton("vicon21", tuple(PARENTS), parents, torch.tensor(rows, dtype=torch.float64))
    t = torch.arange(frames, dtype=torch.float64) / 60
    axis = torch.from_numpy(np.random.default_rng(5).standard_normal((len(PARENTS), 3)))
    local = rotation.exp(
        0.15 * torch.sin(2 * t[:, None, None] + axis[..., :1]) * axis / axis.norm(dim=-1, keepdim=True)
    )
    turn = rotation.about_axis("y", 0.8 * t)
    local[:, 0] = turn @ local[:, 0]
    root = torch.stack([0.3 * t, 0.93 + 0.01 * torch.sin(2 * t), 0.1 * t], -1)
    T = forward_kinematics(skeleton, local, root)
    return T.R, T.t


def write_totalcapture(
    root: Path, subject: str = "s1", action: str = "walking2", frames: int = 150, order: str = "xyzw"
):
    """A sequence in the official archives' layout; the sensors begin 7 frames earlier and are mounted anyhow."""
    R, p = vicon(frames)
    folder = root / "vicon" / subject.upper() / action
    folder.mkdir(parents=True, exist_ok=True)
    quat = quat_wxyz_from_matrix(R).numpy()[..., [1, 2, 3, 0] if order == "xyzw" else [0, 1, 2, 3]]
    for file, table in (("gt_skel_gbl_pos.txt", p.numpy() / INCH_M), ("gt_skel_gbl_ori.txt", quat)):
        lines = ["\t".join(PARENTS) + "\t"]
        lines += ["\t".join(" ".join(f"{v:.7f}" for v in joint) for joint in row) + "\t" for row in table]
        (folder / file).write_text("\n".join(lines) + "\n")
    rng = np.random.default_rng(6)
    reference = rotation.exp(torch.from_numpy(rng.standard_normal(3)))
    rows = {name: _sensor(joint, R, p, reference, rng) for name, joint in SENSORS.items()}
    lead = 7
    text = [f"{len(rows)}\t{frames + lead}"]
    for k in range(frames + lead):
        text.append(str(k + 1))
        text += [f"{name}\t" + "\t".join(f"{v:.7f}" for v in row[max(k - lead, 0)]) for name, row in rows.items()]
    sensors = root / "gyro_mag" / subject / f"{action.capitalize()}_Xsens_AuxFields.sensors"
    sensors.parent.mkdir(parents=True, exist_ok=True)
    sensors.write_text("\n".join(text) + "\n")
    w, x, y, z = quat_wxyz_from_matrix(reference).tolist()
    calibration = root / "imu" / subject / f"{subject}_{action}_calib_imu_ref.txt"
    calibration.parent.mkdir(parents=True, exist_ok=True)
    calibration.write_text("\n".join([str(len(rows)), *(f"{name} {x:.7f} {y:.7f} {z:.7f} {w:.7f}" for name in rows)]))


def _sensor(
    joint: str, R: torch.Tensor, p: torch.Tensor, reference: torch.Tensor, rng: np.random.Generator
) -> np.ndarray:
    """A sensor's rows: orientation in the sensors' world, specific force, angular velocity and a magnetic field."""
    side, _, part = joint.partition("_") if "_" in joint else ("", "", joint)
    number = list(PARENTS).index(side.capitalize() + JOINT_OF[part])
    R_vicon_imu = R[:, number] @ rotation.exp(torch.from_numpy(rng.standard_normal(3)))
    force = acceleration(p[:, number], 60.0, n=1) + torch.tensor([0.0, 9.81, 0.0])
    quat = quat_wxyz_from_matrix(reference.mT @ R_vicon_imu)
    in_imu = (R_vicon_imu.mT @ force[..., None])[..., 0]
    return torch.cat([quat, in_imu, torch.zeros(len(R), 3), torch.ones(len(R), 3)], 1).numpy()
