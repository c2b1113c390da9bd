"""Which joint of a foreign skeleton is which: by normalised names, else by the tree and the lengths of its bones.

Names come in many conventions (`CONVENTIONS`), the human body in one topology: two equal chains at the hips, two at the
chest, and a neck. A limb whose three joints are named as in `LEGS` or `ARMS`, one below the other, is taken by name.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.skeleton import SIDES, ancestors
from wearcap.errors import WearcapError

LEGS = """hip knee ankle, femur tibia foot, upleg leg foot, thigh shin foot, thigh calf foot, upperleg lowerleg foot,
    hip knee foot, upleg lowleg foot, thighbend shin foot, legupper leglower foot, upperleg leg foot, hip leg foot,
    thigh leg foot, thigh knee ankle, thigh knee foot, upleg knee ankle, thigh shank foot, upperleg lowerleg ankle"""
ARMS = """humerus radius hand, shoulder elbow wrist, arm forearm fingerbase, arm forearm hand, upperarm forearm hand,
    upperarm lowerarm hand, shldr forearm hand, uparm loarm hand, shoulder elbow hand, shldrbend forearmbend hand,
    armupper armlower hand, uparm lowarm hand, upperarm forearm wrist, arm elbow hand, upperarm elbow wrist,
    uparm forearm hand, upperarm lowerarm wrist, upperarm elbow hand"""
"""Names of (hip, knee, ankle) and (shoulder, elbow, wrist) in use: xsens and SMPL, CMU, Mixamo, Poser, Unreal …

CMU's `lwrist` is the middle of the forearm (its only freedom is the forearm's twist); `lhand` is the wrist.
"""
_TOES = ("toe", "toes", "toebase", "ball", "metatarsals", "tarsals", "toe0")
CONVENTIONS = {
    "Mixamo": ("mixamorig",),
    "HumanIK (Maya, MotionBuilder)": (r"character\d{0,4}_",),
    "CMU, ASF names": (r"\blfemur\b", r"\blowerback\b"),
    "CMU, cgspeed's conversion": (r"\blhipjoint\b",),
    "CMU, Hahne's conversion (DAZ, Poser)": (r"\blbuttock\b",),
    "VRM": ("j_bip_",),
    "3ds Max Biped": (r"\bbip\d",),
    "Reallusion": ("cc_base_",),
    "DAZ, Poser": (r"\blshldr|\blthighbend\b",),
    "Xsens MVN": (r"\bleftcollar\b", r"\bleftwrist\b", r"\bchest4\b"),
    "3ds Max's BVH (hip, knee, ankle)": (r"\bleftcollar\b", r"\blefthip\b"),
    "Unity Humanoid": (r"\bleftupperleg\b", r"\bleftlowerleg\b"),
    "Blender, Rigify": (r"\b(thigh|upper_arm)\.l\b",),
    "Unreal": (r"\bthigh_l\b", r"\bcalf_l\b"),
    "Rokoko": (r"\bleftthigh\b", r"\bleftshin\b"),
    "LaFAN1": (r"\bleftupleg\b", r"\blefttoe\b"),
    "MotionBuilder": (r"\bleftupleg\b", r"\bleftforearm\b"),
    "xsens23, SMPL": (r"\bleft_hip\b", r"\bleft_knee\b"),
}
"""What the joined names (lower case, by spaces) of each convention hold, the most particular first; for the report."""


def convention(names: Sequence[str]) -> str:
    """Name of the convention that joint names follow."""
    joined = " ".join(names).lower()
    found = (name for name, signs in CONVENTIONS.items() if all(re.search(sign, joined) for sign in signs))
    return next(found, "of its own")


def plain_name(name: str) -> str:
    """A name without rig prefixes, separators, numbers and case, its side first: "mixamorig:LeftUpLeg" → "leftupleg"."""
    name = re.split(r"[:|]", name)[-1][:100]  # no joint has a longer name, and the patterns take quadratic time
    name = re.sub(
        r"^(bip\d*|biped|valvebiped|cc_base|character\d*|def|org|mixamorig\d*|j_bip|j_sec|b|bn|bone|jnt|rig|skel)[ _.-]+",
        "",
        name,
        flags=re.IGNORECASE,
    )
    name = re.sub(r"^(mixamorig\d*)|^c_(?=.{3})|\.\d+$", "", name, flags=re.IGNORECASE)
    side = re.fullmatch(r"(.+?)[ _.-]([lr])", name, flags=re.IGNORECASE)
    if side:
        name = side.group(2) + side.group(1)
    plain = re.sub(r"[ _.-]|\d+$", "", name).lower()
    return re.sub(r"^(.*?)(left|right)$", r"\2\1", plain)


@dataclass(frozen=True)
class BodyJoints:
    """Joint indices of a body: its head, and (hip, knee, ankle) and (shoulder, elbow, wrist) by "left_leg" …"""

    head: int
    limb: dict[str, tuple[int, int, int]]
    toe: dict[str, int]
    """By side; only those that are named."""


def joints_by_name(names: Sequence[str], parents: Sequence[int], skeleton: str = "of the file") -> BodyJoints:
    """Find the body by names. Raises WearcapError naming the part that is not recognised."""
    by_name: dict[str, int] = {}
    for joint, name in enumerate(names):
        by_name.setdefault(plain_name(name), joint)
    if "head" not in by_name:
        fix = f"It has {', '.join(names)}; rename one."
        raise WearcapError(f"skeleton {skeleton!r} has no joint named head", fix=fix)
    limb, toe = {}, {}
    for side in SIDES:
        for part, table in (("leg", LEGS), ("arm", ARMS)):
            limb[f"{side}_{part}"] = _limb(by_name, side, part, table, names, parents, skeleton)
        for name in (prefix + toe_name for prefix in (side, side[0]) for toe_name in _TOES):
            if limb[f"{side}_leg"][2] in ancestors(parents, by_name.get(name, -1)):
                toe.setdefault(side, by_name[name])
    return BodyJoints(by_name["head"], limb, toe)


def _limb(
    by_name: dict[str, int],
    side: str,
    part: str,
    table: str,
    names: Sequence[str],
    parents: Sequence[int],
    skeleton: str,
) -> tuple[int, int, int]:
    alternatives = [row.split() for row in table.split(",")]
    for row in alternatives:
        for prefix in (side, side[0]):
            first, second, third = (by_name.get(prefix + name, -1) for name in row)
            if min(first, second, third) < 0:
                continue
            if first in ancestors(parents, second)[1:] and second in ancestors(parents, third)[1:]:
                return first, second, third
    what = f"the {side} {part} of skeleton {skeleton!r} is not recognised"
    expected = "joints named like " + " or ".join("/".join(row) for row in alternatives[:3])
    raise WearcapError(what, expected=expected, fix=f"It has {', '.join(names)}; rename them.")


def common_ancestor(parents: Sequence[int], *joints: int) -> int:
    """The deepest joint that has all of `joints` at or below it."""
    chains = [ancestors(parents, joint) for joint in joints]
    return next(joint for joint in chains[0] if all(joint in chain for chain in chains))


def joints_by_topology(
    parents: Sequence[int], lengths: Float[Tensor, "joint"], positions: Float[Tensor, "time joint 3"]
) -> BodyJoints:
    """Find the body by its tree, bone lengths and the places of its joints (any unit).

    The two longest pairs of equal chains that part at one joint are limbs; those nearer to the root are the legs, and
    thigh and shin, upper arm and forearm are the longest two bones in a row. The toes point forward, which tells
    left from right. Raises WearcapError when there are no such pairs.
    """
    pairs = _equal_chains(parents, lengths)
    fix = "Name the joints in mapping=FILE.yaml."
    if len(pairs) < 2:
        raise WearcapError("no two pairs of limbs in the tree of joints", expected="two legs and two arms", fix=fix)
    (low, legs), (high, arms) = sorted(pairs[:2], key=lambda pair: len(ancestors(parents, pair[0])))
    if low == high or low not in ancestors(parents, high):
        raise WearcapError("arms and legs part at one joint", expected="a spine between them", fix=fix)
    limbs = {name: [_two_bones(chain, lengths) for chain in pair] for name, pair in (("leg", legs), ("arm", arms))}
    taken = {joint for chain in (*arms, *legs) for joint in chain}
    necks = [
        chain
        for chain in _chains_below(parents, lengths, high)
        if chain[0] not in taken and not set(chain) & set(ancestors(parents, low))
    ]
    if not necks:
        raise WearcapError("no head in the tree of joints", expected="a chain between the arms", fix=fix)
    neck = max(necks, key=lambda chain: lengths[chain].sum().item())
    head = neck[1] if len(neck) > 1 else neck[0]
    up = positions[:, high] - positions[:, [triple[0] for triple in limbs["leg"]]].mean(1)
    across = positions[:, limbs["leg"][0][0]] - positions[:, limbs["leg"][1][0]]
    forward = torch.linalg.cross(across, up)
    left_first = 0.0
    for chain, (hip, knee, ankle) in zip(legs, limbs["leg"]):
        end = positions[:, chain[-1]] - positions[:, ankle]
        bend = positions[:, knee] - (positions[:, hip] + positions[:, ankle]) / 2
        left_first += (forward * (end if chain[-1] != ankle else bend)).sum(-1).mean().item()
    order = SIDES if left_first > 0 else SIDES[::-1]
    limb = dict(zip((f"{side}_leg" for side in order), limbs["leg"]))
    beside = positions[:, limbs["arm"][0][0]] - positions[:, limbs["arm"][1][0]]
    arm_order = order if (across * beside).sum() > 0 else order[::-1]
    return BodyJoints(head, limb | dict(zip((f"{side}_arm" for side in arm_order), limbs["arm"])), {})


def _chains_below(parents: Sequence[int], lengths: Float[Tensor, "joint"], top: int) -> list[list[int]]:
    """Of each child of a joint: its longest chain, from the child to a leaf."""
    children: dict[int, list[int]] = {}
    for joint, parent in enumerate(parents):
        children.setdefault(parent, []).append(joint)
    longest: dict[int, list[int]] = {}
    for joint in range(len(parents) - 1, top, -1):
        below = [longest[child] for child in children.get(joint, [])]
        longest[joint] = [joint, *max(below, key=lambda chain: lengths[chain].sum().item(), default=[])]
    return [longest[child] for child in children.get(top, [])]


def _equal_chains(
    parents: Sequence[int], lengths: Float[Tensor, "joint"]
) -> list[tuple[int, tuple[list[int], list[int]]]]:
    """(joint, two chains of equal length that part there), the longest first; each joint in one pair."""
    found: list[tuple[float, int, tuple[list[int], list[int]]]] = []
    for top in range(len(parents)):
        chains = [chain for chain in _chains_below(parents, lengths, top) if len(chain) >= 3]
        for k, one in enumerate(chains):
            for other in chains[k + 1 :]:
                a, b = lengths[one].sum().item(), lengths[other].sum().item()
                if abs(a - b) < 0.08 * max(a, b) and abs(len(one) - len(other)) <= 1:
                    found.append((a + b, top, (one, other)))
    pairs, used = [], set[int]()
    for _, top, (one, other) in sorted(found, key=lambda row: -row[0]):
        if not used & {*one, *other}:
            used |= {*one, *other}
            pairs.append((top, (one, other)))
    return pairs


def _two_bones(chain: list[int], lengths: Float[Tensor, "joint"]) -> tuple[int, int, int]:
    """The joints of a chain's longest two bones in a row."""
    first = max(range(len(chain) - 2), key=lambda k: (lengths[chain[k + 1]] + lengths[chain[k + 2]]).item())
    return chain[first], chain[first + 1], chain[first + 2]
