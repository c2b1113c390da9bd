"""Landmark joints of any skeleton by body part, for retargeting.

Hips, knees, ankles, shoulders, elbows, wrists and the head are found by name; spine, neck, collars and toes by their
position in the tree, since their number and names differ most.
"""

import re
from dataclasses import dataclass

from wearcap.body.skeleton import Skeleton
from wearcap.errors import WearcapError

_LEGS = (
    ("hip", "knee", "ankle"),
    ("femur", "tibia", "foot"),
    ("upleg", "leg", "foot"),
    ("thigh", "shin", "foot"),
    ("thigh", "calf", "foot"),
    ("upperleg", "lowerleg", "foot"),
    ("hip", "knee", "foot"),
    ("upleg", "lowleg", "foot"),
)
_ARMS = (
    ("humerus", "radius", "hand"),
    ("shoulder", "elbow", "wrist"),
    ("arm", "forearm", "fingerbase"),
    ("arm", "forearm", "hand"),
    ("upperarm", "forearm", "hand"),
    ("upperarm", "lowerarm", "hand"),
    ("shldr", "forearm", "hand"),
    ("uparm", "loarm", "hand"),
    ("shoulder", "elbow", "hand"),
)
"""Names of (hip, knee, ankle) and (shoulder, elbow, wrist) in use: xsens and SMPL, CMU, Mixamo, Poser, Unreal …

CMU's `lwrist` is the middle of the forearm (its only freedom is the forearm's twist); `lhand` is the wrist.
"""


@dataclass(frozen=True)
class Landmarks:
    """Joint indices by part of the body; `limb["left_leg"]` is (hip, knee, ankle), `…_arm` the same."""

    root: int
    spine: tuple[int, ...]
    """Joints from the first one above the root to the parent of neck and arms."""
    neck: tuple[int, ...]
    """Joints between spine and head (empty if the head's parent is in the spine)."""
    head: int
    limb: dict[str, tuple[int, int, int]]
    collar: dict[str, int | None]
    toe: dict[str, int | None]
    forearm: dict[str, int]
    """Joint that rotates the forearm at the wrist, by side (the elbow, or a twist joint below it)."""


def _plain(name: str) -> str:
    """A name without rig prefixes, separators and case: "mixamorig:LeftUpLeg" → "leftupleg"."""
    name = name.rsplit(":", 1)[-1]
    name = re.sub(r"^(bip\d*|biped|valvebiped|cc_base|character\d*|def)[ _.-]", "", name, flags=re.IGNORECASE)
    side = re.fullmatch(r"(.+?)[ _.-]([lr])", name, flags=re.IGNORECASE)
    if side:
        name = side.group(2) + side.group(1)
    plain = re.sub(r"[ _.-]|\d+$", "", name).lower()
    return re.sub(r"^(.*?)(left|right)$", r"\2\1", plain)


def _ancestors(skeleton: Skeleton, joint: int) -> list[int]:
    """The joint and all its ancestors, the root last."""
    chain = [joint]
    while skeleton.parents[chain[-1]] >= 0:
        chain.append(skeleton.parents[chain[-1]])
    return chain


def _limb(by_name: dict[str, int], side: str, alternatives, skeleton: Skeleton) -> tuple[int, int, int]:
    for names in alternatives:
        for prefix in (side, side[0]):
            first, second, third = (by_name.get(prefix + name, -1) for name in names)
            if min(first, second, third) >= 0:
                return first, second, third
    raise WearcapError(
        f"the {side} {'leg' if alternatives is _LEGS else 'arm'} of skeleton {skeleton.name!r} is not recognised",
        expected="joints named like " + " or ".join("/".join(n) for n in alternatives[:3]),
        fix=f"It has {', '.join(skeleton.joint_names)}; rename them.",
    )


def _toe(skeleton: Skeleton, ankle: int) -> int | None:
    children = [joint for joint, parent in enumerate(skeleton.parents) if parent == ankle]
    return min(children, key=lambda j: -skeleton.t_parent_joint[j, 0].item(), default=None)


def landmarks(skeleton: Skeleton) -> Landmarks:
    """Find the parts of the body. Raises WearcapError naming the limb that is not recognised."""
    by_name: dict[str, int] = {}
    for joint, name in enumerate(skeleton.joint_names):
        by_name.setdefault(_plain(name), joint)
    if "head" not in by_name:
        raise WearcapError(
            f"skeleton {skeleton.name!r} has no joint named head",
            fix=f"It has {', '.join(skeleton.joint_names)}; rename one.",
        )
    head = by_name["head"]
    limb, collar, toe, forearm = {}, {}, {}, {}
    for side in ("left", "right"):
        limb[f"{side}_leg"] = _limb(by_name, side, _LEGS, skeleton)
        limb[f"{side}_arm"] = _limb(by_name, side, _ARMS, skeleton)
        toe[side] = _toe(skeleton, limb[f"{side}_leg"][2])
        forearm[side] = skeleton.parents[limb[f"{side}_arm"][2]]
    above_head = _ancestors(skeleton, head)
    top = next(j for j in _ancestors(skeleton, limb["left_arm"][0]) if j in above_head)
    for side in ("left", "right"):
        above = skeleton.parents[limb[f"{side}_arm"][0]]
        collar[side] = above if above not in above_head else None
    spine = _ancestors(skeleton, top)[-2::-1]
    if not spine:
        raise WearcapError(f"skeleton {skeleton.name!r} has no spine", expected="a joint between root and arms")
    neck = above_head[1 : above_head.index(top)][::-1]
    return Landmarks(0, tuple(spine), tuple(neck), head, limb, collar, toe, forearm)
