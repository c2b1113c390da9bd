"""MocapEvery's capture folder: what is read, how the board makes a world of it, and hostile files."""

import os
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from mocap_every_files import BOARD_M, FIX, SCALE, SHUTTER_S, cloud, truth, world_of, write_capture

from data_prep.mocap_every_folder import (
    is_mocap_every_folder,
    mocap_every_files,
    mocap_every_recording,
    read_mocap_every_folder,
)
from hostile import fuzz, mutated, mutated_bytes
from wearcap.errors import WearcapError
from wearcap.geometry import rotation


def test_everything_is_read(tmp_path):
    write_capture(tmp_path)
    read = read_mocap_every_folder(tmp_path)
    assert is_mocap_every_folder(tmp_path)
    assert len(mocap_every_files(tmp_path)) == 9
    assert read.name == tmp_path.name
    assert read.T_slam_cam.timestamps[[0, 30]].tolist() == [SHUTTER_S, SHUTTER_S + 1.0]
    _, R = truth()
    expected = torch.from_numpy((FIX * R).as_matrix()).float()
    assert rotation.geodesic(read.T_slam_cam.R_world_body, expected).max() < 1e-5
    assert (read.camera.width, read.camera.height, read.camera.fx) == (584, 328, 300.5)
    assert (read.lens.width, read.lens.model, read.lens.distortion) == (320, "opencv", (-0.1, 0.02, 0.001, 0.002))
    assert read.video == tmp_path / "video/ego_video.MP4"
    assert list(read.imu) == ["left_wrist", "right_wrist"]
    assert read.imu["right_wrist"].joint == "right_wrist"
    assert read.board.length_m == BOARD_M


def test_the_board_gives_scale_and_axes(tmp_path):
    write_capture(tmp_path)
    read = read_mocap_every_folder(tmp_path)
    scale, T_world_slam = read.board.align()
    assert scale == pytest.approx(SCALE, rel=1e-5)
    recording = mocap_every_recording(read, scale, T_world_slam)
    t, R = truth()
    assert (recording.head.t_world_device - world_of(t)).norm(dim=-1).max() < 1e-4
    ahead = torch.from_numpy(R.as_matrix()[:, :, 2]).float()
    assert (recording.head.R_world_device[:, :, 0] - ahead).norm(dim=-1).max() < 1e-4
    assert recording.head.R_world_device[:, 2, 2].min() > 0.9999  # level: the device's z is up
    assert (recording.points.points_world - world_of(cloud())).norm(dim=-1).max() < 1e-4
    T_world_head = recording.head.T_world_head
    below = recording.head.t_world_device - T_world_head.t
    assert below[:, 2].tolist() == pytest.approx([0.12] * len(below), abs=1e-4)
    assert recording.camera.video == str((tmp_path / "video/ego_video.MP4").resolve())
    assert len(recording.camera.timestamps) == 12


def test_without_an_alignment_the_world_is_slams_own(tmp_path):
    write_capture(tmp_path)
    read = read_mocap_every_folder(tmp_path)
    recording = mocap_every_recording(read)
    assert torch.equal(recording.head.t_world_device, read.T_slam_cam.t_world_body)
    assert torch.equal(recording.points.points_world, read.points_slam)


def test_only_the_trajectory_must_be_there(tmp_path):
    write_capture(tmp_path)
    for path in mocap_every_files(tmp_path):
        if path.name != "cam_traj.pkl":
            path.unlink()
    read = read_mocap_every_folder(tmp_path)
    assert (read.camera, read.lens, read.points_slam, read.video, read.board, read.imu) == (
        None,
        None,
        None,
        None,
        None,
        {},
    )
    assert read.T_slam_cam.timestamps[0] == 0
    recording = mocap_every_recording(read)
    assert recording.camera is None
    assert recording.points is None
    with pytest.raises(WearcapError, match="no such file"):
        read_mocap_every_folder(tmp_path / "sfm")


def test_without_the_video_the_principal_point_gives_the_size(tmp_path):
    write_capture(tmp_path, leave_out=("video/ego_video.MP4",))
    read = read_mocap_every_folder(tmp_path)
    assert (read.camera.width, read.camera.height, read.lens) == (584, 320, None)
    assert mocap_every_recording(read).camera.camera == read.camera


class Evil:
    def __reduce__(self):
        return os.system, ("touch evil",)


POSES = np.tile([0.0, 0, 0, 0, 0, 0, 1], (90, 1))
FAULTS = {
    "code": ("cam_traj.pkl", pickle.dumps(Evil()), "system"),
    "code in marks": ("camera_calib.pkl", pickle.dumps({"x": Evil()}), "system"),
    "columns": ("cam_traj.pkl", pickle.dumps(POSES[:, :6]), r"'poses' has shape \(90, 6\)"),
    "no array": ("cam_traj.pkl", pickle.dumps({"a": 1}), "'poses' has shape|no array of numbers"),
    "no poses": ("cam_traj.pkl", pickle.dumps(POSES[:0]), "no poses"),
    "nan": ("cam_traj.pkl", pickle.dumps(POSES * np.nan), "NaN"),
    "no quaternion": ("cam_traj.pkl", pickle.dumps(np.ones((9, 7))), "norm 2.0000"),
    "text": ("cam_traj.pkl", b"0 0 0 0 0 0 1", "pickle"),
    "marks": ("camera_calib.pkl", pickle.dumps([1, 2]), "dict of times"),
    "shutter": ("camera_calib.pkl", pickle.dumps({"shutter": "noon"}), "shutter's time is"),
    "x": ("camera_calib.pkl", pickle.dumps({"shutter": 0, "x": [1], "y": [1, 2]}), "2 finite numbers"),
    "x elsewhere": ("camera_calib.pkl", pickle.dumps({"shutter": 0, "x": [1, 2], "y": [1, 99]}), "y at"),
    "yaml": ("config.yaml", b"a: [", "not readable YAML"),
    "yaml with code": ("config.yaml", b"a: !!python/object/apply:os.system [ls]", "not readable YAML"),
    "yaml of references": ("config.yaml", b"a: &a [1, 1]\nb: [*a, *a]", "refers to its own parts"),
    "yaml nested deeply": ("config.yaml", b"[" * 60_000, "nested too deeply"),
    "yaml of a megabyte": ("config.yaml", b"a: 1\n" * 200_000, "larger than 64 KiB"),
    "yaml list": ("config.yaml", b"- 1", "keys with values"),
    "no height": ("config.yaml", b"cam_scale_origin: {dist: [1, 1]}", "lacks a number"),
    "one distance": ("config.yaml", b"cam_scale_origin: {dist: [1], height: 1}", "2 finite numbers"),
    "distance 0": ("config.yaml", b"cam_scale_origin: {dist: [0, 1], height: 1}", "metres above 0"),
    "intrinsics": ("sfm/undistort_calib.txt", b"300 300", "2 numbers"),
    "intrinsics of words": ("sfm/undistort_calib.txt", b"a b c d", "not a list of numbers"),
    "other intrinsics": ("sfm/undistort_calib.txt", b"900 900 960 540", "near the middle of 584x328"),
    "lens": ("sfm/calib.txt", b"1 2 3 4 5", "4 or 8 or 9"),
    "cloud": ("sfm/pointcloud/pcd_results.ply", b"ply\n", "pcd_results.ply"),
    "log": ("watch_sensorlog_1.csv", b"a,b\n1,2\n", "not a watch's motion log"),
    "video": ("video/ego_video.MP4", b"none", "not a readable video"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_hostile_file_is_named(tmp_path, fault, monkeypatch):
    monkeypatch.chdir(tmp_path)
    name, content, message = FAULTS[fault]
    write_capture(tmp_path)
    (tmp_path / name).write_bytes(content)
    with pytest.raises(WearcapError, match=message) as caught:
        read_mocap_every_folder(tmp_path)
    assert Path(name).name in str(caught.value) or "shutter" in fault
    assert not (tmp_path / "evil").exists()


def test_quaternions_with_the_scalar_first_are_refused(tmp_path):
    write_capture(tmp_path, order="wxyz")
    with pytest.raises(WearcapError, match="scalar first"):
        read_mocap_every_folder(tmp_path)


def test_a_board_without_a_right_angle_is_refused(tmp_path):
    write_capture(tmp_path)
    board = read_mocap_every_folder(tmp_path).board
    with pytest.raises(WearcapError, match="not at a right angle"):
        replace(board, y_slam=board.x_slam).align()


@fuzz
@given(data=st.data())
def test_damaged_files_are_read_or_refused(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("capture")
    write_capture(
        folder, leave_out=("video/ego_video.MP4", "watch_sensorlog_1.csv", "watch_sensorlog_2.csv"), seconds=4.0
    )
    path = folder / data.draw(
        st.sampled_from(["cam_traj.pkl", "camera_calib.pkl", "config.yaml", "sfm/undistort_calib.txt"])
    )
    content = path.read_bytes()
    if path.suffix == ".pkl":
        path.write_bytes(data.draw(mutated_bytes(content)))
    else:
        path.write_text(data.draw(mutated(content.decode())))
    try:
        read = read_mocap_every_folder(folder)
        recording = mocap_every_recording(read, *(read.board.align() if read.board else ()))
    except WearcapError:
        return
    assert recording.head.R_world_device.isfinite().all()
