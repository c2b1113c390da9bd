"""Motion onto a character of other proportions: bones point as the motion's do, and feet stand where its feet stand.

The whole motion is scaled by the length of the legs. Turns of the joints are taken over as they are, so that bones keep their
directions; the root then follows the standing feet, and legs reach what little is left by inverse kinematics.
"""

from dataclasses import dataclass

import numpy as np
import scipy.ndimage
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.body.kinematics import forward_kinematics, local_rotations
from wearcap.body.landmarks import TPose, t_pose
from wearcap.body.retarget import carried_turns, reach
from wearcap.body.skeleton import SIDES, Skeleton
from wearcap.errors import WearcapError
from wearcap.geometry.rotation import about_axis

_BLEND_S = 0.07
"""Width (s) of the change of support from one foot to the other."""
_AIRBORNE = 1e-3
"""Weight of a foot in the air, which counts where neither stands."""
_SLACK_M = 0.005
"""Height from its place up to which a foot is left: to shorten a nearly straight leg bends its knee by degrees."""
_ROUGH_M = 0.04
"""Range of heights that count as one level."""
_GAP_S = 0.15
"""Shorter gaps in a foot's standing do not end it."""


@dataclass(frozen=True)
class Sole:
    """Points of a foot in the T-pose, relative to its ankle: heel, ball and tip of the toes, and the joint of the toes."""

    points: Float[Tensor, "point 3"]
    toe: Float[Tensor, "3"] | None
    """None for a foot of one piece."""

    def lowest(self, foot: Float[Tensor, "time 3 3"], toe: Float[Tensor, "time 3 3"]) -> Float[Tensor, "time"]:
        """Height of the lowest point over the ankle, by the turns of foot and toes."""
        heel, ball, tip = self.points
        last = foot @ tip if self.toe is None else foot @ self.toe + toe @ (tip - self.toe)
        return torch.stack([foot @ heel, foot @ ball, last], -2)[..., 2].amin(-1)


def onto_character(
    source: Skeleton,
    pose: tuple[Float[Tensor, "time joint 3 3"], Float[Tensor, "time 3"]],
    stands: Bool[Tensor, "time foot"],
    fps: float,
    target: Skeleton,
    ankle_height: float,
    keep_hands: bool = False,
) -> tuple[Float[Tensor, "time joint_t 3 3"], Float[Tensor, "time 3"]]:
    """World rotations of the target's joints, and places of its root, in the target's unit with the motion's floor at 0.

    `pose` is the source's R_parent_joint and t_world_root (m), `stands` tells where each foot does. The target's rest pose is
    its bind pose (x forward, z up), in which ankles are `ankle_height` over the soles; 0: as much as the source's, scaled.
    `keep_hands`: wrists lie as the source's do in the scaled world, else arms keep their directions.
    Raises WearcapError for skeletons without limbs, and a source without heels and toe tips.
    """
    pose_s, pose_t = t_pose(source), t_pose(target)
    T = forward_kinematics(source, pose[0].double(), pose[1].double())
    turn = T.R @ pose_s.R.mT
    soles_s = {side: _sole(source, pose_s, side) for side in SIDES}
    under = -torch.stack([sole.points[0, 2] for sole in soles_s.values()]).mean()
    legs_s, legs_t = _legs(pose_s), _legs(pose_t)
    ankle_height = ankle_height or (under * legs_t / legs_s).item()
    scale = (legs_t + ankle_height) / (legs_s + under)
    turns = carried_turns(turn, pose_s, pose_t, target.parents)
    R = turns @ pose_t.R
    soles, ankle_over_sole = [], []
    for side in SIDES:
        sole, foot, toe = soles_s[side], pose_s.marks.limb[f"{side}_leg"][2], pose_s.marks.toe[side]
        turn_foot, turn_toe = turn[:, foot], turn[:, foot if toe is None else toe]
        soles.append(T.t[:, foot, 2] + sole.lowest(turn_foot, turn_toe))
        own = _with_straight_foot(R, turns, pose_t, side, sole, ankle_height)
        ankle_over_sole.append(-own.lowest(turn_foot, turn_toe))
    heights = torch.stack(soles, -1)
    floor = _level(heights.amin(-1))
    t = scale * (T.t - torch.stack([torch.zeros_like(floor), torch.zeros_like(floor), floor]))
    ankles = t[:, [pose_s.marks.limb[f"{side}_leg"][2] for side in SIDES]].clone()
    ankles[..., 2] = scale * (heights - floor) + torch.stack(ankle_over_sole, -1)
    hips = t[:, [pose_s.marks.limb[f"{side}_leg"][0] for side in SIDES]].mean(1)
    t_root = hips - R[:, 0] @ pose_t.hip_centre.double()
    legs = [pose_t.marks.limb[f"{side}_leg"][2] for side in SIDES]
    T_target = forward_kinematics(target, local_rotations(target, R), t_root)
    moved, feet = _on_feet(T_target.t[:, legs], ankles, scale * (heights - floor), stands, fps, scale.item())
    ends = {f"{side}_leg": feet[:, k] for k, side in enumerate(SIDES)}
    if keep_hands:
        ends |= {f"{side}_arm": t[:, pose_s.marks.limb[f"{side}_arm"][2]] + moved for side in SIDES}
    _reach(target, R, t_root + moved, pose_t, ends)
    return R, t_root + moved


def _on_feet(
    ankles: Float[Tensor, "time foot 3"],
    scaled: Float[Tensor, "time foot 3"],
    soles: Float[Tensor, "time foot"],
    stands: Bool[Tensor, "time foot"],
    fps: float,
    scale: float,
) -> tuple[Float[Tensor, "time 3"], Float[Tensor, "time foot 3"]]:
    """How the root moves so that standing feet stand, and where ankles then belong.

    `ankles` are the character's as its bones point, `scaled` those of the scaled motion, with the heights that put the
    character's soles at the motion's scaled heights `soles`.
    """
    shift = ankles - scaled
    held = [_held(shift[:, k, :2], stands[:, k], fps) for k in range(shift.shape[1])]
    missing = torch.cat([torch.stack(held, 1) - shift[..., :2], -shift[..., 2:]], -1)
    smooth = scipy.ndimage.gaussian_filter1d(stands.double().numpy(), _BLEND_S * fps, axis=0)
    share = torch.from_numpy(smooth)[..., None]
    moved = ((share + _AIRBORNE) * missing).sum(1) / (share + _AIRBORNE).sum(1)
    left = missing - moved[:, None]
    # A foot in the air need only stay above the floor, as far as the motion's does.
    lift = (left[..., 2:] - soles[..., None].clamp_min(0)).clamp_min(0)
    rise = torch.lerp(lift, left[..., 2:], share)
    left = torch.cat([share * left[..., :2], rise - rise.clamp(-_SLACK_M * scale, _SLACK_M * scale)], -1)
    return moved, ankles + moved[:, None] + left


def _level(heights: Float[Tensor, "time"]) -> Float[Tensor, ""]:
    """The height (m) at which the lower sole is most of the time, the lowest of several alike: the floor."""
    order = heights.sort().values
    many = torch.searchsorted(order, order + _ROUGH_M) - torch.arange(len(order))
    first = int((many > 0.8 * many.max()).nonzero()[0])
    return order[first : first + int(many[first])].median()


def _legs(pose: TPose) -> Float[Tensor, ""]:
    """Mean length of thigh and shin together."""
    joints = torch.tensor([pose.marks.limb[f"{side}_leg"] for side in SIDES])
    return pose.t[joints].diff(dim=1).norm(dim=-1).sum(1).mean()


def _sole(skeleton: Skeleton, pose: TPose, side: str) -> Sole:
    """The sole of a skeleton that has sites there."""
    names = (f"{side}_heel", f"{side}_toe_tip")
    if missing := [name for name in names if name not in skeleton.sites]:
        raise WearcapError(f"skeleton {skeleton.name!r} has no {missing[0]!r}", expected="heels and toe tips")
    ankle, toe = pose.t[pose.marks.limb[f"{side}_leg"][2]], pose.marks.toe[side]
    heel, tip = (pose.site(skeleton, name) - ankle for name in names)
    joint = tip if toe is None else pose.t[toe] - ankle
    ball = torch.stack([joint[0], joint[1], heel[2]])
    return Sole(torch.stack([heel, ball, tip]), None if toe is None else joint)


def _with_straight_foot(
    R: Float[Tensor, "time joint 3 3"],
    turns: Float[Tensor, "time joint 3 3"],
    pose: TPose,
    side: str,
    sole: Sole,
    ankle_height: float,
) -> Sole:
    """Turn a character's foot (in place) so that it points as the source's does; its sole, the source's stretched to it."""
    ankle, toe = pose.marks.limb[f"{side}_leg"][2], pose.marks.toe[side]
    if toe is None:
        return Sole(
            sole.points.new_tensor([1, 1, 0]) * sole.points - sole.points.new_tensor([0, 0, ankle_height]), None
        )
    joint, of_source = pose.t[toe] - pose.t[ankle], sole.points[1]
    yaw = torch.atan2(of_source[1], of_source[0]) - torch.atan2(joint[1], joint[0])
    straight = about_axis("z", yaw)
    for each in (ankle, toe):
        R[:, each] = turns[:, each] @ straight @ pose.R[each]
    stretch = joint[:2].norm() / of_source[:2].norm()
    points = stretch * sole.points
    points[:, 2] = -ankle_height
    return Sole(points, straight @ joint)


def _held(shift: Float[Tensor, "time 2"], stands: Bool[Tensor, "time"], fps: float) -> Float[Tensor, "time 2"]:
    """A foot's shift from the scaled motion's, constant while it stands and even between: so it slides no more than that."""
    frames = np.flatnonzero(stands.numpy())
    if not len(frames):
        return shift
    values = shift.numpy()
    spans = np.split(frames, np.flatnonzero(np.diff(frames) > max(1, _GAP_S * fps)) + 1)
    means = np.concatenate([np.tile(values[span].mean(0), (len(span), 1)) for span in spans])
    every = np.arange(len(values))
    return torch.from_numpy(np.stack([np.interp(every, frames, column) for column in means.T], -1))


def _reach(
    target: Skeleton,
    R: Float[Tensor, "time joint 3 3"],
    t_root: Float[Tensor, "time 3"],
    pose: TPose,
    ends: dict[str, Float[Tensor, "time 3"]],
) -> None:
    """Turn limbs (in place), named as in `Landmarks.limb`, so that their ends lie at these places; hands and feet keep their
    own rotations."""
    T = forward_kinematics(target, local_rotations(target, R), t_root)
    for name, goal in ends.items():
        first, second, third = pose.marks.limb[name]
        turns = reach(T.t[:, first], T.t[:, second], T.t[:, third], goal)
        between = [joint for joint in target.ancestors(third)[1:] if first in target.ancestors(joint)]
        for joint in between:  # twist joints go with their bone
            R[:, joint] = turns[second in target.ancestors(joint)] @ R[:, joint]
