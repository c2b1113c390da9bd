"""A session comes back to its spot, claps, stands and leans; its sensors and its localisation have their errors."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.tables import hps_outages
from data_prep.shared.engine import check_recording
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory, resample
from wearcap.recording.serialize import flatten, unflatten
from wearcap.sensors.claps import detect_claps, detect_claps_audio
from wearsim.places.site import build_site
from wearsim.recordings.hps import HpsConfig, Protocol, simulate_hps
from wearsim.recordings.localization_noise import LocalizationNoise, MapErrors, by_gravity, localize_statistically
from wearsim.rendering.head_camera import HEAD_CAMERA_TRUTH, SOUND_HZ, sound_track, view_texture
from wearsim.sensors.slam import R_DEVICE_CAM

SHORT = Protocol(returns_m=(45.0,), end_m=80.0, clap_every_s=60.0)


@pytest.fixture(scope="module")
def site():
    return build_site(np.random.default_rng(2), "site", scale=0.7)


@pytest.fixture(scope="module")
def simulated(site):
    return simulate_hps(HpsConfig(protocol=SHORT), "walk", "val", 3, world=site)


def test_the_recording_is_complete_and_can_be_stored(simulated):
    recording = simulated.recording
    check_recording(recording)
    tree, tensors = flatten(recording)
    again = unflatten(tree, tensors.__getitem__)
    assert again.intervals.names == recording.intervals.names == ("stand", "move", "stand", "move")
    assert torch.equal(
        again.object_motion[HEAD_CAMERA_TRUTH].t_world_body, recording.object_motion[HEAD_CAMERA_TRUTH].t_world_body
    )
    assert len(recording.localization.timestamps) == len(recording.camera.timestamps)
    assert set(recording.imu) == {"left_wrist", "right_wrist"}


def test_the_wearer_is_back_at_the_spot_when_due(simulated, site):
    recording, spot = simulated.recording, site.places.spots[0]
    way = recording.motion.t_world_root[:, :2].diff(dim=0).norm(dim=-1).sum()
    assert float(way) == pytest.approx(80.0, abs=8.0)
    distance = recording.intervals.distance_m
    assert float(distance[0]) < 1.0
    assert float(distance[2]) == pytest.approx(45.0, abs=6.0)
    times = recording.motion.timestamps
    for start, stop, name in zip(recording.intervals.start_s, recording.intervals.stop_s, recording.intervals.names):
        inside = (times >= start) & (times <= stop)
        place = recording.motion.t_world_root[inside][:, :2] - torch.tensor(spot.position[:2])
        assert place.norm(dim=-1).max() < (0.5 if name == "stand" else 0.75 * spot.size)
        speed = recording.motion.t_world_root[inside].diff(dim=0).norm(dim=-1) * 60
        if name == "stand":
            assert float(stop - start) == pytest.approx(3.0)
            assert speed.max() < 0.15
        else:
            assert 5.0 < float(stop - start) < 30.0
            assert speed.max() > 0.5


def test_an_a_pose_is_stood(simulated):
    recording = simulated.recording
    start, stop = recording.intervals.start_s[0], recording.intervals.stop_s[0]
    inside = (recording.motion.timestamps >= start) & (recording.motion.timestamps <= stop)
    for side in ("left", "right"):
        arm = (recording.motion.joint(f"{side}_wrist").t - recording.motion.joint(f"{side}_shoulder").t)[inside]
        off = torch.acos((-arm[:, 2] / arm.norm(dim=-1)).clamp(-1, 1)).rad2deg()
        assert ((off > 15) & (off < 50)).all()


def test_claps_are_felt_and_found(simulated):
    recording, claps = simulated.recording, torch.tensor(simulated.claps_s, dtype=torch.float64)
    assert len(claps) >= 6
    for stream in recording.imu.values():
        for clap in claps:
            near = (stream.timestamps - clap).abs() < 0.025
            assert 20 < float(stream.acc_world[near].norm(dim=-1).max()) < 75
    found = detect_claps(recording.imu["left_wrist"], recording.imu["right_wrist"])
    assert float((found[:, None] - claps).abs().min(0).values.max()) < 0.012
    motion = recording.motion
    gap = (motion.joint("left_wrist").t - motion.joint("right_wrist").t).norm(dim=-1)
    frame = torch.searchsorted(motion.timestamps, claps)
    assert gap[frame].max() < 0.13


def test_the_camera_has_its_own_clock_and_mount(simulated):
    recording = simulated.recording
    about = recording.motion.provenance
    offset, drift = float(about["camera_clock_offset_s"]), float(about["camera_clock_drift_ms_per_h"])
    assert 40 < drift < 130
    camera = recording.object_motion[HEAD_CAMERA_TRUTH]
    suit_time = (camera.timestamps - offset) / (1 + drift / 3.6e6)
    head = recording.motion.joint("head")
    inner = (suit_time >= recording.motion.timestamps[0]) & (suit_time <= recording.motion.timestamps[-1])
    at = resample(Trajectory(recording.motion.timestamps, head.R, head.t), suit_time[inner])
    mount = Rigid(at.R_world_body, at.t_world_body).inverse() @ Rigid(
        camera.R_world_body[inner], camera.t_world_body[inner]
    )
    torch.testing.assert_close(mount.R, mount.R[:1].expand_as(mount.R), atol=5e-3, rtol=0)
    assert (mount.t - mount.t.median(0).values).abs().max() < 0.005
    angle = rotation.geodesic(mount.R[0], R_DEVICE_CAM).rad2deg()
    assert 0.3 < float(angle) < 15
    assert (mount.t[0] - recording.camera.t_head_cam).norm() < 0.05


@pytest.fixture(scope="module")
def long_path():
    """Ten minutes along a circle, at 30 Hz."""
    time = torch.arange(18_000, dtype=torch.float64) / 30
    angle = (0.1 * time).float()
    R = rotation.about_axis("z", angle) @ R_DEVICE_CAM
    return Trajectory(time, R, torch.stack([8 * angle.cos(), 8 * angle.sin(), 0 * angle + 1.6], -1))


@pytest.mark.parametrize("seed", range(3))
def test_localisation_errs_as_modelled(long_path, seed):
    noise = LocalizationNoise()
    found = localize_statistically(long_path, noise, np.random.default_rng(seed))
    seen = found.confidence > 0
    off = (found.t_world_cam - long_path.t_world_body).norm(dim=-1)[seen]
    turn = rotation.geodesic(found.R_world_cam, long_path.R_world_body)[seen].rad2deg()
    assert 0.025 < float(off.median()) < 0.085
    assert 0.8 < float(turn.median()) < 2.4
    wrong = off > 0.27
    assert 0.03 < float(wrong.double().mean()) < 0.17
    assert float(off.max()) < 12
    assert 0.005 < float((~seen).double().mean()) < 0.08
    bursts = (wrong.int().diff() == 1).sum()
    assert wrong.sum() / bursts > 4, "they come in bursts"
    confidence = found.confidence[seen]
    assert confidence[~wrong].mean() > confidence[wrong].mean() + 0.25, "informative"
    assert (confidence[wrong] > 0.6).any(), "but not perfect"
    order = torch.linalg.eigvalsh(found.covariance[seen][:100])
    assert (order > 0).all()


def test_errors_last_while_the_view_does(long_path):
    still = Trajectory(
        long_path.timestamps[:300],
        long_path.R_world_body[:1].expand(300, 3, 3).clone(),
        long_path.t_world_body[:1].expand(300, 3).clone(),
    )
    noise = LocalizationNoise(outliers=(0.0, 0.0), lost=(0.0, 0.0))
    offsets = [
        localize_statistically(still, noise, np.random.default_rng(s)).t_world_cam - still.t_world_body
        for s in range(20)
    ]
    means = torch.stack([offset.mean(0) for offset in offsets])
    spread = torch.stack([offset.std(0) for offset in offsets])
    assert 0.01 < float(means.std()) < 0.06
    assert float(spread.mean()) > 0.01


def test_outages_come_where_there_is_little_to_see(long_path):
    texture = torch.zeros(18_000)
    texture[:9000] = 1.0 + torch.rand(9000, generator=torch.Generator().manual_seed(0))
    noise = LocalizationNoise(lost=(0.05, 0.05), outage_s=(1.0, 8.0))
    lost = torch.stack(
        [localize_statistically(long_path, noise, np.random.default_rng(s), texture).confidence == 0 for s in range(40)]
    )
    assert lost[:, 9000:].double().mean() > 1.3 * lost[:, :9000].double().mean()


def test_an_outage_can_be_planted(long_path):
    found = localize_statistically(long_path, LocalizationNoise(lost=(0.0, 0.0)), np.random.default_rng(0))
    with_outage = hps_outages.with_outage
    gone = with_outage(found, 100.0, 30.0)
    inside = (found.timestamps >= 100) & (found.timestamps < 130)
    assert (gone.confidence[inside] == 0).all()
    assert torch.equal(gone.t_world_cam[~inside], found.t_world_cam[~inside])
    assert inside.sum() == 900
    with pytest.raises(WearcapError, match="outage"):
        with_outage(found, 1e4, 5.0)


def test_blank_walls_show_less(simulated, site):
    path = simulated.recording.object_motion[HEAD_CAMERA_TRUTH]
    grade = view_texture(site, path, every=60)
    assert grade.min() < 0.5 * grade.max()


def test_a_seed_determines_everything_and_localisation_can_be_left_out(site):
    config = HpsConfig(protocol=replace(SHORT, returns_m=(), end_m=12.0), localization=None)
    one, two = (flatten(simulate_hps(config, "x", "val", 9, world=site).recording)[1] for _ in range(2))
    assert all(torch.equal(one[key], two[key]) for key in one)
    assert not any(key.startswith("localization") for key in one)
    with pytest.raises(WearcapError, match="Hz"):
        HpsConfig(camera_fps=0.0)


def test_confidence_tells_how_good_the_view_is_and_not_how_large_an_error_is(long_path):
    noise = LocalizationNoise(outliers=(0.0, 0.0), lost=(0.0, 0.0), map=MapErrors(bend_m=(0.0, 0.0)))
    related = []
    for seed in range(12):
        found = localize_statistically(long_path, noise, np.random.default_rng(seed))
        off = (found.t_world_cam - long_path.t_world_body).norm(dim=-1)
        related.append(np.corrcoef(found.confidence[::30], off[::30])[0, 1])
    assert -0.5 < np.mean(related) < -0.05


def test_a_map_leans_and_has_its_own_metre(simulated):
    motion = simulated.recording.motion
    errors = MapErrors(tilt_deg=(1.0, 1.0), scale=(0.005, 0.005))
    seen = by_gravity(motion, errors, np.random.default_rng(0))
    lean = rotation.geodesic(seen.R_parent_joint[:, 0], motion.R_parent_joint[:, 0]).rad2deg()
    torch.testing.assert_close(lean, torch.ones_like(lean), atol=0.05, rtol=0)
    share = seen.skeleton.stature / motion.skeleton.stature
    assert abs(share - 1) == pytest.approx(0.005, abs=1e-4)
    reach = [(m.t_world_root - m.t_world_root[0]).norm(dim=-1).max() for m in (seen, motion)]
    assert float(reach[0] / reach[1]) == pytest.approx(share, rel=1e-3)


def test_presets_of_localisation_by_name(long_path):
    off = [
        (
            localize_statistically(long_path, LocalizationNoise.preset(name), np.random.default_rng(0)).t_world_cam
            - long_path.t_world_body
        )
        .norm(dim=-1)
        .median()
        for name in ("ideal", "typical", "poor")
    ]
    assert off == sorted(off)
    with pytest.raises(WearcapError, match="ideal, typical, poor"):
        LocalizationNoise.preset("perfect")


def test_claps_are_heard_among_steps_and_voices():
    claps = [3.2, 3.9, 5.1, 40.0]
    sound = sound_track(60.0, claps, np.random.default_rng(0), np.arange(6.0, 38.0, 0.55).tolist())
    heard = detect_claps_audio(torch.from_numpy(sound), SOUND_HZ)
    nearest = (torch.tensor(claps, dtype=torch.float64)[:, None] - heard).abs().amin(1)
    assert (nearest < 0.01).sum() >= 3
    assert len(heard) <= 8
