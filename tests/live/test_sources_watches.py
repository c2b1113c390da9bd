"""Watches and phones: SensorLog and Sensor Logger in every convention, whole samples and sensors apart."""

import csv
import http.client
import json
import math
from collections import Counter
from datetime import UTC, datetime

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from serving import Served

from ports import free_port
from wearcap.apps.live.packets import Packet
from wearcap.apps.live.sources import source_of
from wearcap.body.skeleton import WRISTS
from wearcap.errors import WearcapError
from wearcap.io.devices.watch_log import read_watch_log

G = 9.80665
EPOCH = 1.7e9


def moving(count: int = 150) -> list[tuple[float, Rotation, np.ndarray]]:
    """Time (s), attitude and free acceleration (m/s², world with z up) of a watch that is moved about, at 100 Hz."""
    random = np.random.default_rng(3)
    times = EPOCH + np.arange(count) / 100
    return [
        (t, Rotation.from_rotvec(1.4 * np.sin([2 * (t - EPOCH), 3.1 * (t - EPOCH), 1.3 * (t - EPOCH)])), a)
        for t, a in zip(times, random.normal(scale=3, size=(count, 3)))
    ]


def core_motion(turn: Rotation, acc: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[float]]:
    """Gravity and user acceleration (g) as Apple's devices report them, reversed, and the quaternion w x y z."""
    x, y, z, w = turn.as_quat()
    return -turn.inv().apply([0, 0, 1.0]), -turn.inv().apply(acc) / G, [w, x, y, z]


def wrist_motion(row, android: bool, back: bool) -> dict[str, float]:
    _, turn, acc = row
    gravity, free, _ = core_motion(turn, acc)
    scale = -G if android else 1.0
    x, y, z, w = (turn.inv() if back else turn).as_quat()
    values = dict(zip(("quaternionX", "quaternionY", "quaternionZ", "quaternionW"), (x, y, z, w)))
    for name, vector in (("gravity", gravity), ("acceleration", free), ("rotationRate", gravity)):
        values |= {f"{name}{axis}": scale * value for axis, value in zip("XYZ", vector)}
    return values


def posted(entries: list[dict], device: str = "abc") -> bytes:
    return json.dumps({"messageId": 1, "sessionId": "s", "deviceId": device, "payload": entries}).encode()


def feed(source, messages: list[bytes]) -> tuple[list[Packet], Counter]:
    refused: Counter = Counter()
    packets = []
    for number, data in enumerate(messages):
        packets += source.parse(data, 50.0 + number / 100, lambda why: refused.update([why]))
    return packets, refused


def assert_moving(packets: list[Packet], rows, atol: float = 1e-4) -> None:
    """The packets are the rows of the same times, but for those of the first second."""
    by_time = {round(t, 3): (turn, acc) for t, turn, acc in rows}
    assert 40 <= len(packets) <= len(rows) - 90
    for packet in packets:
        turn, acc = by_time[round(packet.sample.timestamp, 3)]
        assert np.allclose(packet.sample.R_world_imu, turn.as_matrix(), atol=atol)
        assert np.allclose(packet.sample.acc_world, acc, atol=3 * atol)


@pytest.mark.parametrize("android", [False, True])
@pytest.mark.parametrize("back", [False, True])
@pytest.mark.parametrize("nested", [False, True])
def test_sensor_logger_of_a_watch(android, back, nested):
    messages = []
    for row in moving():
        values = wrist_motion(row, android, back)
        entry = {"name": "wrist motion", "time": round(row[0] * 1e9)}
        messages.append(posted([entry | ({"values": values} if nested else values)], "left watch"))
    packets, refused = feed(source_of("watch://127.0.0.1:0"), messages)
    assert not refused
    assert_moving(packets, moving())
    assert {(packet.device, packet.sample.joint, packet.clock) for packet in packets} == {
        ("left_wrist", "left_wrist", "watch:0/left watch")
    }


@pytest.mark.parametrize("down", ["gravity", "totalAcceleration"])
def test_sensor_logger_of_a_phone_sends_its_sensors_apart(down):
    """In batches, one sensor after the other, some of whose entries are a few milliseconds off, or missing."""
    rows, messages = moving(), []
    for start in range(0, len(rows), 10):
        accelerometer, gravity_entries, orientation = [], [], []
        for number, (t, turn, acc) in enumerate(rows[start : start + 10], start):
            gravity, free, (w, x, y, z) = core_motion(turn, acc)
            gravity, free = -G * gravity, -G * free
            at = round(t * 1e9)
            other = gravity if down == "gravity" else gravity + free
            accelerometer.append({"name": "accelerometer", "time": at, "values": dict(zip("xyz", free.tolist()))})
            gravity_entries.append({"name": down, "time": at, "values": dict(zip("xyz", other.tolist()))})
            if number % 40 not in (20, 21, 22, 23, 24, 25):
                values = {"qx": x, "qy": y, "qz": z, "qw": w, "yaw": 0.0, "roll": 0.0, "pitch": 0.0}
                orientation.append({"name": "orientation", "time": str(at), "values": values})
        light = {"name": "light", "time": 1, "values": {"lux": 3}}
        messages.append(posted([*accelerometer, light, *gravity_entries, *orientation]))
    packets, refused = feed(source_of("watch"), messages)
    exact = [
        packet for packet in packets if round((packet.sample.timestamp - EPOCH) * 100) % 40 not in (19, *range(20, 27))
    ]
    by_time = {round(t, 3): (turn, acc) for t, turn, acc in rows}
    assert len(exact) > 30
    for packet in exact:
        turn, acc = by_time[round(packet.sample.timestamp, 3)]
        assert np.allclose(packet.sample.R_world_imu, turn.as_matrix(), atol=1e-4)
        assert np.allclose(packet.sample.acc_world, acc, atol=3e-4)
    assert set(refused) == {"sensors without the others"}
    assert {packet.device for packet in packets} == {"abc"}


def sensor_log(row, text: bool) -> dict[str, str | float]:
    t, turn, acc = row
    gravity, free, (w, x, y, z) = core_motion(turn, acc)
    values: dict[str, str | float] = {
        "loggingTime": datetime.fromtimestamp(t, UTC).strftime("%Y-%m-%d %H:%M:%S.%f +0000")
    }
    values |= dict(zip((f"accelerometerAcceleration{axis}" for axis in "XYZ"), (gravity + free).tolist()))
    values |= dict(zip((f"motionUserAcceleration{axis}" for axis in "XYZ"), free.tolist()))
    values |= dict(zip((f"motionQuaternion{axis}" for axis in "XYZW"), (x, y, z, w)))
    return {key: str(value) for key, value in values.items()} if text else values


@pytest.mark.parametrize("text", [False, True])
def test_sensor_log_json(text):
    messages = [json.dumps(sensor_log(row, text) | {"deviceID": "mine"}).encode() for row in moving()]
    packets, refused = feed(source_of("watch://127.0.0.1:5555?joint=right_wrist&wearer=bo"), messages)
    assert not refused
    assert_moving(packets, moving())
    assert {(packet.wearer, packet.device, packet.sample.joint) for packet in packets} == {
        ("bo", "right_wrist", "right_wrist")
    }
    lines = b"\n".join(messages)
    assert len(feed(source_of("watch"), [lines])[0]) == len(packets)


def test_sensor_log_csv_with_its_header_once():
    rows = [sensor_log(row, True) for row in moving()]
    units = {"loggingTime": "(txt)", "motionQuaternion": "(R)"}
    header = ",".join(key + units.get(key.rstrip("XYZW"), "(G)") for key in rows[0])
    lines = [",".join(row.values()).encode() for row in rows]  # type: ignore[arg-type]
    packets, refused = feed(source_of("watch"), [lines[0], header.encode(), *lines])
    assert refused == {"no header line yet": 1}
    assert_moving(packets, moving())


def test_an_app_set_to_other_units_is_found_again():
    source = source_of("watch")
    entries = [(0.0, True), (2.0, False)]
    messages = [
        posted([{"name": "wristMotion", "time": round((row[0] + late) * 1e9)} | wrist_motion(row, android, False)])
        for late, android in entries
        for row in moving(400)
    ]
    packets, refused = feed(source, messages)
    assert set(refused) == {"gravity and attitude do not agree"}
    later = [packet for packet in packets if packet.sample.timestamp > EPOCH + 4.5]
    assert len(later) > 100
    by_time = {round(t + 2, 3): acc for t, _, acc in moving(400)}
    assert all(np.allclose(p.sample.acc_world, by_time[round(p.sample.timestamp, 3)], atol=3e-4) for p in later)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"{}",
        b"[" * 60_000,
        b'{"payload": [{"name": 3}]}',
        b'{"payload": [{"name": "orientation", "time": 1, "values": {"qw": []}}]}',
        b'{"payload": [{"name": "wristmotion", "time": 1e999}], "deviceId": "a"}',
        b'{"payload": [], "deviceId": {"a": 1}}',
        b"\xff\xfe{",
        b"[1, 2, 3]",
        b'{"motionQuaternionW": true}',
        b"motionQuaternionW(R)\n1,2\n",
        b"1,2,3\n4,5,6",
    ],
)
def test_hostile_messages_are_counted(data):
    packets, refused = feed(source_of("watch"), [data])
    assert not packets
    assert sum(refused.values()) == {b"": 0, b"[1, 2, 3]": 3}.get(data, 1)


def test_an_attitude_that_does_not_fit_gravity_gives_no_packets():
    messages = []
    for row in moving():
        values = wrist_motion(row, False, False)
        values["quaternionX"], values["quaternionW"] = values["quaternionW"], values["quaternionX"]
        messages.append(posted([{"name": "wristmotion", "time": round(row[0] * 1e9)} | values]))
    packets, refused = feed(source_of("watch"), messages)
    assert not packets
    assert refused == {"gravity and attitude do not agree": 1}


def test_options():
    with pytest.raises(WearcapError, match="left_wrist"):
        source_of("watch://?joint=left")
    with pytest.raises(WearcapError, match="joint"):
        source_of("watch://?joynt=left_wrist")
    with pytest.raises(WearcapError, match="Did you mean 'watch'"):
        source_of("wach://127.0.0.1")


@pytest.mark.real
@pytest.mark.parametrize("name", ["WristMotion.csv", "NewWristMotion.csv"])
def test_a_real_watch_streams_as_its_file_is_read(real_data, name):
    path = real_data / "apple_watch_imu" / name
    stream = read_watch_log(path, WRISTS[0])
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))[:2000]
    messages = [
        posted([{"name": "wrist motion", "time": row["time"], "values": row} for row in rows[k : k + 5]])
        for k in range(0, len(rows), 5)
    ]
    packets, refused = feed(source_of("watch"), messages)
    assert not refused
    assert len(packets) > len(rows) - 130
    assert stream.acc_world is not None
    for packet in packets:
        k = int(np.abs(stream.timestamps.numpy() - packet.sample.timestamp).argmin())
        assert math.isclose(stream.timestamps[k], packet.sample.timestamp, abs_tol=1e-6)
        assert np.allclose(packet.sample.R_world_imu, stream.R_world_imu[k], atol=1e-4)
        assert np.allclose(packet.sample.acc_world, stream.acc_world[k], atol=1e-3)


def test_posts_are_taken_answered_and_guarded():
    port = free_port()
    message = posted(
        [{"name": "wristmotion", "time": round(r[0] * 1e9)} | wrist_motion(r, True, False) for r in moving()]
    )
    with Served(f"watch+http://127.0.0.1:{port}?joint=left_wrist&token=secret") as served:

        def answer(method: str, target: str, body: bytes | None = None, **headers: str) -> int:
            connection = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
            connection.request(method, target, body, {key.replace("_", "-"): value for key, value in headers.items()})
            status = connection.getresponse().status
            connection.close()
            return status

        assert answer("POST", "/data?token=secret", message) == 200
        assert answer("POST", "/data", message) == 403
        assert answer("POST", "/?token=secret", message, Origin="http://evil.example") == 403
        assert answer("POST", "/?token=secret", message, Host="evil.example") == 403
        assert answer("GET", "/?token=secret") == 405
        assert answer("POST", "/?token=secret", b"", Content_Length="9999999") == 413
        assert answer("POST", "/?token=secret", b"", Content_Length="-1") == 411
        assert answer("POST", "/?token=secret", b"x", Big="y" * 17_000) == 431
        kept = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
        for _ in range(3):
            kept.request("POST", "/?token=secret", b"no json")
            response = kept.getresponse()
            assert (response.status, response.read()) == (200, b"")
        kept.close()
    packets = served.inbox.wait(0)
    assert len(packets) == 50
    assert all(packet.device == "left_wrist" for packet in packets)
    assert served.inbox.refused[f"watch+http:{port}: no header line yet"] == 3
    assert served.inbox.refused[f"watch+http:{port}: forbidden"] == 3
