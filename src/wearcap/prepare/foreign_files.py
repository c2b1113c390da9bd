"""BVH and ASF/AMC files as they stand: world rotations and places of their joints and of their chains' ends."""

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import Skeleton
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.io.formats.asf_amc import read_amc, read_asf
from wearcap.io.formats.bvh import BvhContent, read_bvh_content
from wearcap.io.formats.motion_npz import nominal_fps

BALL_OF_FOOT = 0.69
"""Place of the toes' joint between the ankle and the end of the foot (xsens23's), for feet without that joint."""


@dataclass(frozen=True)
class Take:
    """A file's joints in its own axes and unit."""

    names: tuple[str, ...]
    parents: tuple[int, ...]
    rest: Float[Tensor, "joint 3"]
    """Places in the bind pose, the root at the origin."""
    R: Float[Tensor, "time joint 3 3"]
    t: Float[Tensor, "time joint 3"]
    timestamps: Float[Tensor, "time"]
    joints: int
    """Number of joints; what follows are the ends of chains, End Sites."""
    unit_m: float | None = None
    """None where the format does not say it."""
    up: str | None = None
    format: str = "bvh"
    notes: tuple[str, ...] = ()

    @property
    def lengths(self) -> Float[Tensor, "joint"]:
        """Usual distance of each joint to its parent (file units)."""
        bones = self.t[:, 1:] - self.t[:, list(self.parents[1:])]
        return torch.cat([bones.new_zeros(1), bones.norm(dim=-1).median(0).values])

    def moved(self, joint: int, share: float) -> "Take":
        """The same take with a joint at this share of the way from its parent."""
        t, rest, parent = self.t.clone(), self.rest.clone(), self.parents[joint]
        t[:, joint] = t[:, parent] + share * (t[:, joint] - t[:, parent])
        rest[joint] = rest[parent] + share * (rest[joint] - rest[parent])
        return replace(self, t=t, rest=rest)

    def mirrored(self) -> "Take":
        """The same take with its x axis reversed."""
        S = torch.diag(torch.tensor([-1.0, 1.0, 1.0], dtype=self.t.dtype))
        note = "Left and right are exchanged in it, as in left-handed axes: its x axis is reversed."
        return replace(self, R=S @ self.R @ S, t=self.t @ S, rest=self.rest @ S, notes=(*self.notes, note))

    def lifted(self, joints: list[int], offset: Float[Tensor, "3"]) -> "Take":
        """The same take with an offset, in the frames of their parents, added to joints and all below them."""
        t, rest = self.t.clone(), self.rest.clone()
        for joint, parent in enumerate(self.parents):
            above = joint
            while above >= 0 and above not in joints:
                above = self.parents[above]
            if above >= 0:
                parent = self.parents[above]
                t[:, joint] += self.R[:, parent] @ offset
                rest[joint] += offset
        return replace(self, t=t, rest=rest)


def read_take(path: Path, amc_fps: float | int, asf: Path | None = None) -> Take:
    """Read a .bvh, or an .amc with `asf` or the skeleton file beside it. Raises WearcapError naming file and line."""
    kinds = [part for part in path.name.lower().split(".")[1:] if part in ("bvh", "amc")]
    if not kinds:
        raise WearcapError("no motion file", path, "a name that ends in .bvh or .amc, also with .xz or .gz")
    take = _read_amc(path, asf or asf_beside(path), amc_fps) if kinds[-1] == "amc" else bvh_take(read_bvh_content(path))
    if not (take.t.isfinite().all() and take.rest.isfinite().all()):
        raise WearcapError("joints lie at infinity", path, "finite offsets and positions")
    return take


def bvh_take(content: BvhContent) -> Take:
    """A BVH file's joints and, behind them, its End Sites."""
    names, parents = list(content.names), list(content.parents)
    R, t, rest = content.R_parent_joint, content.t_parent_joint, content.t_rest.clone()
    for joint, end in enumerate(content.ends):
        if end is not None:
            names.append(f"{content.names[joint]} (end)")
            parents.append(joint)
            place = torch.tensor(end, dtype=t.dtype)
            t = torch.cat([t, place.expand(len(t), 1, 3)], 1)
            rest = torch.cat([rest, place[None]])
    joints, eye = len(content.names), torch.eye(3, dtype=R.dtype)
    R = torch.cat([R, eye.expand(len(R), len(names) - joints, 3, 3)], 1)
    notes = content.notes
    if _begins_with_a_leap(R[:4, 1:]):
        R, t = R[1:], t[1:]
        notes = ("The first frame, a pose far from the motion that follows, is left out.", *notes)
    skeleton = Skeleton("file", tuple(str(k) for k in range(len(names))), tuple(parents), rest.float())
    world = forward_kinematics(skeleton, R.contiguous(), t[:, 0].contiguous(), t.contiguous())
    rest[0] = 0
    flat = forward_kinematics(skeleton, eye.repeat(len(names), 1, 1), rest[0], rest)
    times = torch.arange(len(R), dtype=torch.float64) / nominal_fps(1 / content.step_s)
    return Take(tuple(names), tuple(parents), flat.t, world.R, world.t, times, joints, notes=notes)


def _begins_with_a_leap(R_parent_joint: Float[Tensor, "time joint 3 3"]) -> bool:
    """Whether the first frame is a calibration pose: all joints leap to the second, and move little from there."""
    if len(R_parent_joint) < 4:
        return False
    leap, *steps = (rotation.geodesic(R_parent_joint[k], R_parent_joint[k + 1]).mean().item() for k in range(3))
    return leap > max(0.1, 8 * max(steps))


def _read_amc(path: Path, asf: Path, fps: float | int) -> Take:
    motion = read_amc(read_asf(asf), path, fps)
    skeleton = motion.skeleton
    world = forward_kinematics(skeleton, motion.R_parent_joint.double(), motion.t_world_root.double())
    rest, names, parents = skeleton.rest_joints.double(), skeleton.joint_names, skeleton.parents
    R, t, joints = world.R, world.t, len(names)
    if "crown" in skeleton.sites:  # the end of the head's bone
        head = skeleton.index(skeleton.sites["crown"].joint)
        end = rest.new_tensor(skeleton.sites["crown"].t_joint_site)
        names, parents = (*names, f"{names[head]} (end)"), (*parents, head)
        rest = torch.cat([rest, (rest[head] + end)[None]])
        R, t = torch.cat([R, R[:, head, None]], 1), torch.cat([t, (t[:, head] + R[:, head] @ end)[:, None]], 1)
    return Take(names, parents, rest, R, t, motion.timestamps, joints, 1.0, "z", "amc")


def asf_beside(path: Path) -> Path:
    """The skeleton file of an .amc: the one whose name its name begins with, else the only one in its folder.

    Raises WearcapError where there is none.
    """
    there = sorted(p for p in path.parent.iterdir() if p.name.lower().split(".")[1:2] == ["asf"])
    own = [p for p in there if path.name.split(".")[0].startswith(p.name.split(".")[0])]
    if not own and len(there) != 1:
        fix = "An AMC file needs its subject's .asf."
        expected = f"{path.name.split('_')[0]}.asf, or one .asf file"
        raise WearcapError("no skeleton beside it", where=path, fix=fix, expected=expected)
    return max(own or there, key=lambda p: len(p.name.split(".")[0]))
