"""A wearer's own logs become recordings: trajectories, two watches with a camera, headsets."""

import json

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import short_walk
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.devices.aria_mps import read_mps
from wearcap.recording import RecordingStore

G = 9.80665
UP = {
    "z": np.eye(3),
    "y": Rotation.from_euler("x", -90, degrees=True).as_matrix(),
    "-y": Rotation.from_euler("x", 90, degrees=True).as_matrix(),
}
"""Rotations of a world with z up into one with another axis up."""
NAMES = {
    "time": "time",
    "head": "head_{quantity}_{axis}",
    "left": "left_hand_{quantity}_{axis}",
    "right": "right_hand_{quantity}_{axis}",
}


def prepare(source: str, folder, *more: str) -> int:
    return short_walk.exit_code("prepare", [source, f"output={folder}/out", "jobs=1", *more])


def only(folder):
    store = RecordingStore.open(folder / "out")
    return store.load(store.names()[0])


def head_of(recording) -> Trajectory:
    return Trajectory(recording.head.timestamps, recording.head.R_world_device, recording.head.t_world_device)


def same_but_heading(recording, time, R, t) -> None:
    """Up to the heading and origin of the world, which formats leave open: 1 mm and 0.1°."""
    found = head_of(recording)
    turn = torch.from_numpy(R[0]) @ found.R_world_body[0].double().mT
    yaw = float(torch.atan2(turn[1, 0], turn[0, 0]))
    Z = Rotation.from_euler("z", yaw).as_matrix()
    moved = Trajectory(
        found.timestamps,
        torch.from_numpy(Z) @ found.R_world_body.double(),
        (found.t_world_body.double() - found.t_world_body[0].double()) @ torch.from_numpy(Z).mT
        + torch.from_numpy(t[0]),
    )
    late, off, turned = short_walk.apart(moved, time, R, t)
    assert late < 1e-4
    assert off < 1e-3
    assert turned < 0.1


@pytest.mark.parametrize("up", UP)
@pytest.mark.parametrize("axes", ["head", "camera", "openxr"])
def test_any_axes_give_the_same_head(tmp_path, up, axes):
    """The world's up axis and the device's own axes are detected in a file that names neither."""
    time, R, t = short_walk.walk()
    device = {"head": np.eye(3), "camera": short_walk.CAMERA_IN_HEAD, "openxr": short_walk._DEVICE}[axes]
    short_walk.tum(tmp_path / "walk.txt", time, UP[up] @ R @ device, t @ UP[up].T)
    assert prepare("trajectory", tmp_path, f"source={tmp_path}/walk.txt", "height=1.68") == 0
    recording = only(tmp_path)
    same_but_heading(recording, time, R, t)
    assert recording.skeleton.stature == pytest.approx(1.68, abs=1e-3)
    assert f"{up} is up" in recording.note
    assert f"the device has {axes}'s axes" in recording.note


def test_structure_from_motion_with_floor_video_and_points(tmp_path, capsys):
    """COLMAP's unit is unknown: it is asked for, or found by the floor and the camera's height; the points come along."""
    time, R, t = short_walk.walk(seconds=20)
    tilt = Rotation.from_euler("xyz", [25, -15, 80], degrees=True).as_matrix()
    R_cam, t_cam = tilt @ R @ short_walk.CAMERA_IN_HEAD, (t @ tilt.T) / 0.31
    (tmp_path / "walk").mkdir()
    short_walk.colmap_text(tmp_path / "walk/images.txt", time, R_cam, t_cam)
    assert prepare("trajectory", tmp_path, f"source={tmp_path}/walk") == 1
    assert "the unit of length of the camera's SLAM stays unknown" in capsys.readouterr().err
    random = np.random.default_rng(0)
    floor = np.concatenate(
        [t[::2, :2] + random.normal(0, 0.8, (len(t[::2]), 2)), random.normal(0, 0.005, (len(t[::2]), 1))], 1
    )
    floor = np.concatenate([floor, floor + np.array([0.05, 0.02, 0.0])])
    cloud = "\n".join(",".join(f"{value:.6f}" for value in point) for point in (floor @ tilt.T) / 0.31)
    (tmp_path / "cloud.csv").write_text(f"x,y,z\n{cloud}\n")
    given = [f"points={tmp_path}/cloud.csv", "standing=[0,3]", f"camera_height_m={t[:90, 2].mean():.4f}"]
    assert prepare("trajectory", tmp_path, f"source={tmp_path}/walk", *given) == 0
    recording = only(tmp_path)
    assert recording.points.points_world[:, 2].abs().median() < 0.02
    height = head_of(recording).t_world_body[:, 2].double().numpy()
    assert np.abs(height - t[:, 2]).max() < 0.05
    length = head_of(recording).t_world_body.diff(dim=0).norm(dim=1).sum().item()
    assert length == pytest.approx(np.linalg.norm(np.diff(t, axis=0), axis=1).sum(), rel=0.02)
    assert "vertical by the floor" in recording.note


def test_outliers_are_removed_and_said(tmp_path, capsys):
    time, R, t = short_walk.walk()
    bad = t.copy()
    bad[100:103] += 4
    short_walk.tum(tmp_path / "walk.txt", time, R, bad)
    assert prepare("trajectory", tmp_path, f"source={tmp_path}/walk.txt") == 0
    assert "3 outliers of 240 camera poses removed" in capsys.readouterr().out
    assert np.abs(head_of(only(tmp_path)).t_world_body.numpy() - t).max() < 0.05


def test_a_folder_of_trajectories_is_a_recording_each(tmp_path):
    time, R, t = short_walk.walk()
    (tmp_path / "in").mkdir()
    for name, write in (("a.txt", short_walk.tum), ("b.csv", short_walk.euroc), ("c.txt", short_walk.kitti)):
        write(tmp_path / "in" / name, time, R @ short_walk.CAMERA_IN_HEAD, t)
    (tmp_path / "in/readme.txt").write_text("nothing")
    assert prepare("trajectory", tmp_path, f"source={tmp_path}/in") == 0
    store = RecordingStore.open(tmp_path / "out")
    assert store.names() == ["a", "b", "c"]
    for name in store.names():
        same_but_heading(store.load(name), time, R, t)


@pytest.mark.parametrize("convention", ["unity", "openxr"])
@pytest.mark.parametrize("kind", ["grip", "wrist"])
def test_a_headset_has_head_hands_and_floor(tmp_path, capsys, convention, kind):
    time, R, t = short_walk.walk()
    poses = short_walk.headset_poses(time, R, t, convention, kind)
    short_walk.headset_csv(tmp_path / "quest.csv", time, poses, NAMES)
    assert prepare("headset", tmp_path, f"source={tmp_path}/quest.csv", "height=1.74", f"hands={kind}") == 0
    assert f"axes {convention}" in capsys.readouterr().out
    recording = only(tmp_path)
    same_but_heading(recording, time, R, t)
    for side, pose in short_walk.wrists(time, R, t).items():
        late, off, turned = short_walk.apart(recording.tracked[f"{side}_wrist"], time, *pose)
        assert (late, off, turned) < (1e-3, 1e-3, 0.1)
        assert off < 1e-3
        assert turned < 0.1
    assert recording.floor.height.tolist() == [0.0]
    assert short_walk.exit_code("doctor", [f"{tmp_path}/out", "for=echo", "--quiet"]) == 0


def sensor_logger(path, time, R, seed: int) -> None:
    """Sensor Logger's WristMotion.csv: nanoseconds, g, Core Motion's signs."""
    free = np.random.default_rng(seed).normal(0, 0.5, (len(time), 3)) / G
    gravity = -np.swapaxes(R, 1, 2) @ np.array([0.0, 0.0, 1.0])
    names = [f"{name}{axis}" for name in ("rotationRate", "gravity", "acceleration") for axis in "XYZ"]
    names += [f"quaternion{axis}" for axis in "WXYZ"]
    nano = np.round(time * 1e9).astype(np.int64)
    rows = short_walk.numbers(nano, 0 * gravity, gravity, free, short_walk.quat_xyzw(R)[:, [3, 0, 1, 2]])
    short_walk.lines(path, rows, ",".join(["time", *names]) + "\n", ",")


def test_two_watches_and_a_camera(tmp_path, capsys):
    time, R, t = short_walk.walk(start=1.7e9)
    short_walk.euroc(tmp_path / "camera.csv", time, R @ short_walk.CAMERA_IN_HEAD, t)
    for seed, (side, (R_wrist, _)) in enumerate(short_walk.wrists(time, R, t).items()):
        cut = slice(None) if side == "left" else np.r_[0:100, 130:240]  # a second of silence
        sensor_logger(tmp_path / f"{side}.csv", time[cut], R_wrist[cut], seed)
    logs = [f"left={tmp_path}/left.csv", f"right={tmp_path}/right.csv", f"camera={tmp_path}/camera.csv", "height=1.7"]
    assert prepare("watches", tmp_path, *logs) == 0
    printed = capsys.readouterr().out
    assert "watches not calibrated" in printed
    assert "right_wrist is silent, or its clock jumps, 1 times for 1.0" in printed
    recording = only(tmp_path)
    assert set(recording.imu) == {"left_wrist", "right_wrist"}
    same_but_heading(recording, time, R, t)
    assert short_walk.exit_code("doctor", [f"{tmp_path}/out", "for=mocap_every", "--quiet"]) == 0
    # Logs of another day: both spans are named.
    short_walk.euroc(tmp_path / "camera.csv", time + 86400, R @ short_walk.CAMERA_IN_HEAD, t)
    assert prepare("watches", tmp_path, *logs) == 1
    wrong = capsys.readouterr().err
    assert "left_wrist from 1700000000.00 to" in wrong
    assert "camera from 1700086400.00 to" in wrong


def test_what_is_missing_is_said(tmp_path, capsys):
    for arguments, message in (
        (["trajectory", f"source={tmp_path}/none.txt"], "no such file or folder"),
        (["trajectory", f"source={tmp_path}"], "no trajectory in this folder"),
        (["headset", f"source={tmp_path}"], "no headset's log in this folder"),
        (["watches", "left=a.csv", "right=b.csv", "camera=c.csv"], "no such file"),
    ):
        assert short_walk.exit_code("prepare", [*arguments, f"output={tmp_path}/out", "jobs=1"]) == 2
        assert message in capsys.readouterr().err
    (tmp_path / "a.json").write_text(json.dumps({"x": 1}))
    assert prepare("headset", tmp_path, f"source={tmp_path}/a.json") == 1


@pytest.mark.real
def test_a_real_aria_trajectory_as_a_file(real_data, tmp_path):
    """MPS' closed-loop file by itself gives the head stream of its folder."""
    source = real_data / "aria_mps/closed_loop_trajectory.csv.xz"
    assert prepare("trajectory", tmp_path, f"source={source}", "height=1.7") == 0
    recording = only(tmp_path)
    assert recording.note.startswith("MPS, times in us; z is up")
    folder = read_mps(real_data / "aria_mps").head
    torch.testing.assert_close(recording.head.t_world_device, folder.t_world_device, atol=1e-3, rtol=0)
    torch.testing.assert_close(recording.head.R_world_device, folder.R_world_device, atol=1e-3, rtol=0)
