"""Retargeting: motion from one skeleton to another, and skeletons fitted to another's bone lengths; two-bone inverse kinematics.

A joint's *turn* is its world-axes rotation from the T-pose to the current pose. Turns are comparable between skeletons,
whatever their bind poses, and are what retargeting transfers.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.kinematics import forward_kinematics, local_rotations
from wearcap.body.landmarks import TPose, t_pose
from wearcap.body.skeleton import SIDES, Site, Skeleton
from wearcap.body.skeletons import FINGER_JOINTS
from wearcap.geometry.light_roma import roma
from wearcap.geometry.rotation import swing_between


def _arc_lengths(points: Float[Tensor, "point 3"]) -> Float[Tensor, "point"]:
    steps = (points[1:] - points[:-1]).norm(dim=-1)
    return torch.cat([steps.new_zeros(1), steps.cumsum(0)])


def carried_turns(
    turn: Float[Tensor, "*batch joint 3 3"], source: TPose, target: TPose, parents: tuple[int, ...]
) -> Float[Tensor, "*batch joint_t 3 3"]:
    """Turns of the target's joints, transferred from the source; joints without a counterpart follow their parent."""
    from_s, to = source.marks, target.marks
    given: dict[int, Tensor] = {to.root: turn[..., from_s.root, :, :], to.head: turn[..., from_s.head, :, :]}

    def chain(joints_s: tuple[int, ...], end_s: int, joints_t: tuple[int, ...], end_t: int) -> None:
        """Give each target segment the mean turn of the source's, weighted by how much of its length they overlap."""
        if not joints_s or not joints_t:
            return
        knots_s, knots_t = (
            knots / knots[-1].clamp_min(1e-9)
            for knots in (_arc_lengths(source.t[[*joints_s, end_s]]), _arc_lengths(target.t[[*joints_t, end_t]]))
        )
        low = torch.maximum(knots_t[:-1, None], knots_s[None, :-1])
        high = torch.minimum(knots_t[1:, None], knots_s[None, 1:])
        share = (high - low).clamp_min(0) + 1e-9
        share = share / share.sum(1, keepdim=True)
        quat = roma.rotmat_to_unitquat(turn[..., list(joints_s), :, :])
        quat = torch.where((quat * quat[..., :1, :]).sum(-1, keepdim=True) < 0, -quat, quat)
        mean = torch.einsum("ts,...sq->...tq", share.to(quat), quat)
        turns = roma.unitquat_to_rotmat(torch.nn.functional.normalize(mean, dim=-1))
        given.update(zip(joints_t, turns.unbind(-3)))

    top_s, top_t = from_s.spine[-1], to.spine[-1]
    chain(from_s.spine[:-1] or (top_s,), top_s if len(from_s.spine) > 1 else from_s.head, to.spine[:-1], top_t)
    given[top_t] = turn[..., top_s, :, :]
    chain(from_s.neck or (top_s,), from_s.head, to.neck, to.head)
    for side in SIDES:
        for part in ("leg", "arm"):
            joints = zip(to.limb[f"{side}_{part}"], from_s.limb[f"{side}_{part}"])
            given |= {t: turn[..., s, :, :] for t, s in joints}
        given[to.limb[f"{side}_arm"][1]] = turn[..., from_s.forearm[side], :, :]
        for pair_s, pair_t in ((from_s.collar, to.collar), (from_s.toe, to.toe)):
            if pair_s[side] is not None and pair_t[side] is not None:
                given[pair_t[side]] = turn[..., pair_s[side], :, :]
    turns: list[Tensor] = []
    for joint, parent in enumerate(parents):
        turns.append(given[joint] if joint in given else turns[parent])
    return torch.stack(turns, -3)


def retarget(
    source: Skeleton,
    target: Skeleton,
    R_parent_joint: Float[Tensor, "*batch joint 3 3"],
    t_world_root: Float[Tensor, "*batch 3"],
) -> tuple[Float[Tensor, "*batch joint_t 3 3"], Float[Tensor, "*batch 3"]]:
    """Rotations and root translation (m) of `target` that repeat the motion of `source`.

    The hips' centre is kept, bones point where the source's point, spine and neck share their bend by arc
    length, and inverse kinematics of arms and legs then puts wrists and ankles on the source's (or as near as the
    target's bones reach). Nothing is scaled: for a wearer of another size use `fit_offsets` first.
    Raises WearcapError for a skeleton whose limbs are not recognised.
    """
    pose_s, pose_t = t_pose(source), t_pose(target)
    T_world_source = forward_kinematics(source, R_parent_joint, t_world_root)
    turn = T_world_source.R @ pose_s.R.to(T_world_source.R).transpose(-1, -2)
    turns = carried_turns(turn, pose_s, pose_t, target.parents)
    shared = [name for name in FINGER_JOINTS if name in source and name in target]
    turns[..., target.indices(*shared), :, :] = turn[..., source.indices(*shared), :, :]
    R_world = turns @ pose_t.R.to(turn)
    hips = [pose_s.marks.limb[f"{side}_leg"][0] for side in SIDES]
    centre = T_world_source.t[..., hips, :].mean(-2)
    t_root = centre - (R_world[..., 0, :, :] @ pose_t.hip_centre.to(centre)[:, None])[..., 0]
    T_world = forward_kinematics(target, local_rotations(target, R_world), t_root)
    R = T_world.R.clone()
    for name, (first, second, third) in pose_t.marks.limb.items():
        # In double precision: a nearly straight limb's bend is the root of a difference of squares.
        a, b, c = (T_world.t[..., joint, :].double() for joint in (first, second, third))
        turns = reach(a, b, c, T_world_source.t[..., pose_s.marks.limb[name][2], :].double())
        upper, lower = (turn.to(R) for turn in turns)
        R[..., first, :, :] = upper @ R[..., first, :, :]
        R[..., second, :, :] = lower @ R[..., second, :, :]
        twist = pose_t.marks.forearm[name.split("_")[0]]
        if name.endswith("arm") and twist != second:  # a joint between elbow and wrist turns with the forearm
            R[..., twist, :, :] = lower @ R[..., twist, :, :]
    return local_rotations(target, R), t_root


def reach(
    start: Float[Tensor, "*batch 3"],
    middle: Float[Tensor, "*batch 3"],
    end: Float[Tensor, "*batch 3"],
    goal: Float[Tensor, "*batch 3"],
    bias: Float[Tensor, "*batch 3"] | None = None,
) -> tuple[Float[Tensor, "*batch 3 3"], Float[Tensor, "*batch 3 3"]]:
    """World rotations to left-multiply onto those of the upper and the lower bone so that `end` reaches `goal`.

    Bone lengths and the plane of the bend are kept; a goal out of reach is approached along its direction. `bias` (m)
    is added to the offset of `middle` from the line between the ends, whose direction it decides for a straight limb.
    """
    upper, lower = (middle - start).norm(dim=-1), (end - middle).norm(dim=-1)
    aim = goal - start
    distance = aim.norm(dim=-1)
    near, far = (upper - lower).abs() * 1.001 + 1e-9, upper + lower
    distance = torch.minimum(torch.maximum(distance, near), far)
    aim = torch.nn.functional.normalize(aim, dim=-1)
    # Turn the bend's plane with the limb before bending, so that a straight arm keeps its elbow's direction.
    turn = swing_between(end - start, aim)
    bend = (turn @ (middle - start if bias is None else middle - start + bias)[..., None])[..., 0]
    bend = torch.nn.functional.normalize(bend - (bend * aim).sum(-1, keepdim=True) * aim, dim=-1)
    along = (distance**2 + upper**2 - lower**2) / (2 * distance)
    beside = (upper**2 - along**2).clamp_min(0).sqrt()
    elbow = start + along[..., None] * aim + beside[..., None] * bend
    hand = start + distance[..., None] * aim
    bones, goals = torch.stack([middle - start, end - middle]), torch.stack([elbow - start, hand - elbow])
    upper_turn, lower_turn = swing_between(bones, goals)
    return upper_turn, lower_turn


def fit_offsets(source: Skeleton, target: Skeleton) -> Skeleton:
    """The target's tree with the size of the source's wearer: hips, spine, collars, neck, arms, legs, feet.

    Limb bones keep the target's directions and take the source's lengths; the trunk takes the source's shape.
    Heels and toe tips are copied where the source has them, other sites scaled.
    """
    pose_s, pose_t = t_pose(source), t_pose(target)
    scale = _head_height(pose_s) / _head_height(pose_t)
    places = _places(pose_s, pose_t, float(scale))
    t = pose_t.t.clone()
    for joint, parent in enumerate(target.parents):
        if joint in places:
            t[joint] = places[joint]
        elif parent >= 0:
            t[joint] = t[parent] + scale * (pose_t.t[joint] - pose_t.t[parent])
    offsets = torch.zeros_like(t)
    above = list(target.parents[1:])
    offsets[1:] = (pose_t.R[above].transpose(-1, -2) @ (t[1:] - t[above])[..., None])[..., 0]
    # Crowns and fingertips are never copied: files end those bones anywhere (CMU's head at its markers).
    pose_t = replace(pose_t, t=t)
    at = {name: pose_t.site(target, name, float(scale)) for name in target.sites}
    for side in SIDES:
        heel, tip = f"{side}_heel", f"{side}_toe_tip"
        if not {heel, tip} <= set(at):
            continue
        if {heel, tip} <= set(source.sites):
            ankle_s, ankle_t = (pose.t[pose.marks.limb[f"{side}_leg"][2]] for pose in (pose_s, pose_t))
            at |= {name: pose_s.site(source, name) - ankle_s + ankle_t for name in (heel, tip)}
        # One flat sole: toe joints and the ends of toe bones lie at different heights in every file.
        sole = at[heel][2] if heel not in source.sites else torch.minimum(at[heel][2], at[tip][2])
        at |= {name: torch.cat([at[name][:2], sole[None]]) for name in (heel, tip)}
    sites = {}
    for name, site in target.sites.items():
        joint = target.index(site.joint)
        x, y, z = (pose_t.R[joint].T @ (at[name] - pose_t.t[joint])).tolist()
        sites[name] = Site(site.joint, (x, y, z))
    return replace(target, t_parent_joint=offsets.to(target.t_parent_joint), sites=sites)


def _head_height(pose: TPose) -> Tensor:
    """Height of the head joint above the ankles (m)."""
    ankles = pose.t[[pose.marks.limb[f"{side}_leg"][2] for side in SIDES], 2]
    return pose.t[pose.marks.head, 2] - ankles.mean()


def _places(source: TPose, target: TPose, scale: float) -> dict[int, Tensor]:
    """T-pose positions of the target's landmark joints, its root at the origin."""
    from_s, to = source.marks, target.marks
    shift = target.hip_centre * scale - source.hip_centre
    at_s = source.t + shift
    neck_s = from_s.neck[0] if from_s.neck else from_s.head
    column = at_s[list(from_s.spine)]
    if len(column) == 1:  # one joint for the whole spine: its upper part is rigid, so any point of it will do
        column = torch.stack([column[0], column[0] + 0.6 * (at_s[neck_s] - column[0])])
    places = {to.root: target.t[to.root], to.head: at_s[from_s.head]}

    def chain(points: Tensor, joints: tuple[int, ...], end: int) -> None:
        """Place a chain's joints on a polyline, at the fractions of its length that they have in the target."""
        knots, arc = _arc_lengths(target.t[[*joints, end]]), _arc_lengths(points)
        wanted = (knots[:-1] / knots[-1].clamp_min(1e-9) * arc[-1]).contiguous()
        after = torch.searchsorted(arc, wanted).clamp(1, len(points) - 1)
        steps = (points[1:] - points[:-1]).norm(dim=-1)  # zero where joints coincide
        weight = ((wanted - arc[after - 1]) / steps[after - 1].clamp_min(1e-9))[:, None]
        places.update(zip(joints, (points[after - 1] * (1 - weight) + points[after] * weight).unbind(0)))

    *lower, top = to.spine
    if lower:
        chain(column, tuple(lower), top)
    places[top] = column[-1] if lower else column[0]
    if to.neck:
        chain(at_s[[neck_s, *from_s.neck[1:], from_s.head]], to.neck, to.head)
    for side in SIDES:
        shoulder_s, shoulder_t = from_s.limb[f"{side}_arm"][0], to.limb[f"{side}_arm"][0]
        collar_s, collar_t = from_s.collar[side], to.collar[side]
        if collar_t is not None:
            places[collar_t] = at_s[collar_s if collar_s is not None else neck_s]
        places[shoulder_t] = at_s[shoulder_s]
        places[to.limb[f"{side}_leg"][0]] = at_s[from_s.limb[f"{side}_leg"][0]]
        for part in ("leg", "arm"):
            joints_s, joints_t = from_s.limb[f"{side}_{part}"], to.limb[f"{side}_{part}"]
            for k in (1, 2):
                length = (source.t[joints_s[k]] - source.t[joints_s[k - 1]]).norm()
                bone = target.t[joints_t[k]] - target.t[joints_t[k - 1]]
                places[joints_t[k]] = places[joints_t[k - 1]] + bone / bone.norm() * length
        toe_s, toe_t, ankle_s = from_s.toe[side], to.toe[side], from_s.limb[f"{side}_leg"][2]
        if toe_s is not None and toe_t is not None:
            places[toe_t] = places[to.limb[f"{side}_leg"][2]] + source.t[toe_s] - source.t[ankle_s]
    return places
