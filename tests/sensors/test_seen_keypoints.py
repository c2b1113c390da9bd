"""What detectors on a head camera report of a true motion: near the truth, and only of what is in the picture."""

import numpy as np
import pytest
import torch

from benchmarks.tables import mocap_every_several
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.camera import Camera
from wearcap.geometry.trajectory import Trajectory
from wearcap.recording import Motion
from wearcap_testing import swaying_motion
from wearsim.sensors.keypoints import ACTION_CAMERA, action_camera, camera_path, seen_joints
from wearsim.sensors.slam import R_DEVICE_CAM

WRISTS = ("left_wrist", "right_wrist")


def reaching(frames: int = 1200) -> Motion:
    """Both arms are held forward and lowered slowly until they are out of sight."""
    motion = swaying_motion(frames)
    R = motion.R_parent_joint.clone()
    down = torch.linspace(0.0, 1.2, frames)
    for side, turn in (("left", -1.4), ("right", 1.4)):
        forward = rotation.about_axis("z", torch.tensor(turn))
        R[:, motion.skeleton.index(f"{side}_shoulder")] = rotation.about_axis("y", down) @ forward
    return Motion(motion.timestamps, motion.skeleton, R, motion.t_world_root)


def watching(motion: Motion, distance_m: float, up_m: float = 1.5) -> Trajectory:
    """A camera at rest that looks along x at where the motion begins."""
    times = motion.timestamps[::2].contiguous()
    t = motion.t_world_root[0] * torch.tensor([1.0, 1.0, 0.0]) + torch.tensor([-distance_m, 0.0, up_m])
    return Trajectory(times, R_DEVICE_CAM.expand(len(times), 3, 3), t.expand(len(times), 3))


@pytest.fixture(scope="module")
def motion() -> Motion:
    return reaching()


@pytest.fixture(scope="module")
def path(motion) -> Trajectory:
    return camera_path(motion, action_camera(motion.timestamps[::2].contiguous()))


def truth(motion: Motion, path: Trajectory, joint: str) -> tuple[torch.Tensor, torch.Tensor]:
    p_cam = path.T_world_body.inverse() @ motion.joint(joint).t[::2][: len(path)]
    return ACTION_CAMERA.project(p_cam)


def test_the_action_camera_looks_down_and_is_wide():
    stream = action_camera(torch.zeros(1, dtype=torch.float64))
    forward = stream.R_head_cam[:, 2]
    assert torch.atan2(-forward[2], forward[0]).rad2deg() == pytest.approx(22.5, abs=1e-3)
    edges = ACTION_CAMERA.unproject(torch.tensor([[-0.5, 539.5], [959.5, -0.5]]))
    assert torch.acos(edges[:, 2]).rad2deg().mul(2).tolist() == pytest.approx([94, 69], abs=0.5)


def test_joints_are_seen_where_they_are_in_the_picture(motion, path):
    cues = seen_joints(motion, path, ACTION_CAMERA, WRISTS, 0.0, 0.0, np.random.default_rng(0))
    assert set(cues) == set(WRISTS)
    for joint, cue in cues.items():
        pixels, seen = truth(motion, path, joint)
        assert 0.1 < seen.float().mean() < 0.9
        assert torch.equal(cue.timestamps, path.timestamps[seen])
        assert (cue.points - pixels[seen]).abs().max() < 0.01


def test_noise_and_misses_are_as_asked_for(motion, path):
    exact = seen_joints(motion, path, ACTION_CAMERA, WRISTS, 0.0, 0.0, np.random.default_rng(0))
    errors, rows, all_rows, sure = [], 0, 0, []
    for seed in range(12):
        cues = seen_joints(motion, path, ACTION_CAMERA, WRISTS, 5.0, 0.2, np.random.default_rng(seed))
        for joint, cue in cues.items():
            at = torch.searchsorted(exact[joint].timestamps, cue.timestamps)
            errors.append(cue.points - exact[joint].points[at])
            sure.append(cue.confidence)
            rows, all_rows = rows + len(at), all_rows + len(exact[joint].timestamps)
    error, confidence = torch.cat(errors), torch.cat(sure)
    assert error.square().mean().sqrt() == pytest.approx(5.0 * np.exp(0.16), rel=0.15)
    assert 1 - rows / all_rows == pytest.approx(0.2, abs=0.06)
    assert ((confidence > 0) & (confidence <= 1)).all()
    good, bad = (error[part].norm(dim=-1).mean() for part in (confidence > 0.85, confidence < 0.7))
    assert bad > 1.5 * good


def test_what_lies_behind_is_not_seen(motion, path):
    assert not seen_joints(motion, path, ACTION_CAMERA, ["head", "neck"], 1.0, 0.0, np.random.default_rng(0))
    fisheye = Camera("fisheye", 1000, 1000, 180.0, 180.0, 499.5, 499.5, (0.0,) * 4)
    wide = seen_joints(motion, path, fisheye, ["left_toe"], 1.0, 0.0, np.random.default_rng(0))
    assert wide["left_toe"].points.shape[1] == 2


def test_a_clock_of_its_own_is_refused(motion):
    with pytest.raises(WearcapError, match="0 pictures of the head camera during the motion"):
        camera_path(motion, action_camera(motion.timestamps + 1e4))


def test_an_estimated_pose_is_as_wrong_as_asked_and_of_what_is_in_the_picture(motion):
    path = watching(motion, 1.2)
    seen_pose = mocap_every_several.seen_pose
    exact, seen = seen_pose(motion, path, ACTION_CAMERA, 0.0, 0.0, np.random.default_rng(0))
    off, confidence = seen_pose(motion, path, ACTION_CAMERA, 12.0, 0.2, np.random.default_rng(0))
    assert torch.allclose(exact.R_parent_joint, motion.R_parent_joint[::2][: len(path)], atol=1e-5)
    inside = {j: truth(motion, path, j)[1] for j in ("left_knee", "left_ankle", "left_toe")}
    skeleton = motion.skeleton
    assert torch.equal(seen[:, skeleton.index("left_toe")] > 0, inside["left_toe"])
    assert torch.equal(seen[:, skeleton.index("left_knee")] > 0, inside["left_knee"] & inside["left_ankle"])
    angle = rotation.geodesic(off.R_parent_joint, exact.R_parent_joint).rad2deg()
    assert angle[:, 0].max() < 1e-3
    assert angle[:, 1:].square().mean().sqrt() == pytest.approx(12.0, rel=0.3)
    missed = (seen > 0).any(1) & ~(confidence > 0).any(1)
    assert missed.float().mean() == pytest.approx(0.2, abs=0.1)
    assert ((confidence > 0) <= (seen > 0)).all()
    assert (confidence <= 1).all()
