"""Where the joints of a convention lie in a person, and a foreign tree's joints moved to where xsens23's lie.

Joints of one name lie centimetres apart: a head's joint from 9 to 19 cm under the crown, an ankle from 6 to 11 cm over
the sole. The crown is the end of the file's head bone where that lies where a crown may be, else it follows from a
table by convention; stature follows from crown and ankles, and the base of the skull, the neck and the ankles from it.
"""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from wearcap.body.foreign_tree import ForeignTree
from wearcap.body.landmarks import t_pose
from wearcap.body.skeleton import SIDES, xsens23


@dataclass(frozen=True)
class Anatomy:
    """Where joints lie, as shares of stature (soles to crown)."""

    head_under_crown: float
    neck_under_head: float
    ankle_over_sole: float


def _of_ours() -> Anatomy:
    skeleton = xsens23()
    head = skeleton.height_of("head")
    shares = (skeleton.stature - head, head - skeleton.height_of("neck"), skeleton.height_of("left_ankle"))
    return Anatomy(*(share / skeleton.stature for share in shares))


OURS = _of_ours()
CONVENTIONS = {"Unity Humanoid": Anatomy(0.093, OURS.neck_under_head, 0.060)}
"""Conventions whose joints lie elsewhere, by `joint_matching.convention`.

Unity: FuBoT's wearer of 1.84 m, whose toes are at the floor while the ankles are 0.11 m over it.
"""
_END_M, _END_SLOPE = (0.07, 0.27), 0.6
"""Height (m) over the head's joint, and horizontal distance as a share of it, of an end that may be the crown.

In CMU, too, the end is the crown: statures from it make repaired legs 0.49 of them on average (13 people, 0.47 to 0.51),
those from its head's joint 0.465.
"""


def crown_over_head(tree: ForeignTree, ends: Float[Tensor, "time end 3"]) -> float | None:
    """Height (m) of the crown over the head's joint, in the axes of a level head, from what the file has above it.

    None where no point above the joint may be a crown: noses, eyes, chains that end in the head.
    """
    if ends.shape[1] == 0:
        return None
    place = ((ends - tree.place("head")[:, None]) @ tree.R_world[:, tree.skeleton.index("head")]).median(0).values
    x, y, z = place[place[:, 2].argmax()].tolist()
    if not (_END_M[0] <= z <= _END_M[1] and (x * x + y * y) ** 0.5 <= _END_SLOPE * z):
        return None
    return z


def at_landmarks(tree: ForeignTree, crown_m: float | None, convention: str) -> ForeignTree:
    """The tree with head, neck and ankles where xsens23's lie in a person of its stature; its head must be level.

    `crown_m` is the height of the crown over the head's joint where the file shows it.
    """
    theirs = CONVENTIONS.get(convention, OURS)
    pose = t_pose(tree.skeleton)
    marks, z = pose.marks, pose.t[:, 2]
    ankles = [marks.limb[f"{side}_leg"][2] for side in SIDES]
    reach = (z[marks.head] - z[ankles].mean()).item()
    if crown_m is None:
        stature = reach / (1 - theirs.head_under_crown - theirs.ankle_over_sole)
        crown_m = theirs.head_under_crown * stature
    else:
        stature = (reach + crown_m) / (1 - theirs.ankle_over_sole)
    down = OURS.head_under_crown * stature - crown_m
    moves = {marks.head: (marks.head, (0.0, 0.0, -down))}
    lower = (OURS.ankle_over_sole - theirs.ankle_over_sole) * stature
    for side in SIDES:
        _, knee, ankle = marks.limb[f"{side}_leg"]
        moves[ankle] = (knee, (0.0, 0.0, lower))
    if marks.neck:
        neck, top = pose.t[marks.neck[0]], pose.t[marks.spine[-1]]
        height = z[marks.head].item() - down - OURS.neck_under_head * stature - neck[2].item()
        towards = (pose.t[marks.head] if height > 0 else top) - neck
        lean = height / towards[2].item() if abs(towards[2]) > 0.02 else 0.0
        moves[marks.neck[0]] = (marks.spine[-1], (lean * towards[0].item(), 0.0, height))
    return tree.moved(moves)
