"""AMASS: SMPL+H `.npz` files and SMPL-X "stageii" files in; AMASS-style SMPL+H files out.

AMASS' world is metric and z up; its joint frames are SMPL's (`io.formats.smpl`). SMPL turns about its pelvis but places its
template's origin, so the pelvis stands at `trans` + J₀ with J₀ the template's pelvis in SMPL's own axes.
"""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.skeletons import smplh52, smplx22
from wearcap.boundary.arrays import open_archive, read_npz, require
from wearcap.errors import WearcapError, require_choice
from wearcap.files import atomic_path
from wearcap.geometry import rotation
from wearcap.io.formats.bvh import axes_rotation
from wearcap.io.formats.motion_npz import even_frames, nominal_fps
from wearcap.io.formats.smpl import A, shape_from_arrays, smpl_motion
from wearcap.recording import Motion, Recording

PELVIS_SMPLH = (-0.0022, -0.2408, 0.0286)
PELVIS_SMPLX = (0.0031, -0.3514, 0.0120)
"""J₀ of the mean bodies (m); a person's own differs by a few centimetres with the betas."""

_RATES = ("mocap_framerate", "mocap_frame_rate")
_KEYS = ("trans", "poses", "root_orient", "pose_body", "betas", "gender", "surface_model_type", *_RATES)
_SMPLX_BODY = 66
_TURNS = {up: axes_rotation(Path(), up, "xyz"["zxy".index(up[-1])]).float() for up in ("x", "y", "z", "-x", "-y", "-z")}
"""Rotations of worlds into ours, by their axis that points up."""
_CAMERAS = re.compile("cam|points3d|intrinsic|extrinsic|focal|image|[cw]2[cw]|hwf", re.IGNORECASE)
_LYING_M = 0.35
"""Greatest height of the pelvis of somebody who lies."""


def read_amass(path: str | Path, up: str = "auto") -> Recording:
    """Read one AMASS file as a Recording with `motion` (smplh52 or smplx22), betas in `shape`, gender in provenance.

    `up` is the file's axis that points up; it is z, as in AMASS, where "auto" does not see somebody stand along another,
    which `note` then says. J₀ is the mean body's, and the skeleton keeps its standard bone lengths. Raises WearcapError for
    missing arrays, as in `shape.npz` or cameras' poses, wrong shapes, NaN, or a rate of zero.
    """
    path = Path(path)
    require_choice(up, ("auto", *_TURNS), f"up={up}")
    arrays = read_npz(path, _KEYS)
    _require_motion(arrays, path)
    fps = _rate(arrays, path)
    model = _text(arrays.get("surface_model_type")).lower()
    stageii = "pose_body" in arrays or "mocap_frame_rate" in arrays or model.startswith("smplx")
    if stageii and "pose_body" in arrays:
        require(arrays, path, trans=("time", 3), root_orient=("time", 3), pose_body=("time", _SMPLX_BODY - 3))
        rotvec = np.concatenate([arrays["root_orient"], arrays["pose_body"]], -1)
    else:
        width = 165 if stageii else 156
        require(arrays, path, trans=("time", 3), poses=("time", width))
        rotvec = arrays["poses"][:, : _SMPLX_BODY if stageii else width]
    if len(rotvec) == 0:
        raise WearcapError("no frames", path)
    skeleton = smplx22() if stageii else smplh52()
    t_template_pelvis = PELVIS_SMPLX if stageii else PELVIS_SMPLH
    pelvis = arrays["trans"].astype(np.float64) + t_template_pelvis
    times = torch.arange(len(rotvec), dtype=torch.float64) / fps
    about = {"source": path.name, "format": "amass", "gender": _text(arrays.get("gender"))}
    motion = smpl_motion(times, skeleton, rotvec, pelvis, **about)
    axis = _standing_axis(motion) if up == "auto" else up
    note = f"Its {axis} axis points up, not AMASS' z: it is turned." if axis != "z" and up == "auto" else ""
    return Recording(
        path.stem,
        motion=motion if axis == "z" else _turned(motion, axis, t_template_pelvis),
        skeleton=skeleton,
        shape=shape_from_arrays(arrays, path),
        subject=path.absolute().parent.name,
        source="AMASS",
        note=note,
    )


def _require_motion(arrays: dict[str, np.ndarray], path: Path) -> None:
    """Raise WearcapError with the arrays that are missing, and what a file without them looks like."""
    needed = {"poses": ("poses", "pose_body"), "trans": ("trans",), "frame rate (mocap_framerate)": _RATES}
    missing = [name for name, keys in needed.items() if not any(key in arrays for key in keys)]
    if not missing:
        return
    with open_archive(path, "arrays", "arrays saved by NumPy") as (archive, _):
        names = sorted(name.removesuffix(".npy") for name in archive.namelist())
    shape = arrays["poses"].shape if "poses" in arrays else ()
    if len(shape) == 3 or shape[1:] in ((12,), (16,), (17,)) or any(map(_CAMERAS.match, names)):
        fix = "It looks like cameras of an SfM or NeRF model: leave it out."
    else:
        fix = "" if shape else "shape.npz files beside the motions hold none: leave them out."
    what = f"holds no {', no '.join(missing)}, but {', '.join(names)[:200]}"
    raise WearcapError(what, path, "a motion file of AMASS", fix)


def _standing_axis(motion: Motion) -> str:
    """The world's axis along which somebody stands on the ground at 0 in most frames; "z" where that is not clear.

    Who lies on the ground of a world with z up may be along any axis: there it is not clear.
    """
    t = motion.T_world_joint.t
    feet = t[:, motion.skeleton.indices("left_ankle", "right_ankle", "left_foot", "right_foot")]
    body = t[:, motion.skeleton.index("head")] - feet.mean(1)
    lies = ((t[:, 0, 2] > 0) & (t[:, 0, 2] < _LYING_M)).float().mean() > 0.8
    for up, R in _TURNS.items():
        stands = (body @ R[2] > 0.8 * body.norm(dim=-1)).float().mean() > 0.8
        if stands and not lies and (feet @ R[2]).amin(-1).median().abs() < 0.35:
            return up
    return "z"


def _turned(motion: Motion, up: str, t_template_pelvis: Sequence[float]) -> Motion:
    """A motion of a world with another `up` axis in one with z up.

    Who turned a file of AMASS into such axes often turned `trans` alone, without J₀: feet off the ground by decimetres show it.
    """
    R_up, J0 = _TURNS[up], torch.tensor(t_template_pelvis)
    R = torch.cat([R_up @ motion.R_parent_joint[:, :1], motion.R_parent_joint[:, 1:]], 1)
    roots = (motion.t_world_root @ R_up.T + shift for shift in (torch.zeros(3), J0 - R_up @ J0))
    both = (replace(motion, R_parent_joint=R, t_world_root=root) for root in roots)
    return min(both, key=lambda motion: round(abs(motion.T_world_joint.t[..., 2].amin(-1).median().item()), 1))


def write_amass(
    motion: Motion,
    path: str | Path,
    betas: Float[Tensor, "feature"] | None = None,
    t_template_pelvis: Sequence[float] = PELVIS_SMPLH,
) -> None:
    """Write a motion of an SMPL skeleton as an AMASS SMPL+H file of neutral gender; missing hands stay flat, gaps repeat the nearest frame.

    `t_template_pelvis` (m, SMPL's axes) is J₀ of the body that these betas make.

    Raises WearcapError for another skeleton or values that are not finite.
    """
    target = smplh52()
    if set(motion.skeleton.joint_names[:22]) != set(target.joint_names[:22]):
        what = f"a motion of skeleton {motion.skeleton.name!r}"
        raise WearcapError(what, path, "one of SMPL's skeletons", 'Retarget it to "smplh52" first (body.retarget).')
    if not (motion.R_parent_joint.isfinite().all() and motion.t_world_root.isfinite().all()):
        raise WearcapError("the motion holds NaN or infinite values", path, "finite poses")
    frames, fps = even_frames(motion)
    source = motion.R_parent_joint[frames].double()
    R = torch.eye(3, dtype=torch.float64).repeat(len(frames), len(target), 1, 1)
    known = [name for name in target.joint_names if name in motion.skeleton.joint_names]
    R[:, target.indices(*known)] = source[:, motion.skeleton.indices(*known)]
    R = torch.cat([R[:, :1] @ A, A.T @ R[:, 1:] @ A], 1)
    trans = motion.t_world_root[frames].double() - torch.tensor(list(t_template_pelvis), dtype=torch.float64)
    shape = np.zeros(16)
    if betas is not None:
        shape[: len(betas[:16])] = betas[:16].double().numpy()
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez(
            file,
            trans=trans.numpy(),
            gender=np.array("neutral"),
            mocap_framerate=np.array(fps),
            betas=shape,
            dmpls=np.zeros((len(frames), 8)),
            poses=rotation.log(R).flatten(1).numpy(),
        )


def _rate(arrays: dict[str, np.ndarray], path: Path) -> float:
    found = [arrays[key] for key in _RATES if key in arrays]
    if not found or found[0].size != 1 or not np.issubdtype(found[0].dtype, np.number):
        raise WearcapError("no frame rate", path, "mocap_framerate or mocap_frame_rate, one number")
    fps = float(found[0].reshape(-1)[0].real)
    if not (np.isfinite(fps) and 0 < fps < 1e5):
        raise WearcapError(f"a frame rate of {fps} Hz", path, "a positive number")
    return nominal_fps(fps)


def _text(array: np.ndarray | None) -> str:
    """A string that was saved as str or bytes."""
    if array is None or array.size != 1 or array.dtype.kind not in "SU":
        return ""
    value = array.reshape(-1)[0]
    return value.decode("latin-1") if isinstance(value, bytes) else str(value)
