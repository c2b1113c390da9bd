"""Small files in the HPS data set's layout, for the tests of its reader and of its preparation."""

import json
import pickle
from pathlib import Path

import numpy as np
import torch
from ocam_files import lens, xml_of

from data_prep.hps import PELVIS_SMPL, UNITY_JOINTS, nominal_mount
from wearcap.body.skeletons import smpl24
from wearcap.geometry import rotation
from wearcap.io.formats.ply import Ply, write_ply
from wearcap.io.formats.smpl import A
from wearcap.recording import Motion
from wearcap_testing import swaying_motion

NAME = "SUB4_MPI_Etage6_walking"
SCAN = "MPI_Etage6"
CAM_START, IMU_START = 20, 35
FRAMES = 90
CAMERA = {
    "029756": {
        "parameters": {
            "focal_dist_xy": [871.80, 885.58],
            "center_xy": [961.54, 550.69],
            "dist_coeffs": [-0.2546, 0.0804, 1.458e-4, -1.397e-5, 0.0],
        },
        "captured_videos": [f"{NAME}.MP4", "SUB4_other.MP4"],
    }
}


def motion(frames: int = FRAMES, seed: int = 0) -> Motion:
    return swaying_motion(frames, seed, fps=30.0, skeleton=smpl24())


def write_smpl(motion: Motion, path: Path) -> None:
    """As the published pickles: axis-angle in SMPL's axes, the template's place, z up."""
    R = motion.R_parent_joint.double()
    R = torch.cat([R[:, :1] @ A, A.T @ R[:, 1:] @ A], 1)
    poses = rotation.log(R).flatten(1).numpy()
    transes = motion.t_world_root.double().numpy() - np.array(PELVIS_SMPL)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps({"poses": poses, "transes": transes}))


def unity_euler_deg(R_left_handed: torch.Tensor) -> torch.Tensor:
    """Unity's (x, y, z) of R = Ry Rx Rz, written from that product's entries."""
    x = torch.asin(-R_left_handed[..., 1, 2])
    y = torch.atan2(R_left_handed[..., 0, 2], R_left_handed[..., 2, 2])
    z = torch.atan2(R_left_handed[..., 1, 0], R_left_handed[..., 1, 1])
    return torch.rad2deg(torch.stack([x, y, z], -1))


def write_unity(motion: Motion, folder: Path, name: str = NAME, inner_root: bool = True) -> None:
    """A motion in our axes as Unity would show it: y up, x right, left-handed."""
    mirror = torch.diag(torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64))
    R_smpl = A.T @ motion.R_parent_joint.double() @ A
    order = [motion.skeleton.index(joint) for joint in UNITY_JOINTS]
    angles = unity_euler_deg(mirror @ R_smpl[:, order] @ mirror)
    if inner_root:
        angles = torch.cat([angles[:, :1], torch.zeros_like(angles[:, :1]), angles[:, 1:]], 1)
    t = (motion.t_world_root.double() @ A - torch.tensor(PELVIS_SMPL, dtype=torch.float64)) @ mirror
    folder.mkdir(parents=True, exist_ok=True)
    for suffix, table in (("pose", angles.flatten(1)), ("trans", t)):
        lines = [" ".join(f"{value:.6f}" for value in row) for row in table.tolist()]
        (folder / f"{name}_{suffix}.txt").write_text("\n".join(lines) + "\n")


def write_localization(motion: Motion, path: Path, cam_start: int = CAM_START, lost: tuple[int, ...] = (3, 40)) -> None:
    """A camera on the head by its nominal mount; the clap is at frame `cam_start`, before it stands still."""
    R_head_cam, t_head_cam = nominal_mount()
    head = motion.joint("head")
    R, t = head.R @ R_head_cam, head @ t_head_cam
    rows = {}
    for frame in range(cam_start + len(motion)):
        k = max(frame - cam_start, 0)
        quat = rotation.quat_wxyz_from_matrix(R[k]).tolist()
        rows[str(frame)] = None if frame in lost else {"position": t[k].tolist(), "quaternion": quat}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(rows))


def write_scan(folder: Path) -> None:
    """Two frames of two cameras, and a cloud of one square metre."""
    for part in ("cam", "info"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    for frame in (0, 1):
        pose = {"position": [1.5 * frame, 2.0, 1.7], "quaternion": [0.5, -0.5, 0.5, -0.5]}
        info = {f"cam{k}": pose for k in range(2)} | {
            "cam_head": pose,
            "footprint": pose,
            "timestamp": 1.6e9,
            "valid": "true",
        }
        (folder / "info" / f"{frame:05d}-info.json").write_text(json.dumps(info))
        for k in range(2):
            (folder / "cam" / f"{frame:05d}-cam{k}.jpg").write_bytes(b"not opened by the reader")
    (folder / "cam" / "info.list").write_text("00000-cam0.jpg\n")
    (folder / "sensor_frame.xml").write_text(xml_of({"cam0": lens(0.2), "cam1": lens(0.2)}))
    ticks = np.arange(0, 1, 0.02)
    x, y = (axis.ravel() for axis in np.meshgrid(ticks, ticks))
    points = np.stack([x, y, 0 * x], 1).astype(np.float32)
    write_ply(Ply(points, np.full(points.shape, 128, np.uint8)), folder / "pointcloud.ply")


def write_hps(root: Path, name: str = NAME, scan: bool = True, frames: int = FRAMES) -> Motion:
    """A whole sequence; returns its motion. The suit wanders off: its world is turned and shifted."""
    truth = motion(frames)
    write_smpl(truth, root / "hps_smpl" / f"{name}.pkl")
    subject = {"betas": [0.1 * k for k in range(10)], "gender": "male", "root_to_heel": 0.93}
    for folder, content in (("hps_betas", subject), ("hps_inits", {"cam_start": CAM_START, "imu_start": IMU_START})):
        path = root / folder / (f"{name.split('_')[0]}.json" if folder == "hps_betas" else f"{name}.json")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(content))
    write_localization(truth, root / "head_camera_localizations" / f"{name}.json")
    write_unity(motion(IMU_START + frames, seed=1), root / "hps_txt", name)
    (root / "head_camera_videos").mkdir(exist_ok=True)
    (root / "head_camera_videos" / "cameras.json").write_text(json.dumps(CAMERA))
    if scan:
        write_scan(root / "scans" / SCAN)
    return truth


def same_motion(a, b, atol: float = 1e-5) -> None:
    assert a.skeleton.name == b.skeleton.name == "smpl24"
    torch.testing.assert_close(a.R_parent_joint, b.R_parent_joint, atol=atol, rtol=0)
    torch.testing.assert_close(a.t_world_root, b.t_world_root, atol=atol, rtol=0)
