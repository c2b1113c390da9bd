"""Key frames joined by the motion tracked between them."""

from dataclasses import replace

import numpy as np
import torch

from wearcap.geometry import rotation
from wearcap.localization.absolute_pose import CameraPose
from wearcap.localization.pose_chain import ChainedPose, joined

KEYS, FRAMES = 12, 8
KEY_M, DRIFT_M = 0.01, 0.001
KEY, DRIFT = np.eye(6) * KEY_M**2, np.eye(6) * DRIFT_M**2


def at(position: torch.Tensor, error: np.ndarray) -> CameraPose:
    """A pose whose true orientation is the identity, with an error."""
    turn, move = torch.from_numpy(error).float().split(3)
    return CameraPose(rotation.exp(turn), position + move, 100, 1.0, torch.from_numpy(KEY).float())


def tracked(seed: int = 0, wrong: int | None = None) -> tuple[list[ChainedPose | None], torch.Tensor]:
    """A straight walk: key frames with independent errors, which tracking carries on; tracking into the key frame
    `wrong` is a metre off. Its poses and the true positions."""
    rng = np.random.default_rng(seed)
    positions = torch.stack([torch.arange(KEYS * FRAMES) * 0.02, *[torch.zeros(KEYS * FRAMES)] * 2], 1)
    poses: list[ChainedPose | None] = []
    before = None
    for number in range(KEYS):
        error, added = rng.normal(0, KEY_M, 6), rng.normal(0, DRIFT_M, 6)
        key = at(positions[number * FRAMES], error)
        for frame in range(FRAMES):
            pose = at(positions[number * FRAMES + frame], error + added * frame / FRAMES)
            spread = DRIFT * frame / FRAMES
            poses.append(ChainedPose(pose if frame else key, key, spread, None if frame else before))
        if number + 1 < KEYS:
            ahead = at(positions[(number + 1) * FRAMES], error + added + (number + 1 == wrong))
            before = ChainedPose(ahead, key, DRIFT)
    return poses, positions


def errors_m(poses: list[CameraPose | None], positions: torch.Tensor) -> torch.Tensor:
    return torch.stack([pose.t_world_cam for pose in poses if pose is not None]).sub(positions).norm(dim=1)


def test_errors_of_key_frames_average_out_over_the_chain():
    before, after, spread = [], [], []
    for seed in range(20):
        poses, positions = tracked(seed)
        found = joined(poses)
        before.append(errors_m([pose and pose.pose for pose in poses], positions))
        after.append(errors_m(found, positions))
        spread.append([pose.covariance[3:, 3:].trace().sqrt().item() for pose in found if pose is not None])
    before, after = torch.cat(before).square().mean().sqrt(), torch.cat(after).square().mean().sqrt()
    assert after < 0.4 * before  # 12 key frames: at best 0.29
    np.testing.assert_allclose(np.mean(spread), after, rtol=0.25)


def test_tracking_that_a_key_frame_contradicts_tells_nothing():
    poses, positions = tracked(wrong=6)
    again = poses[6 * FRAMES]
    assert again is not None
    assert errors_m(joined(poses), positions).max() < 3 * KEY_M
    halves = [*joined(poses[: 6 * FRAMES]), *joined([replace(again, before=None), *poses[6 * FRAMES + 1 :]])]
    torch.testing.assert_close(errors_m(joined(poses), positions), errors_m(halves, positions))


def test_a_gap_ends_a_chain_and_a_key_frame_alone_stays():
    poses, _ = tracked()
    poses[5 * FRAMES - 1] = None
    found = joined(poses)
    assert [number for number, pose in enumerate(found) if pose is None] == [5 * FRAMES - 1]
    [alone] = joined(poses[:1])
    assert alone is not None
    assert poses[0] is not None
    torch.testing.assert_close(alone.t_world_cam, poses[0].pose.t_world_cam)
    assert joined([None, None]) == [None, None]
