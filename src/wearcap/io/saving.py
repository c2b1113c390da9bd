"""Motion as a file of the kind that its name's ending says."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from wearcap.body.anny_body import anny_body
from wearcap.body.kinematics import site_positions
from wearcap.body.retarget import retarget
from wearcap.body.skeleton import Skeleton
from wearcap.body.skeletons import smplh52
from wearcap.errors import WearcapError, require_choice
from wearcap.extras import required
from wearcap.io.formats.amass import write_amass
from wearcap.io.formats.bvh import write_bvh
from wearcap.io.formats.gltf import write_glb
from wearcap.io.formats.mot import write_angles, write_mot
from wearcap.io.formats.motion_npz import write_motion
from wearcap.io.formats.trc import Markers, write_trc
from wearcap.io.formats.vrma import write_vrma
from wearcap.recording.motion import Motion


def on_skeleton(motion: Motion, skeleton: Skeleton) -> Motion:
    """The motion retargeted to another skeleton, without the deviations of joints that it does not have. Raises WearcapError where limbs are not recognised."""
    R, root = retarget(motion.skeleton, skeleton, motion.R_parent_joint, motion.t_world_root)
    return replace(motion, skeleton=skeleton, R_parent_joint=R, t_world_root=root, joint_std=None, joint_dof=None)


def write_smplh(motion: Motion, path: Path) -> None:
    """SMPL+H's pose parameters as AMASS has them, of the neutral mean shape: rotations are right, bones are not the wearer's."""
    write_amass(on_skeleton(motion, smplh52()), path)


def usd_writer() -> Callable[..., None]:
    """`io.formats.usd.write_usd`. Raises WearcapError when the extra is missing."""
    return required("wearcap.io.formats.usd", "USD files").write_usd


def _write_with_surface(motion: Motion, path: Path) -> None:
    """A .glb or USD with a human surface, or with bones alone for a skeleton that it does not fit."""
    write = write_glb if path.suffix == ".glb" else usd_writer()
    try:
        body = anny_body(motion.skeleton)
    except WearcapError:
        body = None
    write(motion, path, body=body)


def write_virtual_markers(motion: Motion, path: Path) -> None:
    """A .trc with a marker at each joint's centre and each landmark (heels, toe tips, crown …), by their names."""
    skeleton, T = motion.skeleton, motion.T_world_joint
    sites = tuple(skeleton.sites)
    points = torch.cat([T.t, site_positions(skeleton, T, sites)], 1) if sites else T.t
    write_trc(Markers(motion.timestamps, (*skeleton.joint_names, *sites), points.double()), path)


USD = (".usd", ".usda", ".usdc", ".usdz")
WRITERS: dict[str, Callable[[Motion, Path], None]] = {
    ".npz": write_motion,
    ".bvh": write_bvh,
    "_smplh.npz": write_smplh,
    ".vrma": write_vrma,
    **dict.fromkeys((".glb", *USD), _write_with_surface),
    ".trc": write_virtual_markers,
    ".mot": write_mot,
    "_angles.csv": write_angles,
}
"""What writes a motion, by the ending of the file's name; the longest ending counts."""
FORMATS = {ending.strip("._").split(".")[0]: ending for ending in WRITERS}
"""Endings by the words of `formats` ("glb", "angles")."""


def require_formats(names: Sequence[str]) -> None:
    """Raise WearcapError unless motion can be written in each of these `FORMATS`, and what that needs is there."""
    if isinstance(names, str):
        raise WearcapError(f"formats={names}", expected=f"a list: formats=[{names}]")
    for name in names:
        require_choice(name, FORMATS, f"formats has {name!r}")
        if FORMATS[name] in USD:
            usd_writer()


def save(motion: Motion, path: str | Path) -> None:
    """Write a motion as .npz, .bvh, .glb, .usd (.usda, .usdc, .usdz), .vrma, _smplh.npz, .trc, .mot or _angles.csv.

    Raises WearcapError for another ending, a missing extra, and when the file cannot be written.
    """
    endings = [ending for ending in WRITERS if Path(path).name.endswith(ending)]
    if not endings:
        raise WearcapError("no kind of motion file", path, f"a name that ends with {', '.join(WRITERS)}")
    WRITERS[max(endings, key=len)](motion, Path(path))
