"""Which joint is which: names as programs write them, and the tree where names say nothing."""

import pytest
import torch

from wearcap.body.joint_matching import convention, joints_by_name, joints_by_topology, plain_name
from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import xsens23
from wearcap.errors import WearcapError
from wearcap.geometry import rotation


@pytest.mark.parametrize(
    ("name", "plain"),
    [
        ("mixamorig:LeftUpLeg", "leftupleg"),
        ("mixamorig1:LeftUpLeg", "leftupleg"),
        ("mixamorigLeftUpLeg", "leftupleg"),
        ("Character1_LeftUpLeg", "leftupleg"),
        ("DEF-thigh.L", "lthigh"),
        ("DEF-thigh.L.001", "lthigh"),
        ("thigh_l", "lthigh"),
        ("Bip01 L Thigh", "lthigh"),
        ("Bip001_R_Calf", "rcalf"),
        ("CC_Base_L_Thigh", "lthigh"),
        ("J_Bip_L_UpperLeg", "lupperleg"),
        ("J_Bip_C_Head", "head"),
        ("lThighBend", "lthighbend"),
        ("Armature|Skeleton:LeftHand", "lefthand"),
        ("upperarm01.L", "lupperarm"),
        ("UpperArmLeft", "leftupperarm"),
        ("Head", "head"),
    ],
)
def test_names_lose_prefixes_and_numbers_and_begin_with_their_side(name, plain):
    assert plain_name(name) == plain


TRUNK = ("pelvis", "spine", "neck", "head")
LIMBS = {
    "VRM": ("J_Bip_C_Head", "J_Bip_{s}_UpperLeg J_Bip_{s}_LowerLeg J_Bip_{s}_Foot J_Bip_{s}_ToeBase J_Bip_{s}_Shoulder "
            "J_Bip_{s}_UpperArm J_Bip_{s}_LowerArm J_Bip_{s}_Hand", ("L", "R")),
    "Reallusion": ("CC_Base_Head", "CC_Base_{s}_Thigh CC_Base_{s}_Calf CC_Base_{s}_Foot CC_Base_{s}_ToeBase "
                   "CC_Base_{s}_Clavicle CC_Base_{s}_Upperarm CC_Base_{s}_Forearm CC_Base_{s}_Hand", ("L", "R")),
    "3ds Max's BVH (hip, knee, ankle)": ("Head", "{s}Hip {s}Knee {s}Ankle {s}Toe {s}Collar {s}Shoulder {s}Elbow {s}Wrist",
                                         ("Left", "Right")),
    "DAZ, Poser": ("head", "{s}ThighBend {s}Shin {s}Foot {s}Toe {s}Collar {s}ShldrBend {s}ForearmBend {s}Hand", ("l", "r")),
    "of its own": ("Head", "LegUpper_{s} LegLower_{s} Foot_{s} Toe_{s} Clavicle_{s} ArmUpper_{s} ArmLower_{s} Hand_{s}",
                   ("L", "R")),
}  # fmt: skip


@pytest.mark.parametrize("name", LIMBS)
def test_a_body_is_found_by_names(name):
    head, parts, sides = LIMBS[name]
    names, parents = ["pelvis", "spine", "neck", head], [-1, 0, 1, 2]
    for side in sides:
        hip, knee, ankle, toe, collar, shoulder, elbow, wrist = parts.replace("{s}", side).split()
        for joint, above in ((hip, "pelvis"), (knee, hip), (ankle, knee), (toe, ankle),
                             (collar, "spine"), (shoulder, collar), (elbow, shoulder), (wrist, elbow)):  # fmt: skip
            parents.append(names.index(above))
            names.append(joint)
    found = joints_by_name(names, parents)
    assert convention(names) == name
    assert names[found.head] == head
    for side, ours in zip(sides, ("left", "right")):
        legs, arms = parts.replace("{s}", side).split()[:3], parts.replace("{s}", side).split()[5:]
        assert [names[joint] for joint in found.limb[f"{ours}_leg"]] == legs
        assert [names[joint] for joint in found.limb[f"{ours}_arm"]] == arms
        assert names[found.toe[ours]] == parts.replace("{s}", side).split()[3]


def bent_body() -> tuple[list[int], torch.Tensor, torch.Tensor]:
    """Parents, lengths and places of xsens23 with bent knees, facing anywhere."""
    skeleton = xsens23()
    R = torch.eye(3).repeat(5, len(skeleton), 1, 1)
    R[:, 0] = rotation.about_axis("z", torch.tensor(2.0)) @ rotation.about_axis("x", torch.tensor(0.3))
    for side in ("left", "right"):
        R[:, skeleton.index(f"{side}_knee")] = rotation.about_axis("y", torch.tensor(0.8))
    return (
        list(skeleton.parents),
        skeleton.t_parent_joint.norm(dim=-1),
        forward_kinematics(skeleton, R, torch.zeros(5, 3)).t,
    )


@pytest.mark.parametrize("toes", [True, False])
def test_a_body_is_found_by_its_tree_alone(toes):
    skeleton, (parents, lengths, places) = xsens23(), bent_body()
    if not toes:
        kept = [joint for joint, name in enumerate(skeleton.joint_names) if "toe" not in name]
        parents = [-1 if parents[joint] < 0 else kept.index(parents[joint]) for joint in kept]
        lengths, places = lengths[kept], places[:, kept]
        names = [skeleton.joint_names[joint] for joint in kept]
    else:
        names = list(skeleton.joint_names)
    found = joints_by_topology(parents, lengths, places)
    assert names[found.head] == "head"
    for side in ("left", "right"):
        assert [names[j] for j in found.limb[f"{side}_leg"]] == [f"{side}_{n}" for n in ("hip", "knee", "ankle")]
        assert [names[j] for j in found.limb[f"{side}_arm"]] == [f"{side}_{n}" for n in ("shoulder", "elbow", "wrist")]


def test_a_chain_is_no_body():
    with pytest.raises(WearcapError, match="two pairs of limbs"):
        joints_by_topology([-1, 0, 1, 2, 3], torch.ones(5), torch.rand(2, 5, 3))
