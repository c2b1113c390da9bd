"""The doctor knows logs by their content, kits of them, and what a pipeline lacks."""

import json
from pathlib import Path

import numpy as np
import pytest

import short_walk
from wearcap.apps.doctor import examine
from wearcap.io.conventions import Conventions

NAMES = {
    "time": "time",
    "head": "head_{quantity}_{axis}",
    "left": "left_hand_{quantity}_{axis}",
    "right": "right_hand_{quantity}_{axis}",
}


def words(report) -> str:
    return " | ".join(
        f"{f.severity} {f.check}: {f.what} {f.evidence}" for found in report.findings.values() for f in found
    )


def test_logs_are_known_by_their_content_not_their_name(tmp_path):
    time, R, t = short_walk.walk()
    short_walk.euroc(tmp_path / "walk.txt", time, R @ short_walk.CAMERA_IN_HEAD, t)
    short_walk.hloc(tmp_path / "poses.csv", time, R @ short_walk.CAMERA_IN_HEAD, t)
    short_walk.headset_csv(tmp_path / "log.txt", time, short_walk.headset_poses(time, R, t, "unity", "grip"), NAMES)
    (tmp_path / "log.json").write_text(
        json.dumps(short_walk.headset_frames(time, short_walk.headset_poses(time, R, t, "openxr", "grip")))
    )
    found = {name: words(examine(tmp_path / name)) for name in ("walk.txt", "log.txt", "log.json")}
    found["poses.csv"] = words(examine(tmp_path / "poses.csv", how=Conventions(unit="m")))
    assert "ok trajectory: read EuRoC, times in ns" in found["walk.txt"]
    assert "the device has camera's axes" in found["walk.txt"]
    assert "ok trajectory: read hloc" in found["poses.csv"]
    assert "ok headset's log: head and 2 hands" in found["log.txt"]
    assert "axes unity" in found["log.txt"]
    assert "axes openxr" in found["log.json"]
    assert not any("error" in one for one in found.values()), found


def test_a_folder_of_headsets_logs_is_a_recording_each(tmp_path):
    time, R, t = short_walk.walk()
    poses = short_walk.headset_poses(time, R, t, "unity", "grip")
    for name in ("a.csv", "b.csv"):
        short_walk.headset_csv(tmp_path / name, time, poses, NAMES)
    report = examine(tmp_path)
    assert list(report.findings) == ["a.csv", "b.csv"]
    assert report.sound


def test_a_table_that_is_no_log(tmp_path):
    (tmp_path / "prices.csv").write_text("item,price\npear,3\n")
    report = examine(tmp_path / "prices.csv")
    assert not report.sound
    assert "TUM, EuRoC, COLMAP" in " ".join(f.fix + f.evidence + f.what for f in report.findings["prices.csv"])


def test_a_folder_of_a_reconstruction(tmp_path):
    time, R, t = short_walk.walk()
    (tmp_path / "model").mkdir()
    short_walk.colmap_binary(tmp_path / "model/images.bin", time, R @ short_walk.CAMERA_IN_HEAD, t)
    assert "error reading: the unit of length of the camera's SLAM stays unknown" in words(examine(tmp_path / "model"))
    assert "ok trajectory: read COLMAP" in words(examine(tmp_path / "model", how=Conventions(unit=1.0)))


@pytest.mark.parametrize(
    ("pipeline", "lacks"),
    [
        ("hmd2", ["warning hmd2 needs: points of the surroundings"]),
        ("echo", []),
        ("mocap_every", ["error mocap_every needs: two watches"]),
        (
            "hps",
            [
                "error hps needs: a suit's motion",
                "error hps needs: the scene's scan",
                "warning hps needs: foot contacts",
            ],
        ),
        ("paper/hps_without_scene", ["error paper/hps_without_scene needs: a suit's motion"]),
        ("ireplica", ["error ireplica needs: the objects that can be moved"]),
    ],
)
def test_what_each_pipeline_lacks_of_a_headset(tmp_path, capsys, pipeline, lacks):
    time, R, t = short_walk.walk()
    short_walk.headset_csv(tmp_path / "quest.csv", time, short_walk.headset_poses(time, R, t, "unity", "grip"), NAMES)
    failed = any(word.startswith("error") for word in lacks)
    assert (short_walk.exit_code("doctor", [f"{tmp_path}/quest.csv", f"for={pipeline}", "--json"]) == 1) == failed
    found = json.loads(capsys.readouterr().out)["findings"]["quest.csv"]
    listed = [f"{one['severity']} {one['check']}" for one in found]
    for word in lacks:
        assert any(one.startswith(word) for one in listed), (word, listed)
    if pipeline == "echo":
        assert "ok echo needs: both wrists tracked" in listed
        assert "ok echo: overlap" in listed
    if "without_scene" in pipeline:
        assert not any("scan" in one for one in listed)
    assert all(one["fix"] for one in found if one["severity"] in ("error", "warning") and "needs" in one["check"])


def test_a_kit_of_watches_and_a_trajectory(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "data"))
    from test_prepare_logs import sensor_logger

    time, R, t = short_walk.walk(start=1.7e9)
    kit = tmp_path / "kit"
    kit.mkdir()
    short_walk.tum(kit / "camera.txt", time, R, t)
    for seed, (side, (R_wrist, _)) in enumerate(short_walk.wrists(time, R, t).items()):
        sensor_logger(kit / f"watch_{side}.csv", time, R_wrist, seed)
    found = words(examine(kit))
    assert "ok log watch_left.csv: a watch's log with attitude, acceleration, turn rate" in found
    assert "ok streams' time spans" in found
    assert short_walk.exit_code("doctor", [str(kit), "for=mocap_every", "--quiet"]) == 0
    # A watch that was on another clock, and one whose log is missing.
    R_wrist = short_walk.wrists(time, R, t)["left"][0]
    sensor_logger(kit / "watch_left.csv", time + 3600, R_wrist, 0)
    assert short_walk.exit_code("doctor", [str(kit), "--for", "mocap_every"]) == 1
    (kit / "watch_left.csv").unlink()
    assert "warning watches: one watch" in words(examine(kit))
    (kit / "camera.txt").unlink()
    assert "error kit: no path of the head" in words(examine(kit))


def test_the_floor_and_the_height_are_looked_at(tmp_path, capsys):
    """Points that show the floor below half of the path only, and a body that is too tall for the head's height."""
    time, R, t = short_walk.walk(seconds=20)
    t[:, :2] = np.stack([1.1 * (time - time[0]), 0 * time], 1)
    short_walk.tum(tmp_path / "walk.txt", time, 0 * R + np.eye(3), t)
    random = np.random.default_rng(0)
    for share, height, expected in ((1.0, 1.74, ("ok", "ok")), (0.3, 2.1, ("warning", "warning"))):
        near = t[: int(share * len(t)), :2]
        floor = np.concatenate(
            [
                near[random.integers(0, len(near), 20000)] + random.normal(0, 0.5, (20000, 2)),
                random.normal(0, 0.01, (20000, 1)),
            ],
            1,
        )
        cloud = "\n".join(",".join(f"{value:.4f}" for value in point) for point in floor)
        (tmp_path / "cloud.csv").write_text(f"x,y,z\n{cloud}\n")
        given = [f"source={tmp_path}/walk.txt", f"points={tmp_path}/cloud.csv", f"height={height}"]
        short_walk.exit_code("prepare", ["trajectory", f"output={tmp_path}/out", "jobs=1", *given])
        capsys.readouterr()
        short_walk.exit_code("doctor", [f"{tmp_path}/out", "for=hmd2", "--json"])
        found = json.loads(capsys.readouterr().out)["findings"]["walk"]
        severity = {one["check"]: one["severity"] for one in found}
        assert (severity["floor below the path"], severity["height"]) == expected, found


@pytest.mark.real
@pytest.mark.parametrize(
    ("file", "says"),
    [
        ("apple_watch_imu/WristMotion.csv", "a watch's log with attitude, acceleration, turn rate"),
        ("apple_watch_imu/NewWristMotion.csv", "a watch's log with attitude, acceleration, turn rate"),
        (
            "ximu3_imu/Fusion/Examples/Python/sensor_data.csv",
            "x-IMU3's log with acceleration, turn rate, without attitude",
        ),
        (
            "ximu3_imu/IMU-Mocap/Examples/logged_lower_body/Left Foot 64F0EBCE (UDP)/Inertial.csv",
            "x-IMU3's log with attitude",
        ),
    ],
)
def test_real_logs(real_data, file, says):
    found = words(examine(real_data / file))
    assert says in found
    assert "EuRoC" not in found


@pytest.mark.real
def test_a_real_log_with_doubled_times_is_read_and_they_are_counted(real_data):
    assert "749 rows" in words(examine(real_data / "field/C_watch_repeated_rows_left.csv"))
    assert "16334 samples" in words(examine(real_data / "ximu3_imu/Gait-Tracking/short_walk.csv"))
