"""Small files in the H-contact and EgoHOI data sets' layouts."""

import json
import zipfile
from pathlib import Path

import numpy as np
import torch

from wearcap.body.skeletons import smpl24, smplh52
from wearcap.geometry import rotation
from wearcap.io.formats.smpl import A
from wearcap.recording import Motion
from wearcap_testing import swaying_motion


def motion(frames: int = 120, seed: int = 0, hands: bool = True, fps: float = 60.0) -> Motion:
    return swaying_motion(frames, seed, fps=fps, skeleton=smplh52() if hands else smpl24())


def smpl_frames(motion: Motion, placed: bool = True, body: int = 69) -> list[dict]:
    """As the data sets keep poses: axis-angle in SMPL's axes, the root joint's place."""
    R = motion.R_parent_joint.double()
    vectors = rotation.log(torch.cat([R[:, :1] @ A, A.T @ R[:, 1:] @ A], 1)).flatten(1).numpy()
    hands = len(motion.skeleton) == 52
    frames = []
    for time, pose, t in zip(motion.timestamps.tolist(), vectors, motion.t_world_root.tolist()):
        frame = {"time": time, "global_orient": pose[:3].tolist(), "body_pose": pose[3:72].tolist()}
        if hands:
            padding = [0.0] * (body - 63)
            frame |= {
                "body_pose": pose[3:66].tolist() + padding,
                "left_hand_pose": pose[66:111].tolist(),
                "right_hand_pose": pose[111:].tolist(),
            }
        frames.append(frame | ({"transl": t} if placed else {}))
    return frames


def smpl_content(motion: Motion, **more) -> dict:
    return {"sequence": smpl_frames(motion, **more), "global": {"betas": [0.5, -1.0], "gender": "female"}}


def older(motion: Motion) -> list[dict]:
    """The older form, without hands."""
    return [
        {
            "time": frame["time"],
            "pose": frame["global_orient"] + frame["body_pose"],
            "translation": frame["transl"],
            "shape": [0.5, -1.0],
        }
        for frame in smpl_frames(motion)
    ]


def write_zip(content, path: Path, inner: str = "data.json") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(inner, content if isinstance(content, str | bytes) else json.dumps(content))


def write_json(content, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content if isinstance(content, str) else json.dumps(content))


def moved(motion: Motion, wanted: Motion) -> float:
    """Greatest distance (m) of any joint between two motions."""
    return float(np.abs((motion.T_world_joint.t - wanted.T_world_joint.t).numpy()).max())
