"""`wearcap calibrate steps=watches`: from a simulated session's files to calibration.json and a recording."""

import json
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
import torch

import calibration_session as simulated
from wearcap.body.skeleton import WRISTS
from wearcap.cli import calibrate as verb
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.io.formats.poses import write_tum
from wearcap.recording import HeadStream, ImuStream, PointCloud, Recording, RecordingStore
from wearcap.recording.store import load_recording, save_recording
from wearcap.sensors.clock import Clock
from wearcap.sensors.watch_calibration import read_watch_calibration, write_watch_calibration
from wearcap.sensors.watches import watches_at
from wearcap_testing import recording_of, swaying_motion

CalibrationSession = simulated.CalibrationSession
MARKS, STANDING, SWINGS_S = simulated.MARKS, simulated.STANDING, simulated.SWINGS_S
G = 9.80665


def write_sensor_log(watch: ImuStream, path: Path) -> None:
    """SensorLog's CSV: Core Motion's signs and units."""
    R = watch.R_world_imu.double()
    free = (R.mT @ watch.acc_world.double()[..., None])[..., 0]
    gravity = R[:, 2] * G
    quaternion = rotation.quat_wxyz_from_matrix(R)[:, [1, 2, 3, 0]]
    names = [f"accelerometerAcceleration{axis}(G)" for axis in "XYZ"]
    names += [f"motionUserAcceleration{axis}(G)" for axis in "XYZ"] + [f"motionQuaternion{axis}(R)" for axis in "XYZW"]
    table = torch.cat([-(free + gravity) / G, -free / G, quaternion], -1).tolist()
    rows = [
        ",".join([datetime.fromtimestamp(time, UTC).isoformat(), *(f"{value:.7f}" for value in row)])
        for time, row in zip(watch.timestamps.tolist(), table)
    ]
    path.write_text("\n".join([",".join(["loggingTime(txt)", *names]), *rows]) + "\n")


@pytest.fixture(scope="module")
def made() -> CalibrationSession:
    return simulated.simulate_calibration(0, watch_fps=50.0, walk_s=0.0)


@pytest.fixture(scope="module")
def files(made, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("session")
    for joint, stream in made.watches.items():
        write_sensor_log(stream, folder / f"{joint.split('_')[0]}.csv")
    write_tum(made.slam, folder / "camera.txt")
    return folder


def written(*stretches) -> str:
    return ",".join(f"[{start:.2f},{stop:.2f}]" for start, stop in stretches)


def arguments(made: CalibrationSession, files: Path, out: Path, camera: bool = True) -> dict[str, str]:
    zero = max(stream.timestamps[0].item() for stream in made.watches.values())
    steps = {
        key: written([at - zero for at in stretch["left_wrist"]])
        for key, stretch in (("board", made.board), ("tpose", made.t_pose))
    }
    given = {
        "steps": "watches",
        "left": f"{files}/left.csv",
        "right": f"{files}/right.csv",
        **steps,
        "output": f"{out}/calibration.json",
        "hydra.run.dir": f"{out}/run",
    }
    if camera:
        swings = ",".join(f"{at:.4f}" for at in made.swings_s.tolist())
        given |= {
            "camera": f"{files}/camera.txt",
            "marks": f"[{written(*MARKS)}]",
            "standing": written(STANDING),
            "distances_m": f"[{made.measured.distances_m[0]},{made.measured.distances_m[1]}]",
            "mark_height_m": str(made.measured.mark_height_m),
            "swings": f"[{swings}]",
            "camera_fps": "60",
        }
    return given


def calibrate(given: dict[str, str], *more: str) -> None:
    verb.main([*(f"{key}={value}" for key, value in given.items()), *more])


def apart_deg(wxyz: list[float], R: torch.Tensor) -> float:
    """Angle between a rotation of the file and a true one."""
    written = rotation.matrix_from_quat_wxyz(torch.tensor(wxyz, dtype=torch.float64))
    return rotation.geodesic(written, R.double()).rad2deg().item()


def test_a_session_becomes_a_calibration_and_a_recording(made, files, tmp_path, capsys):
    given = arguments(made, files, tmp_path) | {"recording": f"{tmp_path}/worn.safetensors"}
    calibrate(given)
    printed = capsys.readouterr().out
    assert "residual" in printed
    assert "no  " not in printed.replace("not", "")
    content = json.loads((tmp_path / "calibration.json").read_text())
    for joint in WRISTS:
        watch, clock = content["watches"][joint], content["clocks"][joint]
        assert apart_deg(watch["R_world_ref_wxyz"], made.planted.R_world_ref[joint]) < 0.5
        assert apart_deg(watch["R_joint_imu_wxyz"], made.planted.R_joint_imu[joint]) < 0.5
        middle = torch.tensor([SWINGS_S + 8], dtype=torch.float64)
        knots = (torch.tensor(clock[key], dtype=torch.float64) for key in ("camera_s", "watch_s"))
        found = Clock(*knots, clock["drift_s_per_hour"], clock["residual_s"], clock["swings"])
        assert (found.to_camera(middle - made.planted.offset_s[joint]) - middle).abs() < 0.005
    assert content["camera"]["scale"] == pytest.approx(made.planted.scale, rel=0.005)
    assert apart_deg(content["camera"]["R_world_slam_wxyz"], made.planted.R_world_slam) < 0.5
    assert apart_deg(content["head"]["R_head_cam_wxyz"], made.planted.R_head_cam) < 0.5
    assert all(check["ok"] for check in content["checks"])
    assert content["about"]["left"] == "left.csv"
    recording = load_recording(tmp_path / "worn.safetensors")
    at = torch.arange(STANDING[0], STANDING[1], 1 / 30, dtype=torch.float64)
    R, _ = watches_at(recording.imu, at, "test")
    torch.testing.assert_close(R[:, :, 2, 1].mean(0), torch.tensor([-1.0, 1.0]), atol=0.01, rtol=0)
    assert recording.floor.height.tolist() == [0.0]
    upright = (recording.head.timestamps > STANDING[0]) & (recording.head.timestamps < STANDING[1])
    assert recording.head.t_world_device[upright, 2].mean() == pytest.approx(made.measured.standing_m, abs=0.01)


def test_watches_alone_go_into_a_data_set(made, files, tmp_path, capsys):
    store = RecordingStore(tmp_path)
    store.add(recording_of(swaying_motion(60), "walk"), split="test", config_hash="kept")
    calibrate(arguments(made, files, tmp_path, camera=False) | {"recording": f"{tmp_path}/walk"})
    assert "stay on their own clock" in capsys.readouterr().out
    store = RecordingStore.open(tmp_path)
    assert all(wrong is None for _, wrong in store.verify())
    assert store.entries["walk"].config_hash == "kept"
    recording = store.load("walk")
    assert set(recording.imu) == set(WRISTS)
    assert recording.motion is not None


def test_the_guide_prints_the_steps_and_where_the_logs_have_them(made, files, tmp_path, capsys):
    given = arguments(made, files, tmp_path)
    for key in ("board", "tpose", "marks", "standing"):
        del given[key]
    calibrate(given, "guide=true")
    printed = capsys.readouterr().out
    assert "1. Lay both watches on the board" in printed
    assert "5. Swing" in printed
    assert "given: swings" in printed
    hint = printed.split("try: ")[1].split()
    assert [word.split("=")[0] for word in hint] == ["board", "tpose", "marks", "standing"]
    assert not (tmp_path / "calibration.json").exists()
    with pytest.raises(WearcapError, match="no board, tpose, marks, standing.*Give them as board="):
        calibrate(given)
    # What is proposed is good enough to calibrate with.
    calibrate(given, *hint)
    content = json.loads((tmp_path / "calibration.json").read_text())
    assert apart_deg(content["watches"]["left_wrist"]["R_joint_imu_wxyz"], made.planted.R_joint_imu["left_wrist"]) < 1.0
    assert content["camera"]["scale"] == pytest.approx(made.planted.scale, rel=0.01)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"board": "[20.0,23.0]"}, "board, left_wrist: (not still|tilt).*Expected at most"),
        ({"board": "[3.0,4.0]"}, "board, left_wrist.*1.00 s long"),
        ({"tpose": "[60,63]"}, "T-pose, left_wrist: slope of the forearm"),
        ({"board": "3"}, r"board=3.*Expected board=\[from,to\]"),
        ({"distances_m": "[0.5]"}, "distances_m.*Expected 2 numbers"),
        ({"distances_m": "[D,D]"}, "scales by the two distances differ"),
        ({"marks": "[[1,4]]"}, "1 stretches"),
        ({"swings": "[66.0,67.0]"}, "arm swings"),
        ({"facing_deg": "-90"}, "standing: optical axis away"),
        ({"steps": "watch"}, "no steps 'watch'. Did you mean 'watches'"),
        ({"left": "none.csv"}, "none.csv"),
        ({"camera": "null"}, "marks, standing, swings without a camera"),
        ({"recording": "nowhere/x"}, "nowhere/x: no recording here"),
        ({"bord": "[1,2]"}, "Did you mean 'board'"),
    ],
)
def test_what_is_wrong_is_reported_and_nothing_is_written(made, files, tmp_path, change, match):
    change = {key: value.replace("D", str(made.measured.distances_m[0])) for key, value in change.items()}
    with pytest.raises(WearcapError, match=match):
        calibrate(arguments(made, files, tmp_path) | change)
    assert not (tmp_path / "calibration.json").exists()


def test_swapped_logs_are_noticed(made, files, tmp_path):
    given = arguments(made, files, tmp_path, camera=False)
    with pytest.raises(WearcapError, match="swapped|disagree"):
        calibrate(given | {"left": given["right"], "right": given["left"]})


@pytest.fixture(scope="module")
def walked() -> CalibrationSession:
    return simulated.simulate_calibration(1, watch_fps=50.0, camera_fps=30.0, walk_s=60.0)


@pytest.fixture(scope="module")
def kit(walked, tmp_path_factory) -> Path:
    """Files of other programs: EuRoC's nanoseconds, a cloud as a table, x-IMU3's Inertial.csv; with two bursts of outliers."""
    folder = tmp_path_factory.mktemp("kit")
    for joint, stream in walked.watches.items():
        write_sensor_log(stream, folder / f"{joint.split('_')[0]}.csv")
    slam, rows = walked.slam, ["#timestamp [ns], p_x [m], p_y [m], p_z [m], q_w [], q_x [], q_y [], q_z []"]
    place = slam.t_world_body.double().clone()
    for at in (2000, 2400):
        place[at : at + 4] += 5 / walked.planted.scale
    quaternion = rotation.quat_wxyz_from_matrix(slam.R_world_body.double())
    for time, pose in zip(slam.timestamps.tolist(), torch.cat([place, quaternion], 1).tolist()):
        rows.append(",".join([str(round(time * 1e9)), *(f"{value:.9f}" for value in pose)]))
    (folder / "data.csv").write_text("\n".join(rows) + "\n")
    cloud = "\n".join(",".join(f"{value:.6f}" for value in point) for point in walked.points_slam.tolist())
    (folder / "points.csv").write_text(f"x,y,z\n{cloud}\n")
    names = [
        f"{kind} {axis} ({unit})" for kind, unit in (("Gyroscope", "deg/s"), ("Accelerometer", "g")) for axis in "XYZ"
    ]
    imu = walked.head_imu
    table = torch.cat([imu.timestamps[:, None], torch.zeros(len(imu.timestamps), 3), imu.acc_imu.double() / G], 1)
    felt = "\n".join(",".join(f"{value:.9f}" for value in row) for row in table.tolist())
    (folder / "Inertial.csv").write_text(",".join(["Time (s)", *names]) + f"\n{felt}\n")
    return folder


@pytest.mark.parametrize("by", ["floor", "head_imu", "walks"])
def test_scale_and_vertical_without_the_board(walked, kit, tmp_path, capsys, by):
    """The camera's world comes from the floor, the head's sensor, or walks; outliers go, points, height and floor come along."""
    given = arguments(walked, kit, tmp_path) | {"camera": f"{kit}/data.csv", "camera_fps": "30"}
    for key in ("marks", "distances_m", "mark_height_m"):
        del given[key]
    given |= {"camera_height_m": str(walked.measured.standing_m), "height": "1.68"}
    given |= {"recording": f"{tmp_path}/worn.safetensors", "points": f"{kit}/points.csv"}
    if by != "floor":
        given["head_imu"] = f"{kit}/Inertial.csv"
    if by == "walks":
        slam = walked.slam
        first, last = slam.timestamps[0].item() + 85, slam.timestamps[0].item() + 86
        ends = [slam.t_world_body[(slam.timestamps - at).abs().argmin()] for at in (first, last)]
        metres = (ends[1] - ends[0]).norm().item() * walked.planted.scale
        given["walks"] = f"[[85.0,86.0,{metres:.4f}]]"
    calibrate(given)
    assert "8 outliers of" in capsys.readouterr().out
    content = json.loads((tmp_path / "calibration.json").read_text())
    assert content["camera"]["scale"] == pytest.approx(walked.planted.scale, rel=0.02)
    assert apart_deg(content["camera"]["R_world_slam_wxyz"], walked.planted.R_world_slam) < 3.0
    assert "residual_m" not in content["camera"]
    recording = load_recording(tmp_path / "worn.safetensors")
    assert recording.skeleton.stature == pytest.approx(1.68, abs=1e-3)
    floor = recording.points.points_world[:, 2].abs() < 0.03
    assert 0.3 < floor.float().mean() < 0.7
    head = recording.head
    upright = (head.timestamps > STANDING[0]) & (head.timestamps < STANDING[1])
    assert head.t_world_device[upright, 2].mean() == pytest.approx(walked.measured.standing_m, abs=0.02)
    speed = head.t_world_device.diff(dim=0).norm(dim=-1) / head.timestamps.diff()
    assert speed.max() < 6


def test_points_of_a_recording_come_along(made, files, tmp_path):
    """A recording of the camera's own path and points, in the SLAM's world, gets both in the calibrated one."""
    slam = made.slam
    head = HeadStream(slam.timestamps, slam.R_world_body, slam.t_world_body, torch.eye(3), torch.zeros(3))
    points = PointCloud(torch.cat([slam.t_world_body[::50], torch.randn(20, 3)]))
    save_recording(Recording("worn", head=head, points=points), tmp_path / "worn.safetensors")
    calibrate(arguments(made, files, tmp_path) | {"recording": f"{tmp_path}/worn.safetensors"})
    found = load_recording(tmp_path / "worn.safetensors")
    path = found.head.t_world_device[::50]
    torch.testing.assert_close(found.points.points_world[: len(path)], path, atol=0.02, rtol=0)


def test_logs_of_different_times_are_named_with_their_spans(made, files, tmp_path):
    late = replace(made.watches["right_wrist"], timestamps=made.watches["right_wrist"].timestamps + 5000)
    write_sensor_log(late, tmp_path / "late.csv")
    given = arguments(made, files, tmp_path) | {"right": f"{tmp_path}/late.csv"}
    with pytest.raises(
        WearcapError, match=r"left_wrist from .* to .* s, right_wrist from .* to .* s: they share 0.00 s"
    ):
        calibrate(given)


def numbers_of(tree) -> list[float]:
    parts = tree.values() if isinstance(tree, dict) else tree if isinstance(tree, list) else ()
    return [tree] if isinstance(tree, int | float) else [number for part in parts for number in numbers_of(part)]


def test_a_calibration_is_read_as_it_was_written(made, files, tmp_path):
    calibrate(arguments(made, files, tmp_path))
    found = read_watch_calibration(tmp_path / "calibration.json")
    write_watch_calibration(found, tmp_path / "again.json")
    first, again = (json.loads((tmp_path / name).read_text()) for name in ("calibration.json", "again.json"))
    for part in ("watches", "clocks", "camera", "head"):
        assert numbers_of(again[part]) == pytest.approx(numbers_of(first[part]), abs=1e-6)
    (tmp_path / "bad.json").write_text('{"watches": {"left_wrist": {"R_world_ref_wxyz": [0, 0, 0, 0]}}}')
    with pytest.raises(WearcapError, match="not a calibration of watches"):
        read_watch_calibration(tmp_path / "bad.json")
