"""Conventions of a foreign motion file, detected from its content: joints, unit, up axis; and a user's mapping of them."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.foreign_tree import LIMBS
from wearcap.body.joint_matching import BodyJoints, joints_by_name, joints_by_topology
from wearcap.body.skeleton import SIDES, xsens23
from wearcap.boundary.texts import read_yaml_object
from wearcap.errors import WearcapError, nearest
from wearcap.io.formats.bvh import HEIGHT_M, UNITS_M
from wearcap.prepare.foreign_files import BALL_OF_FOOT, Take

USUAL_HEIGHT_M = (1.25, 2.15)
LIKELY_UNITS = ("centimetres", "metres", "inches", "millimetres", "CMU's units", "decimetres", "feet")
_SHORT = {"m": "metres", "dm": "decimetres", "cm": "centimetres", "mm": "millimetres", "inch": "inches",
          "foot": "feet", "cmu": "CMU's units"}  # fmt: skip
AXES = ("x", "y", "z", "-x", "-y", "-z")
ROLES = ("head", *(f"{side}_{name}" for side in SIDES for names in LIMBS.values() for name in names),
         *(f"{side}_toe" for side in SIDES))  # fmt: skip
"""Joints that a mapping may name."""
_GROUND_M = 0.25
"""Height (m) within which a body's lowest joint is at the ground."""
LOST_THORAX_M = 0.1168
"""Length of the bone that cgspeed's BVH conversions of CMU dropped between thorax and neck or shoulders."""


@dataclass(frozen=True)
class Mapping:
    """What a user says of a file's conventions; nothing where they are to be detected."""

    joints: dict[str, str] = field(default_factory=dict)
    """Names in the file by `ROLES`."""
    unit_m: float | None = None
    up: str | None = None
    forward: str | None = None


def read_mapping(path: str | Path) -> Mapping:
    """Read a mapping file. Raises WearcapError for keys and values that it cannot have."""
    content = read_yaml_object(path)
    keys = ("joints", "unit", "up", "forward")
    for key in content:
        if key not in keys:
            raise WearcapError(f"key {str(key)[:40]!r}", path, f"any of {', '.join(keys)}", nearest(str(key), keys))
    joints = content.get("joints") or {}
    if not isinstance(joints, dict) or not all(isinstance(name, str) for name in joints.values()):
        raise WearcapError("joints are no names", path, "joints: {left_knee: NAME_IN_FILE, …}")
    for role in joints:
        if role not in ROLES:
            fix = nearest(str(role)[:60], ROLES)
            raise WearcapError(f"no joint {str(role)[:40]!r}", path, f"any of {', '.join(ROLES)}", fix)
    for key in ("up", "forward"):
        if content.get(key) is not None and content[key] not in AXES:
            raise WearcapError(f"{key}: {str(content[key])[:40]}", path, f'one of "{", ".join(AXES)}"')
    return Mapping(dict(joints), _unit_in_m(content.get("unit"), path), content.get("up"), content.get("forward"))


def _unit_in_m(unit: Any, path: str | Path) -> float | None:
    if unit is None:
        return None
    name = _SHORT.get(str(unit), str(unit))
    number = isinstance(unit, int | float) and not isinstance(unit, bool) and 1e-6 < unit < 1e6
    if name not in UNITS_M and not number:
        raise WearcapError(f"unit: {str(unit)[:40]}", path, f"metres per unit, or one of {', '.join(_SHORT)}")
    return UNITS_M[name] if name in UNITS_M else float(unit)


def find_body(take: Take, mapping: Mapping, path: Path) -> tuple[BodyJoints, str]:
    """The body's joints and how they were found: by "names" or by "topology", with the mapping's in their place."""
    names = take.names[: take.joints]
    found = None
    try:
        found, by = joints_by_name(names, take.parents[: take.joints], path.name), "names"
    except WearcapError as by_names:
        by = "topology"
        try:
            found = joints_by_topology(take.parents, take.lengths, take.t)
        except WearcapError as by_tree:
            if not set(ROLES[:13]) <= mapping.joints.keys():
                what = f"no person among its joints: {by_names.what}; {by_tree.what}"
                expected = f"head, two arms and two legs; it has {', '.join(names)}"[:400]
                fix = "Name them in a file, mapping=FILE.yaml (docs/motion_files.md)."
                raise WearcapError(what, path, expected, fix) from by_names
    if not mapping.joints:
        assert found is not None
        return found, by
    of = {}
    for role, name in mapping.joints.items():
        if name not in names:
            raise WearcapError(f"the mapping's {role}: {name[:60]!r} is no joint of it", path, fix=nearest(name, names))
        of[role] = names.index(name)
    limb = {}
    for side in SIDES:
        for part, roles in LIMBS.items():
            usual = found.limb[f"{side}_{part}"] if found else (-1, -1, -1)
            first, second, third = (of.get(f"{side}_{r}", joint) for r, joint in zip(roles, usual))
            limb[f"{side}_{part}"] = (first, second, third)
    toe = (found.toe if found else {}) | {side: of[f"{side}_toe"] for side in SIDES if f"{side}_toe" in of}
    return BodyJoints(of.get("head", found.head if found else -1), limb, toe), f"{by} and the mapping"


def with_toes(take: Take, found: BodyJoints) -> tuple[Take, BodyJoints]:
    """Toes for feet whose toes have no known name: the farthest joint below the ankle, else the foot's end, shortened."""
    toes = dict(found.toe)
    for side in SIDES:
        ankle = found.limb[f"{side}_leg"][2]
        below = [joint for joint, parent in enumerate(take.parents) if parent == ankle]
        if side not in toes and below:
            toes[side] = max(below, key=lambda joint: (joint < take.joints, take.lengths[joint].item()))
            if toes[side] >= take.joints:
                take = take.moved(toes[side], BALL_OF_FOOT)
        if side in toes and take.lengths[toes[side]] < 0.1 * take.lengths[ankle]:
            del toes[side]  # too short to show a direction
    return take, BodyJoints(found.head, found.limb, toes)


def is_mirrored(take: Take, found: BodyJoints) -> bool:
    """Whether toes point backwards and knees bend forwards, as seen from hips that are named left and right."""
    ankles = take.t[:, [found.limb[f"{side}_leg"][2] for side in SIDES]].mean(1)
    hips = [found.limb[f"{side}_leg"][0] for side in SIDES]
    across = take.t[:, hips[0]] - take.t[:, hips[1]]
    forward = torch.linalg.cross(across, take.t[:, found.head] - ankles)
    backwards, bends = [], []
    for side in SIDES:
        hip, knee, ankle = (take.t[:, joint] for joint in found.limb[f"{side}_leg"])
        bends.append((torch.linalg.cross(knee - hip, ankle - knee) * across).sum(-1).mean() < 0)
        if side in found.toe:
            toe = take.t[:, found.toe[side]] - ankle
            backwards.append(((forward * toe).sum(-1) < 0).double().mean() > 0.7)
    return len(backwards) == 2 and all(backwards) and all(bends)


def find_unit(take: Take, found: BodyJoints, mapping: Mapping, path: Path) -> tuple[str, float, float]:
    """The unit's name, the unit (m), and the person's height (m) by its bones.

    Raises WearcapError where no unit makes a person of them.
    """
    height = _height(take, found)
    if not 1e-9 < height < 1e9:
        raise WearcapError("its bones have no length", path, "OFFSETs or position channels that make a body")
    likely = [(name, UNITS_M[name]) for name in LIKELY_UNITS]
    if mapping.unit_m is not None or take.unit_m is not None:
        unit_m = mapping.unit_m or take.unit_m or 1.0
        name = "as stated" if mapping.unit_m else "as the format says"
    else:
        usual = [row for row in likely if USUAL_HEIGHT_M[0] <= height * row[1] <= USUAL_HEIGHT_M[1]]
        name, unit_m = (usual or sorted(likely, key=lambda row: abs(torch.tensor(height * row[1] / 1.7).log().item())))[
            0
        ]
    if not HEIGHT_M[0] < height * unit_m < HEIGHT_M[1]:
        what = f"the body would be about {height * unit_m:.3g} m tall (unit {unit_m:g} m)"
        fix = f"For a person of 1.70 m, give mapping=FILE.yaml with unit: {1.7 / height:.4g}."
        raise WearcapError(what, path, "a person's size", fix)
    return name, unit_m, height * unit_m


def _height(take: Take, found: BodyJoints) -> float:
    """Stature (file units): that of xsens23 whose legs, and path from hips to head, are as long in total."""
    ours = xsens23()

    def measure(t: Tensor, head: int, legs: list[tuple[int, int, int]]) -> float:
        hips = t[:, [leg[0] for leg in legs]].mean(1)
        length = (t[:, head] - hips).norm(dim=-1)
        for a, b, c in legs:
            length = length + ((t[:, a] - t[:, b]).norm(dim=-1) + (t[:, b] - t[:, c]).norm(dim=-1)) / 2
        return length.quantile(0.9).item()  # the back is straight in some frames

    legs = [found.limb[f"{side}_leg"] for side in SIDES]
    of_ours = [(ours.index(f"{s}_hip"), ours.index(f"{s}_knee"), ours.index(f"{s}_ankle")) for s in SIDES]
    stature = ours.stature / measure(ours.rest_joints[None], ours.index("head"), of_ours)
    thin = take.t[:: max(1, len(take.t) // 1000)]
    return stature * measure(thin, found.head, legs)


def with_thorax(take: Take, unit_m: float) -> Take:
    """The bone that cgspeed's conversions of CMU lost, put back; other takes as they are."""
    lost = ("Neck", "LeftShoulder", "RightShoulder")
    if "LHipJoint" not in take.names or not set(lost) <= set(take.names):
        return take
    joints = [take.names.index(name) for name in lost]
    if take.lengths[joints].max() > 0.02 / unit_m:
        return take
    up = torch.tensor([0.0, LOST_THORAX_M / unit_m, 0.0], dtype=take.t.dtype)
    return take.lifted(joints, up)


def find_axes(
    take: Take, found: BodyJoints, R_ours_rest: Float[Tensor, "3 3"] | None, mapping: Mapping, unit_m: float
) -> tuple[str, str]:
    """The file's axes that point up, and along our x.

    Up is where heads are above feet, and where the lowest joint stays on one floor. A body that stands along another
    axis than its bind pose's, or than y where that pose does not stand, is believed only if it stands: one that lies has
    its ground at 0 along the usual axis, and none there along its own.
    """
    ankles = take.t[:, [found.limb[f"{side}_leg"][2] for side in SIDES]].mean(1)
    upward = torch.nn.functional.normalize(take.t[:, found.head] - ankles, dim=-1).mean(0)
    thin = take.t[:: max(1, len(take.t) // 1000), [found.head, *(j for triple in found.limb.values() for j in triple)]]
    floors = torch.cat([thin.amin(1), -thin.amax(1)], -1) * unit_m  # along x, y, z, -x, -y, -z
    low, high = floors.quantile(0.05, 0), floors.quantile(0.95, 0)
    up = AXES[int((torch.cat([upward, -upward]) - (high - low)).argmax())]
    grounded = {axis for k, axis in enumerate(AXES) if low[k] > -_GROUND_M and high[k] < _GROUND_M}
    bind = None if R_ours_rest is None else _axis(R_ours_rest[2])
    usual = bind or "y"
    highest = -floors[:, (AXES.index(usual) + 3) % 6].amin()
    if usual != up and usual in grounded and (up not in grounded or (bind is not None and highest < 0.8)):
        up = usual
    up = mapping.up or take.up or up
    if mapping.forward is not None:
        return up, mapping.forward
    ahead = None if R_ours_rest is None else _axis(R_ours_rest[0])
    usual = {"y": "z", "z": "-y", "x": "z"}[up[-1]] if take.up is None else "x"
    return up, ahead if ahead is not None and ahead[-1] != up[-1] else usual


def _axis(direction: Float[Tensor, "3"]) -> str:
    """Name of the axis nearest to a direction."""
    k = int(direction.abs().argmax())
    return ("-" if direction[k] < 0 else "") + "xyz"[k]
