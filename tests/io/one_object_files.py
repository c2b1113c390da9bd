"""Small data sets in BEHAVE's and OMOMO's layouts: someone who stands in several places with a box."""

import json
from pathlib import Path

import joblib
import numpy as np
import torch

from boxes import BOX_FACES, box_corners
from wearcap.body.skeleton import Skeleton
from wearcap.body.skeletons import smplh52, smplx22
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.formats.amass import PELVIS_SMPLH
from wearcap.io.formats.ply import Ply, write_ply
from wearcap.io.formats.smpl import A
from wearcap.recording import Motion

BEHAVE_NAME, OMOMO_NAME = "Date03_Sub04_boxlarge_hand", "sub16_largebox_007"
T_CAMERA_WORLD = torch.tensor([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
"""A level camera's axes: x right, y down, z forward."""
CORNERS = box_corners((0.0, 0.0, 0.0), (0.4, 0.3, 0.2))
"""Of a box (m) whose corner is the origin."""
FLOOR = -1.3
"""Of the data's own world (m)."""
TRANS2JOINT = np.array([0.01, 0.35, -0.02], np.float32)
SCALE = 0.5


def standing_about(seconds: float = 6.0, fps: float = 30.0, skeleton: Skeleton | None = None) -> Motion:
    """A second each at corners of a square of 0.9 m, with strides of half a second between them."""
    skeleton = skeleton or smplh52()
    times = torch.arange(round(seconds * fps), dtype=torch.float64) / fps
    corners = torch.tensor([[0.0, 0], [0.9, 0], [0.9, 0.9], [0, 0.9], [0, 0]])
    place = times / 1.5
    share = ((place.remainder(1.0) - 2 / 3) * 3).clamp(0, 1).float()[:, None]
    index = place.long() % 4
    plan = torch.lerp(corners[index], corners[index + 1], share)
    R = torch.eye(3).repeat(len(times), len(skeleton), 1, 1)
    R[:, skeleton.index("head")] = rotation.about_axis("z", 0.5 * torch.sin(2 * times).float())
    R[:, 0] = rotation.about_axis("z", 0.3 * times.float())
    t = torch.cat([plan, torch.full((len(times), 1), skeleton.root_height + FLOOR)], 1)
    return Motion(times, skeleton, R, t)


def carried(motion: Motion) -> Trajectory:
    """The path of the box' centre, half a metre before the pelvis."""
    R = rotation.exp(torch.stack([0.4 * motion.timestamps, 0.2 * motion.timestamps, motion.timestamps], -1)).float()
    return Trajectory(motion.timestamps, R, motion.t_world_root + torch.tensor([0.5, 0.0, 0.1]))


def smpl_vectors(motion: Motion, C: torch.Tensor | None = None) -> np.ndarray:
    """Rotation vectors in SMPL's axes, the root's in a world turned by C."""
    R = motion.R_parent_joint.double()
    root = R[:, :1] @ A if C is None else C.double() @ R[:, :1] @ A
    return rotation.log(torch.cat([root, A.T @ R[:, 1:] @ A], 1)).flatten(1).numpy()


def frame_times(count: int, step_s: float = 1 / 30) -> np.ndarray:
    return np.array([f"t{3 + k * step_s:08.3f}" for k in range(count)])


def behave_arrays(tilt_deg: float = 0.0, seconds: float = 6.0) -> tuple[dict, dict]:
    """Contents of smpl_fit_all.npz and object_fit_all.npz, seen by a camera that looks down by `tilt_deg`."""
    motion = standing_about(seconds)
    path = carried(motion)
    C = rotation.about_axis("x", torch.tensor(tilt_deg).deg2rad()) @ T_CAMERA_WORLD
    body = {
        "poses": smpl_vectors(motion, C),
        "trans": (motion.t_world_root @ C.T).numpy() - PELVIS_SMPLH,
        "betas": np.tile(np.arange(10) / 10, (len(motion), 1)),
        "frame_times": frame_times(len(motion)),
        "gender": np.array("male"),
    }
    handled = {
        "angles": rotation.log(C.double() @ path.R_world_body.double()).numpy(),
        "trans": (path.t_world_body @ C.T).numpy(),
        "frame_times": frame_times(len(motion)),
    }
    return body, handled


def write_behave(
    root: Path,
    name: str = BEHAVE_NAME,
    body: dict | None = None,
    handled: dict | None = None,
    cat: str = "boxlarge",
    ply: Ply | None = None,
    tilt_deg: float = 0.0,
) -> Path:
    """A data set of one sequence; arrays that are given as None are left out."""
    first, second = behave_arrays(tilt_deg)
    folder = root / "sequences" / name
    folder.mkdir(parents=True, exist_ok=True)
    for file, arrays, changes in (("smpl", first, body), ("object", second, handled)):
        kept = {key: value for key, value in (arrays | (changes or {})).items() if value is not None}
        np.savez(folder / f"{file}_fit_all.npz", **kept)
    info = {"cat": cat, "gender": "male", "config": "../calibs", "intrinsic": "../calibs", "empty": None}
    (folder / "info.json").write_text(json.dumps(info))
    write_ply(ply or Ply(CORNERS, None, BOX_FACES), root / "objects" / cat / f"{cat}_f1000.ply")
    return root


def omomo_entry(fps: float = 30.0, name: str = OMOMO_NAME, seconds: float = 6.0) -> dict:
    motion = standing_about(seconds, fps, smplx22())
    path = carried(motion)
    vectors = smpl_vectors(motion).astype(np.float32)
    center = torch.from_numpy(CORNERS.mean(0))
    t = path.t_world_body - path.R_world_body @ center
    return {
        "seq_name": name,
        "gender": np.array("female"),
        "betas": np.full((1, 16), 0.25, np.float32),
        "trans": motion.t_world_root.numpy() + TRANS2JOINT,
        "trans2joint": TRANS2JOINT,
        "root_orient": vectors[:, :3],
        "pose_body": vectors[:, 3:66],
        "rest_offsets": np.zeros((24, 3), np.float32),
        "obj_rot": path.R_world_body.numpy(),
        "obj_trans": t.numpy()[:, :, None],
        "obj_scale": np.full(len(motion), SCALE, np.float32),
        "obj_com_pos": path.t_world_body.numpy(),
    }


def obj_text(unit: float = 1 / SCALE) -> str:
    lines = ["# a box", "mtllib box.mtl", *(f"v {x} {y} {z}" for x, y, z in (CORNERS * unit).tolist())]
    faces = (f"f {a + 1}//1 {b + 1}//1 {c + 1}//1" for a, b, c in BOX_FACES.tolist())
    return "\n".join([*lines, "usemtl wood", *faces]) + "\n"


def write_omomo(root: Path, *entries: dict, mesh: str | None = None, split: str = "test") -> Path:
    (root / "captured_objects").mkdir(parents=True, exist_ok=True)
    (root / "captured_objects" / "largebox_cleaned_simplified.obj").write_text(obj_text() if mesh is None else mesh)
    joblib.dump(dict(enumerate(entries or (omomo_entry(),))), root / f"{split}_diffusion_manip_seq_joints24.p")
    return root
