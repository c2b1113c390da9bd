"""Motion on people's own characters: a rigged .glb, a .vrm, or the hierarchy of a .bvh, with their proportions kept.

The body is found in the file as in imported motions, by names (VRM's humanoid first) or by its tree. Its bind pose is a
standing person's, T or A; a .bvh may have a frame that is one instead.
"""

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.body.character import onto_character
from wearcap.body.foreign_tree import foreign_tree, kept_joints, standing_rotation, straightness
from wearcap.body.joint_matching import common_ancestor
from wearcap.body.skeleton import FOOT_PATCHES, SIDES, Skeleton, ancestors
from wearcap.boundary.opening import placed, understood
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.io.formats.bvh import BvhContent, read_bvh_content, write_bvh_like
from wearcap.io.formats.glb_rig import GlbRig, read_glb_rig, write_glb_rig
from wearcap.io.formats.motion_npz import even_frames
from wearcap.prepare.foreign_conventions import Mapping, find_body, with_toes
from wearcap.prepare.foreign_files import Take, bvh_take
from wearcap.recording.motion import Motion
from wearcap.sensors.contacts import contacts_from_motion

KINDS = (".glb", ".vrm", ".bvh")
_STANDS = 0.5
"""Least probability of a contact."""
_THICKEST = 0.15
"""Most that a mesh reaches below the lowest joint of a foot, over the length of the legs; more is a dress or a pedestal."""
_FLAT = 0.02
"""Least height of ankles over soles, over the length of the legs; below it the file does not show its soles."""


@dataclass(frozen=True)
class Rig:
    """A character: the joints of its file in the bind pose, in the file's axes and unit, and which of them a body drives."""

    path: Path
    file: BvhContent | GlbRig
    parents: tuple[int, ...]
    R_bind: Float[Tensor, "joint 3 3"]
    R_parent_joint: Float[Tensor, "joint 3 3"]
    """Rotations that joints keep which are not driven, such as fingers'."""
    t_parent_joint: Float[Tensor, "joint 3"]
    R_ours_bind: Float[Tensor, "3 3"]
    """Turns the bind pose to our axes."""
    R_world_file: Float[Tensor, "3 3"]
    """Turns the file's axes to our world's; the same, but for a bind pose that is a frame and stands askew."""
    body: Skeleton
    """The driven joints by our names, with the bind pose as rest."""
    driven: tuple[int, ...]
    """The file's joint of each joint of the body; ends of chains count from behind the joints."""
    carrier: int
    """The joint that carries them all: the body's root, or one above it."""
    t_root_carrier: Float[Tensor, "3"]
    """The carrier's place from the body's root in the bind pose, in our axes."""
    ankle_height: float

    @property
    def name(self) -> str:
        """The file's name without its endings."""
        return self.path.name[: self.path.name.lower().index(self.suffix)]

    @property
    def suffix(self) -> str:
        """Ending of the names of its files."""
        return kind_of(self.path)


def kind_of(path: str | Path) -> str:
    """One of `KINDS`, by the name of a file that may also be packed. Raises WearcapError for another name."""
    kinds = [suffix.lower() for suffix in Path(path).suffixes if suffix.lower() in KINDS]
    if not kinds:
        raise WearcapError("no character", path, f"a file that ends with {', '.join(KINDS)}")
    return kinds[-1]


def read_rig(path: str | Path) -> Rig:
    """Read a character.

    Raises WearcapError for a file of another kind, one that is damaged, one without a head, two arms and two legs (with what
    was not found and the names that were expected), and one in which nobody stands.
    """
    path = Path(path)
    if kind_of(path) == ".bvh":
        content = read_bvh_content(path)
        eye = torch.eye(3, dtype=torch.float64)
        return _rig(path, content, bvh_take(content), None, (eye.repeat(len(content.names), 1, 1), content.t_rest))
    glb = read_glb_rig(path)
    t = glb.t_bind
    take = Take(glb.names, glb.parents, t, glb.R_bind[None], t[None], torch.zeros(1), len(t), format="glb")
    return _rig(path, glb, take, glb.lowest, (glb.R_parent_bone, torch.zeros_like(t)))


def _rig(
    path: Path,
    file: BvhContent | GlbRig,
    take: Take,
    lowest: float | None,
    still: tuple[Float[Tensor, "joint 3 3"], Float[Tensor, "joint 3"]],
) -> Rig:
    """The rig of a file's joints; `lowest` is the height of its mesh, `still` what its joints keep that are not driven."""
    apart = "its head, arms and legs hang on different trees of bones"
    with placed(path), understood(apart, path, "one skeleton", errors=StopIteration):
        take, found = with_toes(take, find_body(take, Mapping(), path)[0])
        driven, _ = kept_joints(take.parents, found)
        ends = [found.head, *(triple[2] for triple in found.limb.values())]
        carrier = common_ancestor(take.parents, driven[0], *ends)
    t, R_bind = take.rest, torch.eye(3, dtype=take.rest.dtype).repeat(len(take.rest), 1, 1)
    if isinstance(file, GlbRig):
        R_bind = file.R_bind
    R_ours_bind, odd = standing_rotation(t, found)
    if R_ours_bind is None and isinstance(file, BvhContent):
        frame = int(straightness(take.t, found).argmax())
        R_bind, t = take.R[frame], take.t[frame]
        R_ours_bind, _ = standing_rotation(t, found)
        at = frame + len(file.R_parent_joint) - len(take.R)  # a first frame may have been left out
        still = file.R_parent_joint[at], file.t_parent_joint[at]
    if R_ours_bind is None:
        raise WearcapError(f"nobody stands in it: {odd}", path, "a bind pose with stretched limbs, T or A")
    places = t @ R_ours_bind.T
    eye = torch.eye(3, dtype=places.dtype)
    tree = foreign_tree(path.name, take.parents, eye.repeat(1, len(places), 1, 1), places[None], found, eye)
    ankles = [found.limb[f"{side}_leg"][2] for side in SIDES]
    hips = [found.limb[f"{side}_leg"][0] for side in SIDES]
    height = (places[hips, 2] - places[ankles, 2]).mean().item()
    feet = [joint for joint in range(len(places)) if set(ankles) & set(ancestors(take.parents, joint))]
    bottom = places[feet, 2].min().item()
    if lowest is not None and R_ours_bind[2, 1] > 0.99 and 0 < bottom - lowest < _THICKEST * height:
        bottom = lowest
    over = places[ankles, 2].mean().item() - bottom
    return Rig(
        path,
        file,
        take.parents[: take.joints],
        R_bind[: take.joints],
        *still,
        R_ours_bind,
        _axes(R_ours_bind),
        tree.skeleton,
        tuple(driven),
        carrier,
        places[carrier] - places[driven[0]],
        over if over > _FLAT * height else 0.0,
    )


def _axes(R: Float[Tensor, "3 3"]) -> Float[Tensor, "3 3"]:
    """The rotation along the file's axes that is nearest to one, by its up and its forward axis."""
    up = torch.zeros_like(R[2])
    up[R[2].abs().argmax()] = R[2][R[2].abs().argmax()].sign()
    level = R[0] * (1 - up.abs())
    ahead = torch.zeros_like(up)
    ahead[level.abs().argmax()] = level[level.abs().argmax()].sign()
    return torch.stack([ahead, torch.linalg.cross(up, ahead), up])


def write_on_rig(motion: Motion, rig: Rig, path: str | Path, keep_hands: bool = False) -> None:
    """Write a motion on a character, as a file of the character's kind.

    `keep_hands` puts the wrists where the motion's are in its scaled world, else arms point as the motion's do.
    Raises WearcapError for another ending, a motion that is empty or not finite, and when the file cannot be written.
    """
    if Path(path).suffix.lower() != rig.suffix:
        raise WearcapError("another kind of file than the character's", path, f"a name that ends with {rig.suffix}")
    frames, fps = even_frames(motion)
    pose = (motion.R_parent_joint, motion.t_world_root)
    R, t = onto_character(motion.skeleton, pose, _stands(motion), fps, rig.body, rig.ankle_height, keep_hands)
    t = (t + R[:, 0] @ rig.t_root_carrier) @ rig.R_world_file
    turn = rig.R_world_file.T @ R @ rig.R_ours_bind
    world: list[Tensor] = []
    local: dict[int, Tensor] = {}
    at = {joint: k for k, joint in enumerate(rig.driven) if joint < len(rig.parents)} | {rig.carrier: 0}
    if rig.driven[0] != rig.carrier:
        del at[rig.driven[0]]
    for joint, parent in enumerate(rig.parents):
        above = world[parent] if parent >= 0 else torch.eye(3, dtype=turn.dtype)
        world.append(turn[:, at[joint]] @ rig.R_bind[joint] if joint in at else above @ rig.R_parent_joint[joint])
        if joint in at:
            local[joint] = above.mT @ world[joint]
    if isinstance(rig.file, GlbRig):
        T = torch.linalg.inv(rig.file.T_world_parent[rig.carrier])
        write_glb_rig(rig.file, path, motion.timestamps, local, {rig.carrier: t @ T[:3, :3].T + T[:3, 3]})
        return
    mover, moved = _moved(rig, rig.file, t)
    R_all = torch.stack(
        [local.get(joint, kept.expand(len(t), 3, 3)) for joint, kept in enumerate(rig.R_parent_joint)], 1
    )
    t_all = rig.t_parent_joint.repeat(len(t), 1, 1)
    t_all[:, mover] = moved
    write_bvh_like(rig.file, path, R_all[frames], t_all[frames], fps)


def _moved(rig: Rig, file: BvhContent, t: Float[Tensor, "time 3"]) -> tuple[int, Float[Tensor, "time 3"]]:
    """The joint whose position channels move the carrier, itself or one above it, and its places in its parent's frame.

    Raises WearcapError where none has position channels.
    """
    chain = ancestors(rig.parents, rig.carrier)
    can_move = [joint for joint in chain if sum(kind == "p" for kind, _ in file.channels[joint]) == 3]
    if not can_move:
        raise WearcapError("its hips cannot move", rig.path, "position channels of the hips or of the root")
    mover = can_move[0]
    eye, zero = torch.eye(3, dtype=t.dtype), torch.zeros(3, dtype=t.dtype)
    T_world = Rigid(eye, zero)
    T_world_parent = T_world
    # What is above the carrier stands still, but for the one that moves it: its place is left out of this chain.
    for joint in chain[::-1]:
        if joint == mover:
            T_world_parent, T_world = T_world, Rigid(T_world.R, zero)
            here = zero
        else:
            here = rig.t_parent_joint[joint]
        T_world = T_world @ Rigid(rig.R_parent_joint[joint], here)
    return mover, (t - T_world.t - T_world_parent.t) @ T_world_parent.R


def _stands(motion: Motion) -> Bool[Tensor, "time foot"]:
    """Whether each foot stands, on its heel or its toes."""
    if motion.contact_prob is not None:
        patches = motion.contact_prob > _STANDS
    elif len(motion) < 3:
        patches = torch.ones(len(motion), len(FOOT_PATCHES), dtype=torch.bool)
    else:
        patches = contacts_from_motion(motion)
    return patches.unflatten(1, (len(SIDES), -1)).any(-1)
