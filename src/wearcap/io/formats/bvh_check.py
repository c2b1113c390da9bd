"""Check that a body is a person's, upright and in metres; if not, name the setting that would make it so."""

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.skeleton import Skeleton
from wearcap.errors import WearcapError
from wearcap.recording.motion import Motion

UNITS_M = {
    "metres": 1.0,
    "decimetres": 0.1,
    "centimetres": 0.01,
    "millimetres": 0.001,
    "inches": 0.0254,
    "feet": 0.3048,
    "CMU's units": 0.0254 / 0.45,
}
REACH_PER_HEIGHT = 1.46
"""Longest path along the bones (fingertip to toe tip) over body height; in the tested skeletons 1.46 … 1.53."""

HEIGHT_M = (0.6, 2.6)


def check_body(motion: Motion, path: Path, unit_m: float, R_world_file: Float[Tensor, "3 3"]) -> None:
    """Raise WearcapError, naming the setting that fixes it, when the body is no person's size or lies on its side."""
    height = longest_path(motion.skeleton) / REACH_PER_HEIGHT
    if not HEIGHT_M[0] < height < HEIGHT_M[1]:
        nearest = {name: abs(height / unit_m * unit - 1.7) for name, unit in UNITS_M.items()}
        name = min(nearest, key=lambda name: nearest[name])
        raise WearcapError(
            f"the body would be about {height:.3g} m tall with unit_m={unit_m:g}",
            where=path,
            expected="a person's size",
            fix=f"unit_m={UNITS_M[name]:.6g} ({name}) would make it {height / unit_m * UNITS_M[name]:.2f} m; "
            "check=False takes it as it is.",
        )
    rest, moving = _extents(motion)
    long_axes = [axis for axis in (0, 1) if rest[2] < 0.5 * rest[axis] and moving[2] < 0.6 * moving[axis]]
    if long_axes:
        # Arms may span as much as the body is tall, but only across them left mirrors right.
        axis = max(long_axes, key=lambda axis: _mirror_error(motion.skeleton, axis))
        name = "xyz"[int(R_world_file[axis].abs().argmax())]
        raise WearcapError(
            f"the body lies down: {moving[2]:.2f} m high and {moving[axis]:.2f} m long",
            where=path,
            expected="a person upright in the bind pose or in most frames",
            fix=f'up="{name}" (or "-{name}") would raise it; check=False takes it as it is.',
        )


def _mirror_error(skeleton: Skeleton, axis: int) -> float:
    """Mean distance (m) from each joint, mirrored along an axis through the root, to the nearest joint at rest."""
    mirror = torch.ones(3)
    mirror[axis] = -1
    return torch.cdist(skeleton.rest_joints * mirror, skeleton.rest_joints).amin(1).mean().item()


def longest_path(skeleton: Skeleton) -> float:
    """Length (m) of the longest path along the bones from one end of the tree to another."""
    bones = skeleton.t_parent_joint.double().norm(dim=-1).tolist()
    down = [0.0] * len(skeleton)
    for site in skeleton.sites.values():
        joint = skeleton.index(site.joint)
        down[joint] = max(down[joint], torch.tensor(site.t_joint_site).norm().item())
    longest = 0.0
    for joint in range(len(skeleton) - 1, 0, -1):
        parent, length = skeleton.parents[joint], down[joint] + bones[joint]
        longest = max(longest, down[parent] + length)
        down[parent] = max(down[parent], length)
    return longest


def _extents(motion: Motion) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Size (m) of the box around the joints: in the bind pose, and in the median over the frames."""
    rest = motion.skeleton.rest_joints
    positions = motion.sliced(0, len(motion)).T_world_joint.t
    moving = (positions.amax(1) - positions.amin(1)).median(0).values
    return rest.amax(0) - rest.amin(0), moving
