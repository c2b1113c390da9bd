"""A foreign skeleton in motion, rewritten: its pelvis as root, its joints by our names, a T-pose as its rest.

`R_ours = R_file · C` with one constant C per joint. Where the file's bind pose is a standing person, C follows from it
alone; else (bones along each joint's own x, zero rest) from the motion: C is the mean rotation from the joint's own
frame to the frame that bones and the axes of bent knees and elbows span, for trunk and head while the body is straight.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.joint_matching import BodyJoints, common_ancestor
from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import SIDES, Skeleton, ancestors
from wearcap.geometry.rotation import geodesic, matrix_from_rot6d, nearest_rotation, swing_between

LIMBS = {"leg": ("hip", "knee", "ankle"), "arm": ("shoulder", "elbow", "wrist")}
_BENT = 0.26
"""Sine of the bend (15°) from which a knee or an elbow shows its axis."""
_STRAIGHT = 0.8
"""Cosine of the largest turn (37°) of a standing bind pose's trunk and shoulders."""
_SNAP_DEG = 20
"""Bind poses that stand this near to the file's axes are taken to stand along them."""


@dataclass(frozen=True)
class ForeignTree:
    """A skeleton whose rest is a T-pose (x forward, z up), with its motion (m)."""

    skeleton: Skeleton
    R_parent_joint: Float[Tensor, "time joint 3 3"]
    t_world_root: Float[Tensor, "time 3"]
    positions: Float[Tensor, "time joint 3"]
    """World places of the joints, which the skeleton's constant bones need not repeat."""

    @property
    def R_world(self) -> Float[Tensor, "time joint 3 3"]:
        """World rotations of the joints."""
        return forward_kinematics(self.skeleton, self.R_parent_joint, self.t_world_root).R

    def place(self, name: str) -> Float[Tensor, "time 3"]:
        """World places of a joint."""
        return self.positions[:, self.skeleton.index(name)]

    def turned(self, joint: int, R_joint: Float[Tensor, "3 3"]) -> "ForeignTree":
        """The tree with other axes of one joint, given in its own; no joint moves."""
        turn, local, offsets = R_joint.double(), self.R_parent_joint.clone(), self.skeleton.t_parent_joint.clone()
        local[:, joint] = local[:, joint] @ turn.to(local)
        below = [child for child, parent in enumerate(self.skeleton.parents) if parent == joint]
        local[:, below] = turn.T.to(local) @ local[:, below]
        offsets[below] = offsets[below] @ turn.to(offsets)
        return replace(self, skeleton=replace(self.skeleton, t_parent_joint=offsets), R_parent_joint=local)

    def moved(self, moves: dict[int, tuple[int, tuple[float, float, float]]]) -> "ForeignTree":
        """The tree with joints at other places: by joint, the joint in whose axes it is shifted, and the shift (m)."""
        R, t = self.R_world, self.positions.clone()
        for joint, (carrier, shift) in moves.items():
            t[:, joint] += R[:, carrier] @ t.new_tensor(shift)
        offsets = _offsets(R, t, self.skeleton.parents)
        return replace(self, skeleton=replace(self.skeleton, t_parent_joint=offsets), positions=t)


def _offsets(
    R: Float[Tensor, "time joint 3 3"], t: Float[Tensor, "time joint 3"], parents: Sequence[int]
) -> Float[Tensor, "joint 3"]:
    """Usual place (m) of each joint in its parent's axes."""
    above = [max(parent, 0) for parent in parents]
    return (R[:, above].mT @ (t - t[:, above])[..., None])[..., 0].median(0).values.float()


def joint_roles(found: BodyJoints) -> dict[str, int]:
    """The found joints by xsens23's names."""
    roles = {"head": found.head} | {f"{side}_toe": joint for side, joint in found.toe.items()}
    for side in SIDES:
        for part, names in LIMBS.items():
            roles |= {f"{side}_{name}": joint for name, joint in zip(names, found.limb[f"{side}_{part}"])}
    return roles


def standing_rotation(
    rest: Float[Tensor, "joint 3"], found: BodyJoints
) -> tuple[Float[Tensor, "3 3"], str] | tuple[None, str]:
    """R_ours_rest of a bind pose that is a standing person's; or None with what is odd about it."""
    legs, arms = ([found.limb[f"{side}_{part}"] for side in SIDES] for part in LIMBS)
    across = rest[legs[0][0]] - rest[legs[1][0]]
    up = rest[found.head] - (rest[legs[0][2]] + rest[legs[1][2]]) / 2
    bones = torch.cat([rest[list(t[1:])] - rest[list(t[:2])] for t in (*legs, *arms)]).norm(dim=-1)
    if min(across.norm(), up.norm(), bones.min()) < 0.02 * max(bones.max(), torch.tensor(1e-9)):
        return None, "its joints lie on one another"
    R = _frame(1, across, 2, up)
    along = torch.where(R.abs() == R.abs().amax(0, keepdim=True), R.sign(), torch.zeros_like(R))
    nearest = nearest_rotation(along)
    if torch.rad2deg(geodesic(R, nearest)) < _SNAP_DEG:
        R = nearest
    p = rest @ R  # the frame's columns are our axes in the file's: this is R^T rest
    for (hip, knee, ankle), (shoulder, elbow, wrist), side in zip(legs, arms, (1.0, -1.0)):
        thigh, shin, upper, fore = (
            torch.nn.functional.normalize(v, dim=0)
            for v in (p[knee] - p[hip], p[ankle] - p[knee], p[elbow] - p[shoulder], p[wrist] - p[elbow])
        )
        if max(thigh[2], shin[2]) > -0.64:
            return None, "its legs do not point down"
        if thigh @ shin < 0.7 or upper @ fore < 0.5:
            return None, "its limbs are bent"
        if side * upper[1] < -0.3 or upper[2] > 0.8:
            return None, "its arms are crossed or raised"
    if p[found.head][2] - p[legs[0][0]][2] < 0.5 * (p[legs[0][0]] - p[legs[0][2]]).norm():
        return None, "its head is not above its hips"
    trunk = p[[arm[0] for arm in arms]].mean(0) - p[[leg[0] for leg in legs]].mean(0)
    shoulders = p[arms[0][0]] - p[arms[1][0]]
    if trunk[2] < _STRAIGHT * trunk.norm() or shoulders[1] < _STRAIGHT * shoulders.norm():
        return None, "its trunk is bent or turned"
    feet = [p[toe] - p[found.limb[f"{side}_leg"][2]] for side, toe in found.toe.items()]
    if any(foot[0] < 0.3 * foot[:2].norm() for foot in feet):
        return None, "its feet do not point ahead"
    return R.T, ""


def _frame(first: int, a: Float[Tensor, "*t 3"], second: int, b: Float[Tensor, "*t 3"]) -> Float[Tensor, "*t 3 3"]:
    """Rotation whose column `first` points along a, and whose column `second` lies towards b."""
    along, across, normal = matrix_from_rot6d(torch.cat([a, b], -1)).unbind(-1)
    sign = 1.0 if (second - first) % 3 == 1 else -1.0
    columns = {first: along, second: across, 3 - first - second: sign * normal}
    return torch.stack([columns[k] for k in range(3)], -1)


def foreign_tree(
    name: str,
    parents: Sequence[int],
    R_world: Float[Tensor, "time joint 3 3"],
    positions: Float[Tensor, "time joint 3"],
    found: BodyJoints,
    R_ours_rest: Float[Tensor, "3 3"] | None,
) -> ForeignTree:
    """The joints that make a body, from world rotations and positions (m) of the file's joints.

    `R_ours_rest` turns the file's bind pose to ours; None: frames are found from the motion.
    """
    roles = joint_roles(found)
    kept, new_parents = kept_joints(parents, found)
    names = {joint: role for role, joint in roles.items()}
    if R_ours_rest is None:
        frames = _frames_in_motion(parents, positions, found, kept, new_parents)
        turns = [nearest_rotation(_mean(R_world[:, joint].mT @ F, w)) for joint, (F, w) in zip(kept, frames)]
        C = torch.stack(turns)
    else:
        C = R_ours_rest.T.expand(len(kept), 3, 3)
    R = R_world[:, kept] @ C
    t = positions[:, kept]
    above = [max(parent, 0) for parent in new_parents]
    labels = tuple(names.get(joint, f"part{joint}") for joint in kept)
    skeleton = Skeleton(name, labels, tuple(new_parents), _offsets(R, t, new_parents))
    local = torch.cat([R[:, :1], R[:, above[1:]].mT @ R[:, 1:]], 1)
    return ForeignTree(skeleton, local, t[:, 0], t)


def _mean(R: Float[Tensor, "time 3 3"], weight: Float[Tensor, "time"]) -> Float[Tensor, "3 3"]:
    return (R * weight[:, None, None]).sum(0) / weight.sum().clamp_min(1e-9)


def kept_joints(parents: Sequence[int], found: BodyJoints) -> tuple[list[int], list[int]]:
    """The body's joints, the pelvis first and parents before children, and each one's parent among them.

    What hangs above the pelvis or beside the body (a root on the ground, fingers, eyes, props) is left out.
    """
    legs, arms = ([found.limb[f"{side}_{part}"] for side in SIDES] for part in LIMBS)
    pelvis = common_ancestor(parents, *(leg[0] for leg in legs))
    body = common_ancestor(parents, pelvis, found.head, *(arm[2] for arm in arms))
    wanted = {joint for triple in (*legs, *arms) for joint in triple} | set(found.toe.values())
    for end, top in ((found.head, body), *((arm[2], body) for arm in arms)):
        wanted |= set(ancestors(parents, end)) - set(ancestors(parents, top))
    wanted -= set(ancestors(parents, pelvis))
    kept, place, above = [pelvis], {pelvis: 0}, [-1]
    for joint in sorted(wanted):  # readers list parents before children
        place[joint] = len(kept)
        kept.append(joint)
        above.append(next((place[a] for a in ancestors(parents, joint)[1:] if a in place), 0))
    return kept, above


def straightness(t: Float[Tensor, "time joint 3"], found: BodyJoints) -> Float[Tensor, "time"]:
    """How nearly each frame is the T-pose but for its arms: 1 for stretched legs along the trunk, and hips, shoulders
    and feet that face one way; 0 for a crouch, a stride or a fighter's stance.
    """
    hips, shoulders = ([found.limb[f"{side}_{part}"][0] for side in SIDES] for part in LIMBS)
    knees, ankles = ([found.limb[f"{side}_leg"][k] for side in SIDES] for k in (1, 2))
    cosine = torch.nn.functional.cosine_similarity
    up = t[:, shoulders].mean(1) - t[:, hips].mean(1)
    across, of_shoulders = (t[:, left] - t[:, right] for left, right in (hips, shoulders))
    down = t[:, ankles].mean(1) - t[:, hips].mean(1)
    legs = ((t[:, knees] - t[:, hips]).norm(dim=-1) + (t[:, ankles] - t[:, knees]).norm(dim=-1)).mean(1)
    straight = (-cosine(up, down, dim=-1)).clamp_min(0) ** 16 * (down.norm(dim=-1) / legs.clamp_min(1e-9)) ** 32
    straight = straight * cosine(across, of_shoulders, dim=-1).clamp_min(0) ** 32
    ahead = torch.linalg.cross(across, up)
    for side, toe in found.toe.items():
        foot = t[:, toe] - t[:, found.limb[f"{side}_leg"][2]]
        foot = foot - (foot * up).sum(-1, keepdim=True) * up / (up * up).sum(-1, keepdim=True).clamp_min(1e-9)
        straight = straight * cosine(ahead, foot, dim=-1).clamp_min(0) ** 16
    return straight


def _frames_in_motion(
    parents: Sequence[int], t: Float[Tensor, "time joint 3"], found: BodyJoints, kept: list[int], above: list[int]
) -> list[tuple[Tensor, Tensor]]:
    """Per kept joint: the frame that the T-pose's would take in each frame of the motion, and how sure it is."""
    hips, shoulders = ([found.limb[f"{side}_{part}"][0] for side in SIDES] for part in LIMBS)
    spine_up = t[:, shoulders].mean(1) - t[:, hips].mean(1)
    sure = straightness(t, found) + 1e-6
    pelvis = _frame(1, t[:, hips[0]] - t[:, hips[1]], 2, spine_up)
    chest = _frame(1, t[:, shoulders[0]] - t[:, shoulders[1]], 2, spine_up)
    trunk = [joint for joint in kept if joint in ancestors(parents, found.head)]
    known: dict[int, tuple[Tensor, Tensor]] = {}
    for k, joint in enumerate(trunk):
        share = min(1.0, 1.5 * k / max(len(trunk) - 1, 1))
        known[joint] = (nearest_rotation((1 - share) * pelvis + share * chest), sure)
    known[kept[0]] = (pelvis, sure)
    known[found.head] = (chest, sure)  # a head turns to both sides, but who stands straight looks ahead
    for side, sign in zip(SIDES, (1.0, -1.0)):
        hip, knee, ankle = found.limb[f"{side}_leg"]
        thigh, shin = t[:, knee] - t[:, hip], t[:, ankle] - t[:, knee]
        known |= _hinged((hip, knee), (thigh, shin), (2, -1.0), (1, 1.0), pelvis)
        toe = found.toe.get(side)
        # The sole is taken to be level in the mean over frames in which the shin is upright.
        forward = known[knee][0][..., 0] if toe is None else t[:, toe] - t[:, ankle]
        vertical = torch.tensor([0.0, 0.0, 1.0], dtype=t.dtype).expand(len(t), 3)
        upright = (-torch.nn.functional.normalize(shin, dim=-1)[:, 2]).clamp_min(0) ** 8 + 1e-6
        known[ankle] = (_frame(2, vertical, 0, forward), upright)
        if toe is not None:
            known[toe] = known[ankle]
        shoulder, elbow, wrist = found.limb[f"{side}_arm"]
        bones = (t[:, elbow] - t[:, shoulder], t[:, wrist] - t[:, elbow])
        known |= _hinged((shoulder, elbow), bones, (1, sign), (2, -sign), chest)
        known[wrist] = known[elbow]
    frames: list[tuple[Tensor, Tensor]] = []
    for k, joint in enumerate(kept):
        beside_trunk = joint not in known and above[k] >= 0 and kept[above[k]] in trunk  # a collar
        frames.append(known.get(joint) or ((chest, sure) if beside_trunk else frames[above[k]]))
    return frames


def _hinged(
    joints: tuple[int, int],
    bones: tuple[Tensor, Tensor],
    along: tuple[int, float],
    hinge: tuple[int, float],
    trunk: Tensor,
) -> dict[int, tuple[Tensor, Tensor]]:
    """Frames of a limb's two bones: `along` (axis, sign) is the bone's axis in the T-pose, `hinge` the bend's.

    A limb that never bends takes the trunk's axes, swung with the bone.
    """
    upper, lower = (torch.nn.functional.normalize(bone, dim=-1) for bone in bones)
    axis = torch.linalg.cross(upper, lower)
    weight = (axis.norm(dim=-1) - _BENT).clamp_min(0)
    frames = {}
    for joint, bone in zip(joints, (upper, lower)):
        if weight.sum() > 0.05 * max(5, len(weight) ** 0.5):
            frames[joint] = (_frame(along[0], along[1] * bone, hinge[0], hinge[1] * axis), weight)
        else:
            swung = swing_between(trunk[..., along[0]], along[1] * bone) @ trunk
            frames[joint] = (swung, torch.ones_like(weight))
    return frames
