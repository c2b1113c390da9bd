"""Windows of true motion and their features: known movements give known features, wherever they happen."""

import math
from dataclasses import replace
from functools import partial

import pytest
import torch

from benchmarks.rivals.single_windows.transforms import Window, mirrored
from drawn_windows import numbers, one
from wearcap.body.skeleton import xsens23
from wearcap.data.datamodule import Loading, WindowsModule
from wearcap.data.motion_features import MotionFeatures, Movement, MovementContent
from wearcap.data.transforms import Mirror, Shift, joint_twins
from wearcap.data.windows import Source, Windows
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.recording import Motion
from wearcap_testing import small_dataset, swaying_motion

FEATURES = MotionFeatures(xsens23())


def encoded(motion: Motion) -> torch.Tensor:
    return FEATURES.encode(FEATURES.movement(motion).windows(20, 20))


def turned(motion: Motion, yaw: float, shift: list[float]) -> Motion:
    Rz = rotation.about_axis("z", torch.tensor(yaw))
    R = torch.cat([(Rz @ motion.R_parent_joint[:, 0])[:, None], motion.R_parent_joint[:, 1:]], 1)
    return replace(motion, R_parent_joint=R, t_world_root=motion.t_world_root @ Rz.T + torch.tensor(shift))


def test_it_does_not_matter_where_and_which_way_it_happens():
    motion = swaying_motion(240)
    moved = encoded(turned(motion, 2.2, [3.0, -4.0, 1.5]))
    torch.testing.assert_close(moved, encoded(motion), atol=2e-4, rtol=1e-4)


def test_a_body_that_glides_along_a_circle_is_described_so():
    time = torch.arange(120, dtype=torch.float64) / 60
    angle = 0.5 * time.float()
    R = torch.eye(3).repeat(120, 23, 1, 1)
    R[:, 0] = rotation.about_axis("z", angle)
    skeleton = xsens23()
    root = torch.stack([2 * angle.sin(), -2 * angle.cos(), torch.full_like(angle, skeleton.root_height)], -1)
    features = encoded(Motion(time, skeleton, R, root))[0]
    assert features.shape == (20, 143)
    assert features[:, 0].tolist() == pytest.approx([0.5] * 20, abs=1e-4)  # rad/s to the left
    assert features[1:, 1].tolist() == pytest.approx([1.0] * 19, abs=1e-3)  # m/s ahead
    assert features[1:, 2].abs().max() < 0.02
    rest = skeleton.rest_joints - skeleton.rest_joints[:, 2].min() * torch.tensor([0.0, 0.0, 1.0])
    torch.testing.assert_close(FEATURES.joints(features[None])[0, 7], rest, atol=1e-5, rtol=0)
    wrist = features[1:, 70 + 3 * skeleton.index("left_wrist") :][:, 0]
    assert wrist.tolist() == pytest.approx([1.0 - 0.5 * 0.72] * 19, abs=0.01)  # on the inner side of the turn
    assert features[:, -4:].max() == 0  # it moves too fast to stand
    still = encoded(Motion(time, skeleton, R[:1].expand_as(R), root[:1].expand_as(root)))
    assert still[..., -4:].min() == 1
    raised = still.new_tensor([0.0, 0.0, 0.3])
    lifted = FEATURES.movement(
        Motion(time, skeleton, R[:1].expand_as(R), (root[:1] + raised).expand_as(root)), torch.zeros(40)
    ).windows(20, 20)
    assert FEATURES.encode(lifted)[..., -4:].max() == 0


def test_windows_are_cut_whole_and_at_their_stride():
    whole = FEATURES.movement(swaying_motion(210))
    assert len(whole.floor_height) == 70
    windows = whole.windows(20, 15)
    assert windows.joints.shape == (4, 20, 23, 3)
    for k in range(4):
        assert torch.equal(windows.joints[k], whole.joints[15 * k : 15 * k + 20])
    assert len(whole.windows(70, 15).joints) == 1
    assert whole.windows(71, 15).R_world_root.shape == (0, 71, 3, 3)


def test_a_mirror_swaps_left_and_right():
    whole = FEATURES.movement(swaying_motion(60))
    movement = whole.windows(20, 20)
    values = {"t_world_joint": whole.joints, "R_world_root": whole.R_world_root, "floor_height": whole.floor_height}
    swapped = mirrored(Window(values, {"t_world_joint": joint_twins(FEATURES.skeleton)}))
    seen = Movement(*swapped.values.values()).windows(20, 20)
    there, here = FEATURES.encode(seen)[0], FEATURES.encode(movement)[0]
    assert torch.allclose(there[:, 0], -here[:, 0], atol=1e-4)
    assert torch.allclose(there[:, [1, 3]], here[:, [1, 3]], atol=1e-4)
    left, right = FEATURES.skeleton.indices("left_wrist", "right_wrist")
    joints, joints_seen = FEATURES.joints(here[None])[0], FEATURES.joints(there[None])[0]
    flip = torch.tensor([1.0, -1.0, 1.0])
    assert torch.allclose(joints_seen[:, left], joints[:, right] * flip, atol=1e-4)
    torch.testing.assert_close(mirrored(swapped).values["t_world_joint"], whole.joints)


def test_windows_of_a_data_set_are_its_true_motion(tmp_path):
    store = small_dataset(tmp_path)
    varied = {"shift": Shift(), "mirror": Mirror()}
    settings = {"content": MovementContent(FEATURES), "window": 20, "stride": 10, "fps": 20.0, "every": 3}
    plain = Windows([Source(str(tmp_path))], "train", **settings)
    for index in (0, 5, len(plain) - 1):
        track, start = plain.starts[index].tolist()
        motion = store.load(store.names("train")[track]).motion
        truth, window = motion.sliced(3 * start, 3 * start + 60), one(plain, index)
        torch.testing.assert_close(window.joints, truth.T_world_joint.t[::3], atol=1e-5, rtol=0)
        torch.testing.assert_close(window.R_world_root, truth.R_parent_joint[::3, 0], atol=2e-4, rtol=0)
        torch.testing.assert_close(window.floor_height, FEATURES.movement(motion).floor_height[start : start + 20])
    data = WindowsModule(partial(Windows, transforms=varied, **settings), Loading(4, 2), {"a": {"root": str(tmp_path)}})
    data.setup("fit")
    batches = list(data.train_dataloader())
    assert [len(batch.joints) for batch in batches] == [4, 4]
    assert torch.equal(batches[1].joints, list(data.train_dataloader())[1].joints)
    joints = data.train.batch(numbers(0, 0), numbers(1, 2)).joints
    assert not torch.equal(joints[0], joints[1])  # shifted, mirrored
    assert len(next(iter(data.val_dataloader())).joints) == 4
    with pytest.raises(WearcapError, match=r"windows of every 1th frame.*every 3th"):
        Windows([Source(str(tmp_path))], "train", **settings | {"every": 1, "fps": 60.0})


def test_what_it_cannot_describe_is_refused():
    motion = swaying_motion(60, fps=50.0)
    with pytest.raises(WearcapError, match=r"50\.00 frames per second"):
        FEATURES.movement(motion)
    s = motion.skeleton
    other = type(s)("dog", ("paw", *s.joint_names[1:]), s.parents, s.t_parent_joint)
    with pytest.raises(WearcapError, match="dog"):
        FEATURES.movement(replace(motion, skeleton=other))
    assert math.isclose(MotionFeatures(xsens23(), fps=50.0).movement(motion).joints.shape[0], 20)
