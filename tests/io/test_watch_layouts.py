"""Public layouts of watches', phones' and sensors' logs, each written here from one motion in NumPy and SciPy."""

from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from wearcap.errors import WearcapError
from wearcap.io.devices.watch_log import is_watch_log, read_watch, read_watch_log, sensor_files

G = 9.80665
START_S = 1.7e9


def attitude(t: np.ndarray) -> Rotation:
    """R_world_sensor: it turns about all axes."""
    return Rotation.from_euler(
        "ZYX", np.stack([1.2 * np.sin(1.1 * t), 0.8 * np.sin(2.3 * t), 2.0 * np.sin(1.7 * t)], 1)
    )


def free(t: np.ndarray) -> np.ndarray:
    """Acceleration in the world without gravity (m/s²)."""
    return np.stack([4 * np.sin(5 * t), 3 * np.cos(4 * t), 2 * np.sin(6 * t)], 1)


def turn(t: np.ndarray) -> np.ndarray:
    return (attitude(t - 1e-5).inv() * attitude(t + 1e-5)).as_rotvec() / 2e-5


def down(t: np.ndarray) -> np.ndarray:
    """Gravity as a specific force in the sensor's axes (m/s²)."""
    return attitude(t).inv().apply([0, 0, G])


def own(t: np.ndarray) -> np.ndarray:
    """Free acceleration in the sensor's axes (m/s²)."""
    return attitude(t).inv().apply(free(t))


def wxyz(t: np.ndarray) -> np.ndarray:
    return attitude(t).as_quat()[:, [3, 0, 1, 2]]


def seconds(rate: float = 100.0, shift: float = 0.0) -> np.ndarray:
    return np.arange(int(12 * rate)) / rate + shift


def number(value: float) -> str:
    return f"{value:.9f}"


def table(
    path: Path, header: str, times: Iterable[object], *columns: np.ndarray, between: str = ",", above: str = ""
) -> Path:
    """A table: what stands above it, the names of columns, and a row for each time."""
    point = "." if between == "," or "\t" in between else ","
    rows = [
        between.join([str(time), *(number(value).replace(".", point) for value in row)])
        for time, row in zip(times, np.concatenate(columns, 1))
    ]
    path.write_text("\n".join([above + header, *rows]) + "\n", encoding="utf-8")
    return path


def xyz(name: str, axes: str = "XYZ", unit: str = "", between: str = ",") -> str:
    return between.join(f"{name}{axis}{unit}" for axis in axes)


def epoch_ns(t: np.ndarray) -> list[int]:
    return [round((START_S + each) * 1e9) for each in t]


def iso(t: np.ndarray) -> list[str]:
    return [datetime.fromtimestamp(START_S + each, UTC).isoformat(timespec="milliseconds") for each in t]


def mt_manager(folder: Path) -> Path:
    """MT Manager's text of an MTw: ticks of 0.1 ms that start again at 2³², free acceleration in the world."""
    t = seconds()
    ticks = (2**32 - 3000 + np.round(t * 1e4).astype(int)) % 2**32
    header = "PacketCounter\tSampleTimeFine\t" + "\t".join(
        [
            xyz("Acc_", between="\t"),
            xyz("FreeAcc_", "ENU", between="\t"),
            xyz("Gyr_", between="\t"),
            xyz("Quat_q", "0123", between="\t"),
        ]
    )
    above = (
        "// Start Time: Unknown\n// Update Rate: 100.0Hz\n// Filter Profile: human (46.1)\n// Firmware Version: 4.0.2\n"
    )
    times = [f"{count:05d}\t{tick}" for count, tick in enumerate(ticks)]
    path = folder / "MT_01200000-000-000_00B42D71_left.txt"
    return table(path, header, times, own(t) + down(t), free(t), turn(t), wxyz(t), between="\t", above=above)


def open_sense(folder: Path) -> Path:
    """The text that OpenSense reads: no clock but the counter (16 bits) and the rate above, and matrices by columns."""
    t = seconds()
    matrices = attitude(t).as_matrix().swapaxes(1, 2).reshape(-1, 9)
    names = "\t".join(f"Mat[{row}][{column}]" for column in "123" for row in "123")
    header = "PacketCounter\tSampleTimeFine\tYear\t" + "\t".join(
        [xyz("Acc_", between="\t"), xyz("Gyr_", between="\t"), names]
    )
    times = [f"{(65000 + count) % 65536:05d}\t\t" for count in range(len(t))]
    path = table(
        folder / "MT_012005D6_009-001_00B42279.txt",
        header,
        times,
        own(t) + down(t),
        turn(t),
        matrices,
        between="\t",
        above="// Start Time: Unknown\n// Update Rate: 100.0Hz\n// Option Flags: AHS Disabled ICC Disabled\n",
    )
    lines = path.read_text().splitlines()
    for lost in (40, 41, 300):
        lines[lost] = lines[lost][:5] + "\t" * lines[lost].count("\t")
    path.write_text("\n".join(lines) + "\n")
    return path


def movella_dot(folder: Path) -> Path:
    """Movella DOT's table: lines about the recording above, µs that start again, degrees a second."""
    t = seconds(60.0)
    ticks = (2**32 - 500_000 + np.round(t * 1e6).astype(int)) % 2**32
    header = ",".join(["PacketCounter,SampleTimeFine", xyz("Quat_", "WXYZ"), xyz("FreeAcc_"), xyz("Gyr_")])
    above = (
        "DeviceTag:,DOT 1\nFirmwareVersion:,2.4.0\nSyncStatus:,Synced\nOutputRate:,60Hz\nFilterProfile:,General\n"
        "Measurement Mode:,Sensor fusion Mode - Extended(Quaternion)\nStartTime: ,2025-07-11_20:06:00_086 WEST\n"
        "© Movella Technologies B. V. 2005-2025\n\n"
    )
    times = [f"{count + 1},{tick}" for count, tick in enumerate(ticks)]
    return table(folder / "dot.csv", header, times, wxyz(t), free(t), np.rad2deg(turn(t)), above=above)


def phone(folder: Path, scale: float, given: str) -> Path:
    """Sensor Logger's files of a phone, a sensor each, at times of their own."""
    reverse = [2, 1, 0]
    for name, shift, values in (
        ("Accelerometer", 0.0, lambda t: scale * own(t)),
        ("Gravity", 0.003, lambda t: scale * down(t)),
        ("Gyroscope", -0.002, turn),
    ):
        t = seconds(200.0, shift)
        table(folder / f"{name}.csv", "time,seconds_elapsed,z,y,x", epoch_ns(t), t[:, None], values(t)[:, reverse])
    t = seconds(200.0, 0.001)
    euler = np.zeros((len(t), 3))
    header = "time,seconds_elapsed,qz,qy,qx,qw,roll,pitch,yaw"
    table(folder / "Orientation.csv", header, epoch_ns(t), t[:, None], wxyz(t)[:, ::-1], euler)
    table(
        folder / "Barometer.csv",
        "time,seconds_elapsed,relativeAltitude,pressure",
        epoch_ns(t),
        t[:, None],
        euler[:, :2],
    )
    return folder / given


def sensor_log_motion(folder: Path) -> Path:
    """SensorLog with device motion alone, decimal commas and no gravity."""
    t = seconds()
    header = ";".join(
        [
            "loggingTime(txt)",
            xyz("motionRotationRate", unit="(rad/s)", between=";"),
            xyz("motionUserAcceleration", unit="(G)", between=";"),
            xyz("motionQuaternion", "WXYZ", "(R)", between=";"),
        ]
    )
    return table(folder / "a.csv", header, iso(t), turn(t), -own(t) / G, wxyz(t), between=";")


def another_watch(folder: Path) -> Path:
    t = seconds()
    header = ",".join(["timestamp", xyz("rotation"), xyz("accel"), xyz("gravity"), xyz("quat", "WXYZ")])
    times = [f"{START_S + each:.6f}" for each in t]
    return table(folder / "a.csv", header, times, turn(t), -own(t) / G, -down(t) / G, wxyz(t))


def android_recorder(folder: Path) -> Path:
    """Android's sensors by their names: the rotation vector without w, and the acceleration with gravity."""
    t = seconds()
    vector = wxyz(t)[:, 1:] * np.sign(wxyz(t)[:, :1])
    header = ",".join(
        ["timestamp", xyz("accelerometer_", "xyz"), xyz("gyroscope_", "xyz"), xyz("rotation_vector_", "xyz")]
    )
    return table(
        folder / "a.csv", header, [each.replace("+00:00", "Z") for each in iso(t)], own(t) + down(t), turn(t), vector
    )


def android_without_gravity(folder: Path) -> Path:
    """Two kinds of acceleration, whose difference is gravity."""
    t = seconds()
    columns = [xyz("acc_", "xyz", "_ms2"), xyz("linear_accel_", "xyz", "_m_s2"), xyz("gyro_", "xyz", "_dps")]
    header = ",".join(["timestamp", *columns, xyz("rotation_vector_", "xyzw")])
    times = [round(each * 1e3) for each in t + START_S]
    quaternion = wxyz(t)[:, [1, 2, 3, 0]]
    return table(folder / "a.csv", header, times, own(t) + down(t), own(t), np.rad2deg(turn(t)), quaternion)


def wear_os(folder: Path) -> Path:
    """A recorder of Wear OS: nanoseconds since the start of the device, and acceleration without gravity."""
    t = seconds()
    header = ",".join(
        ["Timestamp (ns)", xyz("Linear Acceleration ", "xyz", " (m/s^2)"), xyz("Rotation Vector ", "xyzw")]
    )
    times = [round((5000 + each) * 1e9) for each in t]
    return table(folder / "a.csv", "\ufeff" + header, times, own(t), wxyz(t)[:, [1, 2, 3, 0]])


def back_and_milliseconds(folder: Path) -> Path:
    """Attitude from the world to the sensor, times in milliseconds."""
    t = seconds()
    turned = attitude(t).inv().as_quat()[:, [3, 0, 1, 2]]
    header = ",".join(
        ["Time since start in ms", xyz("LINEAR ACCELERATION "), xyz("GRAVITY "), xyz("attitude.", "wxyz")]
    )
    return table(folder / "a.csv", header, np.round(t * 1e3), own(t), down(t), turned)


LAYOUTS: dict[str, Callable[[Path], Path]] = {
    "MT Manager": mt_manager,
    "OpenSense": open_sense,
    "Movella DOT": movella_dot,
    "Sensor Logger, Android": lambda folder: phone(folder, 1.0, "Accelerometer.csv"),
    "Sensor Logger, iOS": lambda folder: phone(folder, -1 / G, "Orientation.csv"),
    "SensorLog, motion only": sensor_log_motion,
    "another watch": another_watch,
    "Android recorder": android_recorder,
    "Android, two accelerations": android_without_gravity,
    "Wear OS": wear_os,
    "attitude back": back_and_milliseconds,
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_layout_is_read_as_it_was_written(tmp_path, layout):
    path = LAYOUTS[layout](tmp_path)
    assert is_watch_log(path)
    stream = read_watch_log(path, "left_wrist")
    t = stream.timestamps.numpy()
    t = t - t[0]  # all begin at their motion's first second, but for a few milliseconds
    assert len(t) > 11.9 * (60 if layout == "Movella DOT" else 100)
    assert t[-1] == pytest.approx(12.0, abs=0.03)
    R = Rotation.from_matrix(stream.R_world_imu.double().numpy())
    ends = slice(2, -2)
    assert np.rad2deg((attitude(t).inv() * R).magnitude()[ends]).max() < 0.1
    atol = 2e-3 if "Logger" in layout else 1e-3  # files at times of their own: gravity is interpolated
    np.testing.assert_allclose(stream.acc_world.numpy()[ends], free(t)[ends], atol=atol)
    np.testing.assert_allclose(stream.acc_imu.numpy()[ends], (own(t) + down(t))[ends], atol=atol)
    if stream.gyro_imu is not None:
        np.testing.assert_allclose(stream.gyro_imu.numpy()[ends], turn(t)[ends], atol=2e-3)
    assert (stream.gyro_imu is None) == (layout in ("Wear OS", "attitude back"))


def test_lost_packets_are_left_out_and_counted(tmp_path):
    log = read_watch(open_sense(tmp_path), "left_wrist")
    assert log.notes == ["3 rows without a number in every column are left out"]
    assert len(log.stream.timestamps) == len(seconds()) - 3
    assert log.stream.timestamps.diff().max().item() == pytest.approx(0.03)


def test_the_files_of_one_phone_are_one_log(tmp_path):
    phone(tmp_path, 1.0, "Gravity.csv")
    names = ["Accelerometer.csv", "Gravity.csv", "Gyroscope.csv", "Orientation.csv"]
    for name in names:
        assert [path.name for path in sensor_files(tmp_path / name)] == names
    assert not is_watch_log(tmp_path / "Barometer.csv")
    (tmp_path / "Gravity.csv").unlink()
    with pytest.raises(WearcapError, match="unit and sign are not known.*Gravity.csv"):
        read_watch_log(tmp_path / "Orientation.csv", "left_wrist")
    (tmp_path / "Orientation.csv").unlink()
    with pytest.raises(WearcapError, match="without attitude"):
        read_watch_log(tmp_path / "Accelerometer.csv", "left_wrist")


@pytest.mark.parametrize(
    ("name", "header", "lacks"),
    [
        ("phyphox.csv", '"Time (s)","Linear Acceleration x (m/s^2)","Linear Acceleration y (m/s^2)","Linear Acceleration z (m/s^2)"', "attitude and turn rate"),
        ("ptb.csv", "time,gFx,gFy,gFz,wx,wy,wz", "attitude"),
        ("andro.csv", "sep=;\nACCELEROMETER X (m/s²);ACCELEROMETER Y (m/s²);ACCELEROMETER Z (m/s²);GYROSCOPE X (rad/s);GYROSCOPE Y (rad/s);GYROSCOPE Z (rad/s);ORIENTATION Z (azimuth °);Time since start in ms ", "attitude"),
        ("WatchAccelerometer_left.csv", "time,seconds_elapsed,z,y,x", "attitude and turn rate"),
        ("Gyroscope.csv", "time,seconds_elapsed,z,y,x", "attitude and acceleration"),
        ("dot.csv", "PacketCounter,SampleTimeFine,Euler_X,Euler_Y,Euler_Z,FreeAcc_X,FreeAcc_Y,FreeAcc_Z", "attitude and turn rate"),
        ("q.csv", "time,quaternionW,quaternionX,quaternionY,quaternionZ", "acceleration and turn rate"),
    ],
)  # fmt: skip
def test_what_a_log_lacks_is_named(tmp_path, name, header, lacks):
    names = header.splitlines()[-1]
    between = ";" if ";" in names else ","
    rows = [between.join([str(at)] * len(names.split(between))) for at in np.arange(200) * 10.0]
    path = tmp_path / name
    path.write_text("\n".join([header, *rows]) + "\n")
    assert is_watch_log(path)
    with pytest.raises(WearcapError, match=f"a motion log without {lacks}\\. Expected .* Record whole motion"):
        read_watch(path, "left_wrist")


@pytest.mark.parametrize(
    "header",
    [
        "timestamp,tx,ty,tz,qx,qy,qz,qw",
        "timestamp,x,y,z,qx,qy,qz,qw",
        "t,x,y,z,qw,qx,qy,qz,vx,vy,vz,wx,wy,wz,ax,ay,az",
        "time,head.position.x,head.position.y,head.position.z,head.rotation.x,accX,accY,accZ",
        "tracking_timestamp_us,tx_world_device,ty_world_device,tz_world_device,qx_world_device,gravity_x,gravity_y,gravity_z",
        "time,pos_x,pos_y,pos_z,rot_x,rot_y,rot_z",
        "positionX,positionY,positionZ,rotationX,rotationY,rotationZ",
        "timestamp_ms,hmd_pos_x,hmd_pos_y,hmd_pos_z,hmd_rot_x",
        "timestamp_ns,ax_mps2,ay_mps2,az_mps2,gx_radps,gy_radps,gz_radps",
        "x,y,z",
    ],
)
def test_other_tables_are_no_watch_logs(tmp_path, header):
    path = tmp_path / "a.csv"
    path.write_text(header + "\n" + ",".join(["0.5"] * (header.count(",") + 1)) + "\n")
    assert not is_watch_log(path)


def vigorous(folder: Path, fix: str = "") -> Path:
    """An Xsens log with whole acceleration alone, of hard shaking."""
    t = seconds()
    header = ",".join(["PacketCounter,SampleTimeFine", xyz("Acc_"), xyz("Quat_q", "0123")])
    shaken = attitude(t).inv().apply(8 * free(t) + [0, 0, -G if fix else G])
    times = [f"{count},{round(at * 1e4)}" for count, at in enumerate(t)]
    return table(folder / "a.csv", header, times, shaken, wxyz(t))


def test_the_mean_in_the_world_decides_for_a_vigorous_sensor(tmp_path):
    stream = read_watch_log(vigorous(tmp_path), "left_wrist")
    assert stream.acc_imu.norm(dim=-1).median() > 2 * G
    np.testing.assert_allclose(stream.acc_world.numpy(), 8 * free(seconds()), atol=2e-3)
    with pytest.raises(WearcapError, match="z axis points down.*ENU"):
        read_watch_log(vigorous(tmp_path, "NED"), "left_wrist")


def test_free_acceleration_that_contradicts_the_other_is_refused(tmp_path):
    path = mt_manager(tmp_path)
    lines = path.read_text().splitlines()
    names = lines[4].split("\t")
    swap = [names.index(f"FreeAcc_{axis}") for axis in "ENU"]
    turned = [line.split("\t") for line in lines[5:]]
    for fields in turned:  # a world that is turned
        fields[swap[0]], fields[swap[1]] = fields[swap[1]], fields[swap[0]]
    path.write_text("\n".join([*lines[:5], *("\t".join(fields) for fields in turned)]) + "\n")
    with pytest.raises(WearcapError, match="free acceleration is not acceleration without gravity"):
        read_watch(path, "left_wrist")


def rows_of(path: Path) -> tuple[str, list[str]]:
    header, *rows = path.read_text().splitlines()
    return header, rows


def test_a_log_without_a_number_lacks_everything(tmp_path):
    header, rows = rows_of(another_watch(tmp_path))
    lost = [",".join([row.partition(",")[0], *["nan"] * row.count(",")]) for row in rows]
    (tmp_path / "lost.csv").write_text("\n".join([header, *lost]) + "\n")
    with pytest.raises(WearcapError, match="a motion log without attitude and acceleration"):
        read_watch(tmp_path / "lost.csv", "left_wrist")


def test_unsorted_and_repeated_rows_are_mended_and_counted(tmp_path):
    plain = another_watch(tmp_path)
    header, rows = rows_of(plain)
    truth = read_watch_log(plain, "left_wrist")
    other = rows[50].replace(",0.", ",1.", 1).replace(",-0.", ",-1.", 1)
    mended = [*rows[:20], rows[22], rows[20], rows[21], *rows[23:51], other, *rows[51:], *rows[100:140]]
    path = tmp_path / "mended.csv"
    path.write_text("\n".join([header, *mended]) + "\n")
    log = read_watch(path, "left_wrist")
    assert log.notes == [
        "2 rows are earlier than the ones before them: all are sorted by time",
        "41 rows that repeat a time are left out, 1 of them with other values",
    ]
    np.testing.assert_array_equal(log.stream.timestamps, truth.timestamps)
    np.testing.assert_array_equal(log.stream.R_world_imu, truth.R_world_imu)
    np.testing.assert_array_equal(log.stream.acc_world, truth.acc_world)


def test_two_recordings_in_one_file_are_not_mixed(tmp_path):
    header, rows = rows_of(back_and_milliseconds(tmp_path))
    path = tmp_path / "two.csv"
    for late_ms in (0.0, 3.0):  # the same clock, of which one row in two is a repeat, and another one
        later = [
            f"{float(row.partition(',')[0]) + late_ms},{other.partition(',')[2]}"
            for row, other in zip(rows, [*rows[300:], *rows[:300]])
        ]
        path.write_text("\n".join([header, *rows, *later]) + "\n")
        with pytest.raises(WearcapError, match=r"row 1201: times go back by 1[0-9.]+ s.*cut it there"):
            read_watch(path, "left_wrist")
    path.write_text("\n".join([header, *rows, *rows[400:], *rows[:400]]) + "\n")
    assert read_watch(path, "left_wrist").notes[-1] == f"{len(rows)} rows that repeat a time are left out"


def test_a_turn_rate_of_unknown_unit_is_left_out(tmp_path):
    header, rows = rows_of(another_watch(tmp_path))
    still = [",".join([row.partition(",")[0], *rows[0].split(",")[1:]]) for row in rows]
    path = tmp_path / "still.csv"
    path.write_text("\n".join([header, *still]) + "\n")
    log = read_watch(path, "left_wrist")
    assert log.stream.gyro_imu is None
    assert "unit is not known" in log.notes[0]


def test_decimal_commas_between_commas_are_refused(tmp_path):
    header, rows = rows_of(another_watch(tmp_path))
    path = tmp_path / "commas.csv"
    path.write_text("\n".join([header, *(row.replace(".", ",") for row in rows)]) + "\n")
    with pytest.raises(WearcapError, match="28 fields below a header of 14.*decimal commas"):
        read_watch(path, "left_wrist")


@pytest.mark.real
@pytest.mark.parametrize(
    "name", ["F_sensorlog_motion_only_left", "H_tennis_left", "H_watch_de_left", "C_watch_repeated_rows_left"]
)
def test_one_watch_in_different_clothes(real_data, name):
    """The same seconds of one watch's log, as several apps and languages write them."""
    plain = np.genfromtxt(real_data / "field/C_watch_repeated_rows_left.csv", delimiter=",", names=True)[::2]
    log = read_watch(real_data / "field" / f"{name}.csv", "left_wrist")
    assert log.notes == (["749 rows that repeat a time are left out"] if name.startswith("C") else [])
    count = len(plain) if name.startswith("C") else 700
    stream = log.stream
    np.testing.assert_allclose(stream.timestamps[:count].diff(), np.diff(plain["seconds_elapsed"][:count]), atol=2e-3)
    R = Rotation.from_quat(np.stack([plain[f"quaternion{axis}"] for axis in "XYZW"], 1)[:count])
    gravity, acceleration, rate = (
        np.stack([plain[f"{part}{axis}"] for axis in "XYZ"], 1)[:count]
        for part in ("gravity", "acceleration", "rotationRate")
    )
    np.testing.assert_allclose(stream.R_world_imu[:count], R.as_matrix(), atol=1e-5)
    np.testing.assert_allclose(stream.acc_world[:count], R.apply(-G * acceleration), atol=1e-4)
    np.testing.assert_allclose(stream.acc_imu[:count], -G * (acceleration + gravity), atol=1e-4)
    np.testing.assert_allclose(stream.gyro_imu[:count], rate, atol=1e-5)


@pytest.mark.real
def test_an_accelerometer_alone_says_what_to_record(real_data):
    path = real_data / "field/H_WatchAccelerometer_left.csv"
    assert is_watch_log(path)
    with pytest.raises(WearcapError, match="without attitude and turn rate.*Wrist Motion .Sensor Logger."):
        read_watch(path, "left_wrist")


@pytest.mark.real
def test_a_vigorous_watch_has_gravity_in_its_mean(real_data):
    stream = read_watch_log(real_data / "field/G_vigorous_watch_right.csv", "right_wrist")
    mean = (stream.R_world_imu @ stream.acc_imu[..., None])[..., 0].mean(0)
    assert mean[2].item() == pytest.approx(G, rel=0.1)
    assert mean[:2].norm() < 0.1 * G
