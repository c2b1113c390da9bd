"""Watch logs: what their numbers mean is found in them."""

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
import torch

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.io.devices.watch_log import G_M_S2, is_watch_log, read_inertial_log, read_watch_log
from wearcap.recording import ImuStream


def moved(frames: int = 120) -> ImuStream:
    """A watch that turns about all axes and is shaken."""
    random = torch.Generator().manual_seed(0)
    time = torch.arange(frames, dtype=torch.float64) / 50 + 1.7e9
    turn = torch.stack([torch.sin(time * rate) for rate in (2.0, 3.1, 1.3)], -1)
    R = rotation.exp(1.5 * turn)
    acc = 3 * torch.randn(frames, 3, generator=random, dtype=torch.float64)
    up = torch.tensor([0.0, 0.0, G_M_S2], dtype=torch.float64)
    felt = (R.mT @ (acc + up)[..., None])[..., 0]
    return ImuStream(time, "left_wrist", R.float(), acc.float(), felt.float(), turn.float())


def sensor_logger(
    watch: ImuStream, path: Path, *, android: bool = False, back: bool = False, swap: bool = False
) -> Path:
    R = watch.R_world_imu.double()
    free = (R.mT @ watch.acc_world.double()[..., None])[..., 0]
    gravity = watch.acc_imu.double() - free
    quaternion = rotation.quat_wxyz_from_matrix(R.mT if back else R)
    if swap:
        quaternion = quaternion.roll(-1, -1)
    scale = 1.0 if android else -1 / G_M_S2
    names = [f"{name}{axis}" for name in ("rotationRate", "gravity", "acceleration") for axis in "XYZ"]
    names += [f"quaternion{axis}" for axis in "WXYZ"]
    table = torch.cat([watch.gyro_imu.double(), scale * gravity, scale * free, quaternion], -1).tolist()
    rows = [
        ",".join([str(round(time * 1e9)), *(f"{value:.9f}" for value in row)])
        for time, row in zip(watch.timestamps.tolist(), table)
    ]
    path.write_text("\n".join([",".join(["time", *names]), *rows]) + "\n")
    return path


def sensor_log(watch: ImuStream, path: Path) -> Path:
    R = watch.R_world_imu.double()
    free = -(R.mT @ watch.acc_world.double()[..., None])[..., 0] / G_M_S2
    quaternion = rotation.quat_wxyz_from_matrix(R)[:, [1, 2, 3, 0]]
    names = [f"accelerometerAcceleration{axis}(G)" for axis in "XYZ"]
    names += [f"motionUserAcceleration{axis}(G)" for axis in "XYZ"] + [f"motionQuaternion{axis}(R)" for axis in "XYZW"]
    table = torch.cat([-watch.acc_imu.double() / G_M_S2, free, quaternion], -1).tolist()
    rows = [
        ",".join([datetime.fromtimestamp(time, UTC).isoformat(), *(f"{value:.9f}" for value in row)])
        for time, row in zip(watch.timestamps.tolist(), table)
    ]
    path.write_text("\n".join([",".join(["loggingTime(txt)", *names]), *rows]) + "\n")
    return path


def assert_same(read: ImuStream, watch: ImuStream, turn: bool = True) -> None:
    assert torch.allclose(read.timestamps, watch.timestamps, atol=1e-5)
    for name in ("R_world_imu", "acc_world", "acc_imu", *(("gyro_imu",) if turn else ())):
        assert torch.allclose(getattr(read, name), getattr(watch, name), atol=1e-4), name


@pytest.mark.parametrize("options", [{}, {"android": True}, {"back": True}, {"android": True, "back": True}])
def test_unit_sign_and_direction_are_found(tmp_path, options):
    assert_same(read_watch_log(sensor_logger(moved(), tmp_path / "a.csv", **options), "left_wrist"), moved())


def test_sensorlog_has_gravity_in_what_it_feels_and_may_lack_the_turn_rate(tmp_path):
    read = read_watch_log(sensor_log(moved(), tmp_path / "a.csv"), "left_wrist")
    assert read.gyro_imu is None
    assert_same(read, moved(), turn=False)


def test_another_order_of_the_quaternion_is_refused(tmp_path):
    path = sensor_logger(moved(), tmp_path / "a.csv", swap=True)
    with pytest.raises(WearcapError, match="turns gravity 0.[0-9]+ upright"):
        read_watch_log(path, "left_wrist")


def test_bad_logs_are_refused(tmp_path):
    path = sensor_logger(moved(), tmp_path / "a.csv")
    lines = path.read_text().splitlines()

    def refused(changed: list[str], match: str) -> None:
        path.write_text("\n".join(changed) + "\n")
        with pytest.raises(WearcapError, match=match):
            read_watch_log(path, "right_wrist")

    refused(lines[:2], "1 rows with numbers")
    refused([lines[0], *lines[1::5]], "10.0 rows a second")
    fields = lines[1].split(",")
    refused([lines[0], ",".join([*fields[:-1], "0.9"]), *lines[2:]], "attitude of length")
    refused(["time,x,y", "1,2,3"], "not a watch's motion log")
    with pytest.raises(WearcapError, match="a watch on 'head'"):
        read_watch_log(path, "head")


@pytest.mark.real
@pytest.mark.parametrize("name", ["WristMotion.csv", "NewWristMotion.csv"])
def test_a_real_watch_knows_where_up_is(real_data, name):
    watch = read_watch_log(real_data / "apple_watch_imu" / name, "left_wrist")
    up = (watch.R_world_imu @ watch.acc_imu[..., None])[..., 0] - watch.acc_world
    assert torch.allclose(up, torch.tensor([0.0, 0.0, G_M_S2]).expand_as(up), atol=0.2)
    step = watch.timestamps.diff().numpy()
    assert 1 / np.median(step) == pytest.approx(100, abs=2)
    assert watch.acc_world.norm(dim=-1).max() < 15 * G_M_S2
    # The turn rate agrees with how the attitude turns, away from gaps.
    near = torch.from_numpy(step < 0.015)
    turned = (
        rotation.log((watch.R_world_imu[:-1].mT @ watch.R_world_imu[1:]).double()) / watch.timestamps.diff()[:, None]
    )
    error = (turned - watch.gyro_imu[1:]).norm(dim=-1)[near]
    assert error.median() < 0.1 * watch.gyro_imu.norm(dim=-1).median()


def x_imu(watch: ImuStream, folder: Path) -> Path:
    """x-IMU3's files: microseconds, degrees a second, g; the attitude's file at half the rate."""
    names = [
        f"{kind} {axis} ({unit})" for kind, unit in (("Gyroscope", "deg/s"), ("Accelerometer", "g")) for axis in "XYZ"
    ]
    time = (watch.timestamps - watch.timestamps[0]).mul(1e6).round().long().tolist()
    inertial = torch.cat([watch.gyro_imu.double().rad2deg(), watch.acc_imu.double() / G_M_S2], 1).tolist()
    rows = [",".join(map(str, [at, *row])) for at, row in zip(time, inertial)]
    (folder / "Inertial.csv").write_text("\n".join([",".join(["Timestamp (us)", *names]), *rows]) + "\n")
    attitude = rotation.quat_wxyz_from_matrix(watch.R_world_imu.double()).tolist()
    rows = [",".join(map(str, [at, *row])) for at, row in zip(time[::2], attitude[::2])]
    (folder / "Quaternion.csv").write_text("\n".join(["Timestamp (us),W,X,Y,Z", *rows]) + "\n")
    return folder / "Inertial.csv"


@pytest.mark.parametrize("given", ["Inertial.csv", "Quaternion.csv"])
def test_x_imu_has_its_attitude_beside(tmp_path, given):
    made = moved()
    x_imu(made, tmp_path)
    assert is_watch_log(tmp_path / given)
    for read in (read_inertial_log, read_watch_log):
        found = read(tmp_path / given, "left_wrist")
        inner = slice(2, -2)
        torch.testing.assert_close(found.acc_imu, made.acc_imu, atol=1e-3, rtol=1e-4)
        torch.testing.assert_close(found.gyro_imu, made.gyro_imu, atol=1e-3, rtol=1e-4)
        assert rotation.geodesic(found.R_world_imu[inner], made.R_world_imu[inner]).max() < 0.01
        assert (found.acc_world[inner] - made.acc_world[inner]).abs().max() < 0.4


def test_a_sensor_without_attitude_is_read_by_the_doctor_alone(tmp_path):
    path = x_imu(moved(), tmp_path)
    (tmp_path / "Quaternion.csv").unlink()
    assert read_inertial_log(path, "left_wrist").R_world_imu is None
    with pytest.raises(WearcapError, match="without attitude.*other files beside"):
        read_watch_log(path, "left_wrist")
    other = x_imu(replace(moved(), R_world_imu=rotation.about_axis("x", torch.full((120,), 2.0))), tmp_path)
    with pytest.raises(WearcapError, match="the attitude turns gravity .* upright"):
        read_inertial_log(other, "left_wrist")
