"""Wearables: nothing of the truth is handed on, errors are as large as their presets say, points stay with the path."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.tables import wearables
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.recording import Recording
from wearcap.recording.recording import FloorTrack, PointCloud
from wearcap.sensors.simulated import SlamNoise, head_stream, slam_poses
from wearcap_testing import swaying_motion

WEARABLES, WearableNoise = wearables.WEARABLES, wearables.WearableNoise

SEAT = torch.tensor([0.09, 0.0, 0.08])


def recorded(frames: int = 600) -> Recording:
    motion = swaying_motion(frames)
    cloud = torch.randn(400, 3, generator=torch.Generator().manual_seed(0))
    seen = motion.timestamps[torch.arange(400) % frames]
    return Recording(
        "sway",
        head=head_stream(motion, SEAT),
        points=PointCloud(cloud, first_seen=seen),
        motion=motion,
        floor=FloorTrack(motion.timestamps, torch.zeros(frames)),
        skeleton=motion.skeleton,
        shape={"height": 1.7},
    )


def sensed(noise: wearables.WearableNoise, seed: int = 0, frames: int = 600) -> Recording:
    return wearables.with_noise(recorded(frames), noise, np.random.default_rng(seed))


@pytest.mark.parametrize("preset", WEARABLES)
def test_nothing_of_the_truth_is_left(preset):
    found = sensed(WearableNoise.preset(preset))
    assert found.motion is None
    assert found.floor is None
    assert found.contacts is None
    assert not found.shape
    assert set(found.imu) == {"left_wrist", "right_wrist"}
    same = torch.allclose(found.skeleton.t_parent_joint, recorded().skeleton.t_parent_joint, atol=1e-4)
    assert same == (preset == "ideal")


def test_ideal_devices_sense_the_truth():
    found, true = sensed(WearableNoise.preset("ideal")), recorded()
    torch.testing.assert_close(found.head.T_world_head.t, true.head.T_world_head.t, atol=1e-5, rtol=0)
    torch.testing.assert_close(found.points.points_world, true.points.points_world, atol=1e-4, rtol=0)
    wrist = true.motion.joint("left_wrist")
    torch.testing.assert_close(found.imu["left_wrist"].R_world_imu, wrist.R, atol=1e-4, rtol=0)
    torch.testing.assert_close(found.tracked["left_wrist"].T_world_body.R, wrist.R, atol=1e-4, rtol=0)
    torch.testing.assert_close(found.tracked["left_wrist"].T_world_body.t, wrist.t, atol=1e-4, rtol=0)


@pytest.mark.parametrize("preset", ["typical", "poor"])
def test_tracked_wrists_drift_with_the_head_and_sit_where_nobody_measured(preset):
    """Seen from the head they are off by how they are held, and by little else."""
    noise, true = WearableNoise.preset(preset), recorded().motion
    off_m, off_deg = [], []
    for seed in range(12):
        found = sensed(noise, seed)
        for joint in ("left_wrist", "right_wrist"):
            # `seat` is how the device sits on the head, which the path as sensed holds, too
            device = found.head.T_world_head @ Rigid(found.head.R_head_device, found.head.t_head_device)
            seen = device.inverse() @ found.tracked[joint].T_world_body
            as_worn = Rigid(torch.eye(3), SEAT)
            expected = (true.joint("head") @ as_worn).inverse() @ true.joint(joint)
            off_m.append((seen.t.norm(dim=-1) - expected.t.norm(dim=-1)).abs().mean())
            off_deg.append(rotation.geodesic(seen.R, expected.R).rad2deg().mean())
    assert 0.2 * noise.grip_m < torch.stack(off_m).mean() < 1.5 * (noise.grip_m + noise.seat_m)
    assert 0.5 * noise.grip_deg < torch.stack(off_deg).mean() < 1.5 * (noise.grip_deg + noise.seat_deg)


@pytest.mark.parametrize(
    ("preset", "cm", "deg"), [("typical", (0.7, 3.0), (1.2, 2.8)), ("poor", (4.0, 9.0), (3.5, 6.5))]
)
def test_heads_are_as_far_off_as_their_preset_says(preset, cm, deg):
    true = recorded().head.T_world_head
    off = [sensed(WearableNoise.preset(preset), seed).head.T_world_head for seed in range(20)]
    far = torch.stack([(T.t - true.t).norm(dim=-1).mean() for T in off]).mean()
    turned = torch.stack([rotation.geodesic(T.R, true.R).mean() for T in off]).mean()
    assert cm[0] < 100 * far < cm[1]
    assert deg[0] < turned.rad2deg() < deg[1]


def test_watches_are_off_by_strap_heading_and_attitude():
    true = recorded().motion.joint("left_wrist").R
    for preset, low, high in (("typical", 3.0, 6.5), ("poor", 6.0, 13.0)):
        off = [sensed(WearableNoise.preset(preset), seed).imu["left_wrist"].R_world_imu for seed in range(20)]
        assert low < torch.stack([rotation.geodesic(R, true).mean() for R in off]).mean().rad2deg() < high


def test_points_are_seen_from_the_path_as_tracked():
    """A device keeps its distance and direction to a point at the moment when it sees it, but for the world's scale."""
    noise = replace(WearableNoise.preset("poor"), seat_m=0.0, seat_deg=0.0)
    found, true = sensed(noise), recorded()
    frame = torch.arange(400) % 600
    seen, was = (r.head.T_world_device[frame].inverse() @ r.points.points_world for r in (found, true))
    scale = (seen.norm(dim=-1) / was.norm(dim=-1)).unique()
    assert scale.std() < 1e-4
    assert 1e-4 < (scale.mean() - 1).abs() < 0.08
    torch.testing.assert_close(seen / scale.mean(), was, atol=1e-4, rtol=0)


def test_a_leaning_world_rises_with_the_way():
    time = torch.arange(100)
    path = Rigid(torch.eye(3).repeat(100, 1, 1), torch.stack([0.1 * time, 0 * time, 0 * time + 1.6], -1).float())
    noise = SlamNoise(jitter_m=0.0, jitter_deg=0.0, lean_deg=1.0)
    rise = [slam_poses(path, 30.0, noise, np.random.default_rng(seed))[0].t[-1, 2] - 1.6 for seed in range(200)]
    # One of the two axes of a lean of 1° lifts the end of 9.9 m.
    assert torch.stack(rise).std() == pytest.approx(9.9 * np.deg2rad(1.0) / 2**0.5, rel=0.15)


def test_the_stature_is_nearly_right():
    statures = torch.tensor([sensed(WEARABLES["typical"], seed, 30).skeleton.stature for seed in range(30)])
    true = recorded(30).skeleton.stature
    assert abs(statures.mean() - true) < 0.006
    assert 0.004 < statures.std() < 0.016


def test_what_cannot_be_worn_is_refused():
    with pytest.raises(WearcapError, match="ideal, typical, poor"):
        WearableNoise.preset("perfect")
    with pytest.raises(WearcapError, match="nothing to sense"):
        wearables.with_noise(Recording("empty"), WEARABLES["ideal"], np.random.default_rng(0))
