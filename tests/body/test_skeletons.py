"""Named skeletons: trees that agree with each other and with their sources' joint order."""

import pytest
import torch

from wearcap.body.kinematics import forward_kinematics
from wearcap.body.retarget import fit_offsets, retarget
from wearcap.body.skeletons import skeleton_by_name
from wearcap.errors import WearcapError
from wearcap.geometry import rotation

NAMES = ("xsens23", "smpl24", "smplh52", "smplx22", "cmu31")


@pytest.mark.parametrize("name", NAMES)
def test_counts_and_symmetry(name):
    skeleton = skeleton_by_name(name)
    assert skeleton.name == name
    assert len(skeleton) == int(name[-2:])
    other = {"left": "right", "right": "left", "l": "r", "r": "l"}
    for joint, label in enumerate(skeleton.joint_names):
        side = label.split("_")[0] if "_" in label else label[0] if name == "cmu31" and label[0] in "lr" else ""
        twin = other.get(side, side) + label[len(side) :]
        if side and twin in skeleton.joint_names:
            mirrored = skeleton.rest_joints[skeleton.index(twin)] * torch.tensor([1.0, -1.0, 1.0])
            torch.testing.assert_close(mirrored, skeleton.rest_joints[joint], atol=1e-6, rtol=0)
    assert 0.8 < skeleton.root_height < 1.05


def test_smpl_orders():
    smpl, smplh = skeleton_by_name("smpl24"), skeleton_by_name("smplh52")
    assert smpl.joint_names[:22] == smplh.joint_names[:22] == skeleton_by_name("smplx22").joint_names
    assert smpl.indices("neck", "head", "left_wrist", "right_wrist", "right_hand") == [12, 15, 20, 21, 23]
    assert smplh.indices("left_index1", "left_thumb3", "right_index1", "right_thumb3") == [22, 36, 37, 51]
    assert smpl.index("left_toe") == smpl.index("left_foot") == 10


@pytest.mark.parametrize("name", NAMES[1:])
def test_round_trip_through_xsens(name):
    """Any named skeleton → xsens23 with its proportions → back: within millimetres (the spine shares its bend)."""
    source = skeleton_by_name(name)
    target = fit_offsets(source, skeleton_by_name("xsens23"))
    torch.manual_seed(3)
    rotvec = 0.2 * torch.randn(64, len(source), 3)
    if name == "cmu31":  # its hips' rods do not turn, its forearms only twist
        rotvec[:, source.indices("lhipjoint", "rhipjoint")] = 0
        rotvec[:, source.indices("lwrist", "rwrist")] *= torch.tensor([0.0, 1.0, 0.0])
    R = rotation.exp(rotvec)
    t = torch.randn(64, 3)
    truth = forward_kinematics(source, R, t).t
    there = forward_kinematics(target, *retarget(source, target, R, t)).t
    back = forward_kinematics(source, *retarget(target, source, *retarget(source, target, R, t))).t
    wrist, ankle = ("lhand", "lfoot") if name == "cmu31" else ("left_wrist", "left_ankle")
    for theirs, ours in ((wrist, "left_wrist"), (ankle, "left_ankle")):
        assert (truth[:, source.index(theirs)] - there[:, target.index(ours)]).norm(dim=-1).max() < 0.005
    body = [j for j in range(len(source)) if not _is_finger(source.joint_names[j])]
    assert (back - truth)[:, body].norm(dim=-1).mean() < 0.004
    assert (back - truth)[:, body].norm(dim=-1).max() < 0.030


def _is_finger(name: str) -> bool:
    return any(part in name for part in ("index", "middle", "ring", "pinky", "thumb", "finger"))


def test_unknown_name_lists_the_known():
    with pytest.raises(WearcapError, match="xsens23, smpl24"):
        skeleton_by_name("smpl25")
