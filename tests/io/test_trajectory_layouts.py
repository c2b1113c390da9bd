"""Trajectories in the layouts of public systems and recorders, written by NumPy and SciPy alone."""

import json

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import short_walk
from short_walk import CAMERA_IN_HEAD, lines, numbers, quat_xyzw
from wearcap.errors import WearcapError
from wearcap.io.devices.axes import device_axes
from wearcap.io.formats.trajectory import read_trajectory, read_trajectory_file, trajectory_file, trajectory_format
from wearcap.prepare.logs import Evidence, TrajectorySettings, head_of, origin_of, read_cloud

Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Turns a world with z up into one with y up."""
OPENGL = np.diag([1.0, -1.0, -1.0])
IMU_IN_HEAD = Rotation.from_euler("zyx", [20, -70, 110], degrees=True).as_matrix()
TURNED_CAMERA = CAMERA_IN_HEAD @ OPENGL


def nano(time) -> np.ndarray:
    return np.round(time * 1e9).astype(np.int64)


def wxyz(R) -> np.ndarray:
    return quat_xyzw(R)[:, [3, 0, 1, 2]]


def relative(time, R, t):
    """Poses in the first camera's axes, as a SLAM without gravity has them."""
    return time, R[0].T @ R, (t - t[0]) @ R[0]


def orb_slam3_euroc(path, time, R, t):
    rows = [[f"{stamp}.000000000", *row] for stamp, row in zip(nano(time).tolist(), numbers(t, quat_xyzw(R)))]
    return lines(path, rows)


def openvins_pose(path, time, R, t):
    covariance = np.tile(np.eye(3).ravel() * 1e-4, (len(time), 2))
    names = " ".join(f"{part}{i}{j}" for part in ("Pr", "Pt") for i in (1, 2, 3) for j in (1, 2, 3))
    return lines(path, numbers(time, t, quat_xyzw(R), covariance), f"# timestamp(s) tx ty tz qx qy qz qw {names}\n")


def openvins_state(path, time, R, t):
    """JPL's quaternion of the world in the body, C(q) = (2 q4² - 1) I - 2 q4 [q]x + 2 q qᵀ, before the place."""
    C = np.swapaxes(R, 1, 2)
    q4 = 0.5 * np.sqrt(1 + np.trace(C, axis1=1, axis2=2))
    q = np.stack([C[:, 1, 2] - C[:, 2, 1], C[:, 2, 0] - C[:, 0, 2], C[:, 0, 1] - C[:, 1, 0]], 1) / (4 * q4[:, None])
    zero = np.zeros((len(time), 9))
    head = "# timestamp(s) q p v bg ba cam_imu_dt num_cam cam0_k cam0_d cam0_rot cam0_trans .... etc\n"
    return lines(path, numbers(time, q, q4, t, zero), head)


def kimera(path, time, R, t):
    head = "#timestamp,x,y,z,qw,qx,qy,qz,vx,vy,vz,bgx,bgy,bgz,bax,bay,baz\n"
    return lines(path, numbers(nano(time), t, wxyz(R), np.zeros((len(time), 9))), head, ",")


def vins(path, time, R, t):
    return lines(path, [[*row, ""] for row in numbers(nano(time), t, wxyz(R), 0 * t)], "", ",")


def arkit_matrices(path, time, R, t):
    poses = np.tile(np.eye(4), (len(time), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = R, t
    return lines(path, numbers(time, poses.swapaxes(1, 2).reshape(-1, 16)), "", ",")


def matrices_with_time(path, time, R, t):
    return lines(path, numbers(time, np.concatenate([R, t[:, :, None]], 2).reshape(-1, 12)), "", ",")


def whole_matrices(path, time, R, t):
    poses = np.tile(np.eye(4), (len(time), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = R, t
    lines(path.with_name("times.txt"), numbers(time))
    return lines(path, numbers(poses.reshape(-1, 16)))


def ios_logger(path, time, R, t):
    return lines(path, numbers(time, t, wxyz(R)), "", ",")


def arcore(path, time, R, t):
    return lines(path, numbers(nano(time), quat_xyzw(R), t))


def nerf(path, time, R, t):
    """Camera to world with OpenGL's axes, pictures named by their times, in any order."""
    frames = []
    for k in np.random.default_rng(1).permutation(len(time)):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = R[k] @ OPENGL, t[k]
        frames.append({"file_path": f"./images/{time[k]:.6f}.jpg", "transform_matrix": pose.tolist()})
    path.write_text(json.dumps({"fl_x": 500.0, "w": 640, "h": 480, "frames": frames}))
    return path


def record3d(path, time, R, t):
    poses = np.concatenate([quat_xyzw(R @ OPENGL), t], 1).tolist()
    path.write_text(json.dumps({"K": [1.0] * 9, "fps": 30, "poses": poses, "frameTimestamps": time.tolist()}))
    return path


def rtabmap(path, time, R, t):
    rows = [[*row, str(k + 1)] for k, row in enumerate(numbers(time, t, quat_xyzw(R)))]
    return lines(path, rows, "#timestamp x y z qx qy qz qw id\n")


def t265(path, time, R, t):
    head = "timestamp_ms,tx,ty,tz,qx,qy,qz,qw,vx,vy,vz,tracker_confidence,mapper_confidence\n"
    return lines(path, [[*row, "3", "2"] for row in numbers(time * 1e3, t, quat_xyzw(R), 0 * t)], head, ",")


def ros_odometry(path, time, R, t):
    nested = [f"position.{axis}" for axis in "xyz"] + [f"orientation.{axis}" for axis in "xyzw"]
    head = ["%time", "field.header.seq", "field.header.stamp", "field.header.frame_id", "field.child_frame_id"]
    head += [f"field.pose.pose.{name}" for name in nested] + [f"field.pose.covariance{k}" for k in range(2)]
    head += ["field.twist.twist.linear.x"]
    stamps = nano(time).tolist()
    rows = [
        [str(stamp), str(k), str(stamp), "odom", "base_link", *row, "0.0", "0.0", "0.0"]
        for k, (stamp, row) in enumerate(zip(stamps, numbers(t, quat_xyzw(R))))
    ]
    return lines(path, rows, ",".join(head) + "\n", ",")


LAYOUTS = {
    "ORB-SLAM3, EuRoC": ("CameraTrajectory.txt", orb_slam3_euroc, CAMERA_IN_HEAD),
    "OpenVINS, poses": ("state_estimate.txt", openvins_pose, IMU_IN_HEAD),
    "OpenVINS, states": ("state_estimate.txt", openvins_state, IMU_IN_HEAD),
    "Kimera": ("traj_vio.csv", kimera, IMU_IN_HEAD),
    "VINS": ("vio.csv", vins, IMU_IN_HEAD),
    "ARKit, matrices": ("poses.csv", arkit_matrices, TURNED_CAMERA),
    "KITTI with times": ("poses.csv", matrices_with_time, CAMERA_IN_HEAD),
    "4×4 by row": ("poses.txt", whole_matrices, CAMERA_IN_HEAD),
    "ios_logger": ("ARposes.txt", ios_logger, TURNED_CAMERA),
    "ARCore": ("ARCore_sensor_pose.txt", arcore, TURNED_CAMERA),
    "NeRF": ("transforms.json", nerf, CAMERA_IN_HEAD),
    "Record3D": ("metadata.json", record3d, CAMERA_IN_HEAD),
    "RTAB-Map": ("poses.txt", rtabmap, np.eye(3)),
    "T265": ("t265.csv", t265, TURNED_CAMERA),
    "ROS odometry": ("odom.csv", ros_odometry, np.eye(3)),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_walk_comes_back_from_every_layout(tmp_path, layout):
    name, write, R_head_device = LAYOUTS[layout]
    time, R, t = short_walk.walk()
    path = write(tmp_path / name, time, R @ R_head_device, t)
    assert trajectory_format(path) is not None
    late, off, turned = short_walk.apart(read_trajectory(path), time, R @ R_head_device, t)
    assert (late < 1e-4, off < 1e-5, turned < 0.1) == (True, True, True)


@pytest.mark.parametrize(
    ("layout", "world"),
    [
        ("ARKit, matrices", Y_UP),
        ("ios_logger", Y_UP),
        ("ARCore", Y_UP),
        ("NeRF", np.eye(3)),
        ("Record3D", Y_UP),
        ("T265", Y_UP),
        ("ROS odometry", np.eye(3)),
    ],
)
def test_a_walk_of_every_layout_is_a_head_that_walks(tmp_path, layout, world):
    name, write, R_head_device = LAYOUTS[layout]
    time, R, t = short_walk.walk()
    path = write(tmp_path / name, time, world @ R @ R_head_device, t @ world.T)
    head = head_of(read_trajectory_file(path), TrajectorySettings(unit=1.0 if layout == "NeRF" else "auto"), "")[0]
    R_found, t_found = head.R_world_device.double().numpy(), head.t_world_device.double().numpy()
    turn = R[0] @ R_found[0].T
    assert abs(turn[2, 2] - 1) < 1e-6, "the vertical is the vertical"
    assert np.abs(turn @ R_found - R).max() < 1e-3
    assert np.abs((t_found - t_found[0]) @ turn.T - (t - t[0])).max() < 1e-3


# --- axes that a path does not show ----------------------------------------------------------------------------------


def standing(device: np.ndarray):
    """A wearer who stands and looks around: times, rotations of a device of given axes, places (m)."""
    time = np.arange(240) / 30
    angles = np.stack([0.2 * np.sin(1.3 * time), 0.1 * np.sin(2 * time), 0.05 * np.sin(0.7 * time)], 1)
    R = Rotation.from_euler("ZYX", angles).as_matrix()
    return 100 + time, R @ device, 0.1 * R[:, :, 0]


@pytest.mark.parametrize(
    ("write", "device", "world", "expected"),
    [
        (short_walk.tum, CAMERA_IN_HEAD, None, ("-y", "camera")),
        (short_walk.kitti, CAMERA_IN_HEAD, None, ("-y", "camera")),
        (t265, TURNED_CAMERA, Y_UP, ("y", "openxr")),
        (arkit_matrices, TURNED_CAMERA, Y_UP, ("y", "openxr")),
        (ros_odometry, np.eye(3), np.eye(3), ("z", "head")),
    ],
)
def test_a_standing_wearer_has_the_format_s_usual_axes(tmp_path, write, device, world, expected):
    time, R, t = standing(device)
    time, R, t = relative(time, R, t) if world is None else (time, world @ R, t @ world.T)
    read = read_trajectory_file(write(tmp_path / "path.csv", time, R, t))
    found = device_axes(read.trajectory, device="camera" if read.of_camera else "auto", usual=read.usual)
    assert (found.up, found.device) == expected


def test_axes_that_nothing_decides_are_asked_for(tmp_path):
    """A world that is not the first camera's and a format without usual axes: no guess, and either answer is taken."""
    time, R, t = standing(CAMERA_IN_HEAD)
    down = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # y down, z ahead
    read = read_trajectory_file(kimera(tmp_path / "a.csv", time, down @ R, t @ down.T))
    with pytest.raises(WearcapError, match=r"fit alike.*up=y axes=openxr or up=-y axes=camera or up=z axes=head"):
        head_of(read, TrajectorySettings(), "a.csv")
    head = head_of(read, TrajectorySettings(up="-y", axes="camera"), "a.csv")[0]
    assert head.R_world_device[:, 2, 2].min() > 0.9


@pytest.mark.parametrize("up", ["x", "-x", "-z", "y"])
def test_any_axis_may_be_stated_to_be_up(tmp_path, up):
    time, R, t = short_walk.walk()
    vertical = np.eye(3)["xyz".index(up[-1])] * (-1 if up[0] == "-" else 1)
    turn = Rotation.align_vectors(vertical[None], np.array([[0.0, 0.0, 1.0]]))[0].as_matrix()
    path = short_walk.tum(tmp_path / "a.txt", time, turn @ R @ CAMERA_IN_HEAD, t @ turn.T * 100)
    head = head_of(read_trajectory_file(path), TrajectorySettings(up=up, unit="cm"), "a.txt")[0]
    assert np.abs(head.t_world_device[:, 2].double().numpy() - t[:, 2]).max() < 1e-5
    assert np.abs(head.R_world_device[:, 2].double().numpy() - R[:, 2]).max() < 1e-5


@pytest.mark.real
def test_a_standing_first_camera_of_a_user_is_upright(real_data):
    read = read_trajectory_file(real_data / "field/B_first_camera_standing.txt")
    head, _, note = head_of(read, TrajectorySettings(), "B")
    assert "-y is up, as level as its first camera was held" in note
    assert "usually" in note
    given = np.loadtxt(real_data / "field/B_first_camera_standing.txt")
    assert np.abs(head.t_world_device[:, 2].numpy() + given[:, 2]).max() < 1e-5


# --- rows, maps, what is refused -------------------------------------------------------------------------------------


def test_lost_tracking_is_left_out_whatever_marks_it(tmp_path):
    time, R, t = short_walk.walk()
    rows = numbers(time, t, quat_xyzw(R))
    for k in range(20, 26):
        rows[k][1:] = [""] * 7
    table = [[*row, "lost" if 40 <= k < 45 else "ok"] for k, row in enumerate(rows)]
    head = "timestamp,tx,ty,tz,qx,qy,qz,qw,tracking_state\n"
    found = read_trajectory_file(lines(tmp_path / "a.csv", table, head, ","))
    kept = np.r_[0:20, 26:40, 45 : len(time)]
    assert max(short_walk.apart(found.trajectory, time[kept], R[kept], t[kept])[:2]) < 1e-4
    assert found.notes[0].startswith("11 rows without a pose")


def test_two_recordings_in_one_file_are_not_mixed(tmp_path):
    time, R, t = short_walk.walk()
    path = short_walk.tum(
        tmp_path / "a.txt",
        np.concatenate([time, time + 0.01]),
        np.concatenate([R, R]),
        np.concatenate([t, t + np.array([3.0, 1.0, 0.0])]),
    )
    with pytest.raises(WearcapError, match=r"line 241: times go back by .*cut it there"):
        read_trajectory(path)


@pytest.mark.parametrize("kind", ["csv", "ply", "pcd"])
def test_points_share_the_trajectory_s_map(tmp_path, kind):
    """Also outliers at zero leave the origin where the map is; clouds are double until it is taken off."""
    time, R, t = short_walk.walk()
    offset = np.array([458074.6, 5429380.17, 162.9])
    far = t + offset
    far[7] = 0  # tracking that begins anew
    read = read_trajectory_file(short_walk.tum(tmp_path / "t.txt", time, R, far))
    points = np.random.default_rng(0).uniform(-5, 5, (50, 3))
    text = "\n".join(" ".join(f"{value:.6f}" for value in point) for point in points + offset)
    heads = {
        "csv": "x,y,z\n",
        "ply": "ply\nformat ascii 1.0\nelement vertex 50\n" + "".join(f"property double {a}\n" for a in "xyz"),
        "pcd": "VERSION .7\nFIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 50\nHEIGHT 1\nPOINTS 50\nDATA ascii\n",
    }
    path = tmp_path / f"cloud.{kind}"
    end = "end_header\n" if kind == "ply" else ""
    path.write_text(heads[kind] + end + (text.replace(" ", ",") if kind == "csv" else text) + "\n")
    found = read_cloud(path, read.origin).points_world.double().numpy()
    assert np.abs(found + read.origin - points - offset).max() < 1e-5


def test_the_origin_brings_places_back_to_the_map(tmp_path):
    time, R, t = short_walk.walk()
    offset = np.array([458074.6, 162.9, -5429380.17])  # y up
    path = short_walk.tum(tmp_path / "t.txt", time, Y_UP @ R @ CAMERA_IN_HEAD, t @ Y_UP.T + offset)
    read = read_trajectory_file(path)
    settings = TrajectorySettings(evidence=Evidence(camera_height_m=1.62))
    head, alignment, _ = head_of(read, settings, "t")
    origin = origin_of(read, alignment)
    assert origin is not None
    assert origin.dtype == torch.float64
    back = head.t_world_device.double() + origin
    assert np.abs(back.numpy() - t - offset @ Y_UP).max() < 1e-4


def test_folders_of_models_are_trajectories_or_said_to_lack_poses(tmp_path):
    time, R, t = short_walk.walk()
    (tmp_path / "nerf/images").mkdir(parents=True)
    nerf(tmp_path / "nerf/transforms.json", time, R @ CAMERA_IN_HEAD, t)
    assert trajectory_file(tmp_path / "nerf") == tmp_path / "nerf/transforms.json"
    (tmp_path / "model/sparse").mkdir(parents=True)
    short_walk.colmap_text(tmp_path / "model/sparse/images.txt", time, R @ CAMERA_IN_HEAD, t)
    assert short_walk.apart(read_trajectory(tmp_path / "model"), time, R @ CAMERA_IN_HEAD, t)[1] < 1e-3
    (tmp_path / "other").mkdir()
    (tmp_path / "other/metadata.json").write_text('{"scene": "Apartment"}')
    assert trajectory_file(tmp_path / "other") is None


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"frames": [{"file_path": "a_1.png"}]}, "no poses of cameras"),
        ({"frames": [{"file_path": "a_1.png", "transform_matrix": np.ones((4, 4)).tolist()}]}, "no rotation"),
        ({"frames": [{"file_path": "a_1.png", "transform_matrix": [[1, 2], [3]]}]}, "no poses of cameras"),
        ({"poses": [[0, 0, 0, 1, 0, 0, 0]], "fps": 0}, "no poses of cameras"),
        ({"poses": [[0, 0, 0, 0, 0, 0, 0]], "fps": 30}, "no poses of cameras"),
        ({"frames": []}, "no poses"),
    ],
)
def test_damaged_transforms_are_refused(tmp_path, content, message):
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(WearcapError, match=message):
        read_trajectory(tmp_path / "transforms.json")
