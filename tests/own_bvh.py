"""A BVH file as a motion of the file's own skeleton: what `write_bvh` wrote, read back without another body."""

import warnings
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.skeleton import Site, Skeleton
from wearcap.io.formats.bvh import BvhContent, axes_rotation, read_bvh_content
from wearcap.io.formats.motion_npz import nominal_fps
from wearcap.recording.motion import Motion

_END_SITES = {
    "toe": "toe_tip",
    "toebase": "toe_tip",
    "wrist": "fingertip",
    "handindex1": "fingertip",
    "thumb": "thumb_tip",
}
"""wearcap's names of End Sites, by the joint's name without its side."""
STRETCH_M = 0.005
"""Largest change of a bone's length without a warning."""


def read_bvh(path: str | Path, *, unit_m: float | int = 0.01, up: str = "y", forward: str = "z") -> Motion:
    """Read a .bvh file (plain, .gz or .xz). Rest is the file's bind pose; End Sites become sites.

    `unit_m`: metres per unit. `up`, `forward`: the file's axes ("x", "-y" …) that point up, and ahead of the body in
    its bind pose. Raises WearcapError naming file and line.
    """
    path = Path(path)
    R_world_file = axes_rotation(path, up, forward)
    content = read_bvh_content(path)
    for note in content.notes:
        warnings.warn(f"{path}: {note}", stacklevel=2)
    bones = _bones(path, content, float(unit_m))
    to_world = float(unit_m) * R_world_file.T
    skeleton = Skeleton("bvh", content.names, content.parents, (bones @ to_world).float(), _sites(content, to_world))
    return Motion(
        torch.arange(len(content.R_parent_joint), dtype=torch.float64) / nominal_fps(1 / content.step_s),
        skeleton,
        (R_world_file @ content.R_parent_joint @ R_world_file.T).float(),
        (content.t_parent_joint[:, 0] @ to_world).float(),
        provenance={"source": path.name, "format": "bvh"},
    )


def _bones(path: Path, content: BvhContent, unit_m: float) -> Float[Tensor, "joint 3"]:
    """Constant bone offsets (file units; the root's is zero), from OFFSET or from the position channels' median."""
    bones = content.t_parent_joint.median(0).values
    stretch = (content.t_parent_joint - bones).norm(dim=-1).amax(0) * unit_m
    stretch[0], bones[0] = 0, 0
    worst = int(stretch.argmax())
    if stretch[worst] > STRETCH_M:
        warnings.warn(
            f"{path}: bone {content.names[worst]!r} changes its length by up to {stretch[worst]:.3f} m; "
            "its median is kept",
            stacklevel=3,
        )
    return bones


def _sites(content: BvhContent, to_world: Float[Tensor, "3 3"]) -> dict[str, Site]:
    """End Sites, under wearcap's names where their joints' names are known ("LeftToeBase", "l_wrist" …)."""
    sites = {}
    for joint, end in zip(content.names, content.ends):
        if end is None:
            continue
        plain = joint.lower().replace("_", "")
        named = [
            f"{side}_{_END_SITES[plain.removeprefix(start)]}"
            for side, start in (("left", "left"), ("right", "right"), ("left", "l"), ("right", "r"))
            if plain.startswith(start) and plain.removeprefix(start) in _END_SITES
        ]
        name = "crown" if plain == "head" else [*named, f"{joint}_end"][0]
        sites[name] = Site(joint, tuple((torch.tensor(end, dtype=torch.float64) @ to_world).tolist()))
    return sites
