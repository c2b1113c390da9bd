"""wearcap's own JSON over UDP and WebSocket."""

import contextlib
import json
import math
import socket
from collections import Counter

import numpy as np
import pytest
import websockets.sync.client
from scipy.spatial.transform import Rotation
from serving import Served
from websockets.exceptions import ConnectionClosed, InvalidStatus

from ports import free_port
from wearcap.apps.live.packets import Packet
from wearcap.apps.live.sources import SOURCES, source_of
from wearcap.errors import WearcapError
from wearcap.sensors.samples import ActiveObject, HeadSample, LocalizationSample, ObjectSample, WatchSample, WristSample

TURN = Rotation.from_rotvec([0.4, -0.7, 1.1])
PLACE = [0.3, -1.2, 1.65]
WXYZ = TURN.as_quat()[[3, 0, 1, 2]].tolist()
POSE = {"position": PLACE, "rotation_wxyz": WXYZ}


def parsed(*messages: dict | bytes, url: str = "json") -> tuple[list[Packet], Counter]:
    refused: Counter = Counter()
    source, packets = source_of(url), []
    for message in messages:
        data = message if isinstance(message, bytes) else json.dumps(message).encode()
        packets += source.parse(data, 100.0, lambda why: refused.update([why]))
    return packets, refused


def test_every_kind_of_device():
    packets, refused = parsed(
        {"device": "head", "time": 5, "floor": 0.1, "points": [[1, 2, 3], [4.5, 5, 6]], **POSE},
        {"device": "head", "time": 6, "lost": True},
        {"device": "left_wrist", "wearer": "anna", **POSE},
        {"device": "watch 7", "clock": "w", "acceleration": [1, 2, 3], "rotation_wxyz": WXYZ},
        {"device": "camera", "confidence": 0.5, "position": PLACE, "matrix": TURN.as_matrix().tolist()},
        url="json://127.0.0.1:9100?wearer=bo",
    )
    assert not refused
    head, lost, wrist, watch, camera = (packet.sample for packet in packets)
    kinds = (HeadSample, HeadSample, WristSample, WatchSample, LocalizationSample)
    assert tuple(map(type, (head, lost, wrist, watch, camera))) == kinds
    for pose in (head.T_world_device, wrist.T_world_joint, camera.T_world_cam):
        assert np.allclose(pose.R, TURN.as_matrix(), atol=1e-6)
        assert np.allclose(pose.t, PLACE)
    assert (head.timestamp, head.floor_height, head.points_world.tolist()) == (5.0, 0.1, [[1, 2, 3], [4.5, 5, 6]])
    assert (lost.timestamp, lost.T_world_device) == (6.0, None)
    assert wrist.timestamp == 100.0
    assert (watch.joint, watch.acc_world.tolist(), camera.confidence) == ("watch 7", [1, 2, 3], 0.5)
    assert np.allclose(watch.R_world_imu, TURN.as_matrix(), atol=1e-6)
    assert [packet.wearer for packet in packets] == ["bo", "bo", "anna", "bo", "bo"]
    assert [packet.sent_s for packet in packets] == [5.0, 6.0, None, None, None]
    assert packets[3].clock == "json:9100/w"


@pytest.mark.parametrize(
    ("axes", "columns", "sign"),
    [("unity", [[0, -1, 0], [0, 0, 1], [1, 0, 0]], -1), ("openxr", [[0, -1, 0], [0, 0, 1], [-1, 0, 0]], 1)],
)
def test_other_axes(axes, columns, sign):
    """Unity: x right, y up, z forward, turns left-handed. OpenXR: z backward, right-handed."""
    C = np.array(columns, float)
    turn = Rotation.from_rotvec(sign * C @ TURN.as_rotvec())
    x, y, z, w = turn.as_quat()
    message = {"device": "head", "axes": axes, "position": (C @ PLACE).tolist(), "rotation_wxyz": [w, x, y, z]}
    floor = {"points": [(C @ PLACE).tolist()]}
    watch = {"device": "w", "axes": axes, "rotation_wxyz": [w, x, y, z], "acceleration": (C @ [1, 2, 3]).tolist()}
    (head, felt), refused = parsed(message | floor, watch)
    assert not refused
    assert np.allclose(head.sample.T_world_device.R, TURN.as_matrix(), atol=1e-5)
    assert np.allclose(head.sample.T_world_device.t, PLACE, atol=1e-5)
    assert np.allclose(head.sample.points_world, [PLACE], atol=1e-5)
    assert np.allclose(felt.sample.R_world_imu, TURN.as_matrix(), atol=1e-5)
    assert np.allclose(felt.sample.acc_world, [1, 2, 3], atol=1e-5)


def test_objects_and_which_is_active():
    packets, refused = parsed(
        {"object": "box_1", "time": 5, "wearer": "anna", "clock": "c", **POSE},
        {"active_object": "box_1", "time": 4},
        {"active_object": None, "device": None},
        {"active_object": ""},
    )
    assert not refused
    seen, chosen, none, nothing = packets
    assert isinstance(seen.sample, ObjectSample)
    assert (seen.device, seen.wearer, seen.clock, seen.sent_s) == ("object box_1", "anna", "json:9100/c", 5.0)
    assert (seen.sample.name, seen.sample.timestamp) == ("box_1", 5.0)
    assert np.allclose(seen.sample.T_world_object.R, TURN.as_matrix(), atol=1e-6)
    assert np.allclose(seen.sample.T_world_object.t, PLACE)
    assert (chosen.device, chosen.sent_s, chosen.sample) == ("object", 4.0, ActiveObject("box_1", 4.0))
    assert (none.sent_s, none.sample) == (None, ActiveObject(None, 100.0))
    assert nothing.sample == ActiveObject(None, 100.0)


@pytest.mark.parametrize(
    ("message", "why"),
    [
        ({"object": "box_1"}, "no pose"),
        ({"object": "box_1", "position": PLACE}, "no pose"),
        ({"object": "box_1", "position": [1e5, 2, 3], "rotation_wxyz": WXYZ}, "out of range"),
        ({"object": "box_1", "position": PLACE, "rotation_wxyz": [1, 1, 0, 0]}, "not a rotation"),
        ({"object": "box_1", "axes": "opengl", **POSE}, "unknown axes"),
        ({"object": "x" * 65, **POSE}, "no name"),
        ({"object": 7, **POSE}, "no name"),
        ({"object": None, **POSE}, "no device"),
        ({"active_object": ["box_1"]}, "no name"),
        ({"active_object": "box\n1"}, "no name"),
        ({"active_object": "box_1", "time": math.nan}, "not finite"),
        ({"active_object": "box_1", "object": "box_1", **POSE}, "more than one of device, object and active_object"),
        ({"active_object": None, "device": "head", **POSE}, "more than one of device, object and active_object"),
        ({"object": "box_1", "device": "head", **POSE}, "more than one of device, object and active_object"),
    ],
)
def test_bad_objects_are_counted(message, why):
    assert parsed(message) == ([], {why: 1})


def test_names_of_objects_are_bounded_in_number():
    packets, refused = parsed(
        *({"object": f"box_{number}", **POSE} for number in range(60)),
        *({"active_object": f"box_{number}"} for number in range(58, 70)),
    )
    assert len(packets) == 60 + 6
    assert refused == {"too many devices": 6}


def test_lines_of_one_message():
    line = json.dumps({"device": "head", **POSE}).encode()
    packets, refused = parsed(b"\n".join([line, b"", b"broken", line]))
    assert len(packets) == 2
    assert refused == {"no JSON object": 1}


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"position": None}, "no pose"),
        ({"position": [1, 2]}, "wrong type or shape"),
        ({"position": ["1", 2, 3]}, "wrong type or shape"),
        ({"position": [True, 2, 3]}, "wrong type or shape"),
        ({"position": [1e300, 2, 3]}, "not finite"),
        ({"position": [1e5, 2, 3]}, "out of range"),
        ({"rotation_wxyz": [math.nan, 0, 0, 0]}, "not finite"),
        ({"rotation_wxyz": [1, 1, 0, 0]}, "not a rotation"),
        ({"rotation_wxyz": None, "matrix": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "not a rotation"),
        ({"rotation_wxyz": None, "matrix": [[1, 0, 0], [0, 1, 0]]}, "wrong type or shape"),
        ({"rotation_wxyz": None}, "no pose"),
        ({"time": "now"}, "wrong type or shape"),
        ({"time": True}, "wrong type or shape"),
        ({"time": 1e300}, "out of range"),
        ({"device": None}, "no device"),
        ({"device": "suit"}, "no device"),
        ({"device": ["head"]}, "no name"),
        ({"device": "x" * 65}, "no name"),
        ({"wearer": "a\nb"}, "no name"),
        ({"axes": "opengl"}, "unknown axes"),
        ({"axes": ["unity"]}, "unknown axes"),
        ({"floor": math.inf}, "not finite"),
        ({"points": [[1, 2, 3], [1, 2]]}, "wrong type or shape"),
        ({"points": [[1, 2, 3e38 * 10]]}, "not finite"),
        ({"points": [["1", 2, 3]]}, "wrong type or shape"),
        ({"points": 7}, "wrong type or shape"),
    ],
)
def test_bad_values_are_counted(change, why):
    packets, refused = parsed({"device": "head", **POSE, **change})
    assert not packets
    assert refused == {why: 1}


def test_unknown_keys_are_counted_and_passed_over():
    packets, refused = parsed({"device": "head", "colour": "red", **POSE})
    assert len(packets) == 1
    assert refused == {"unknown key": 1}


def test_hostile_text_is_counted():
    texts = (b"[" * 60_000, b'{"a":' * 10_000, b"1" * 60_000, b"\xff", b"[]", b'"head"', b"{" * 60_000)
    assert parsed(*texts) == ([], {"no JSON object": len(texts)})


def test_datagrams_over_a_socket():
    port = free_port(socket.SOCK_DGRAM)
    with Served(f"json://127.0.0.1:{port}") as served, socket.socket(type=socket.SOCK_DGRAM) as sender:
        for number in range(100):
            message = {"device": "head", "time": number / 60, **POSE}
            sender.sendto(json.dumps(message).encode(), ("127.0.0.1", port))
        packets = served.packets(100)
    assert [packet.sent_s for packet in packets] == [number / 60 for number in range(100)]


def test_a_websocket_delivers_and_keeps_its_limits():
    port = free_port()
    message = json.dumps({"device": "head", **POSE})
    points = json.dumps({"device": "head", "points": [[0.123456, 1.5, 2.5]] * 20_000, **POSE})
    assert len(points) > 1 << 16
    with Served(f"ws://127.0.0.1:{port}") as served:
        with websockets.sync.client.connect(f"ws://127.0.0.1:{port}/") as adapter:
            adapter.send(message)
            adapter.send(points)
            adapter.send(message.encode())
            adapter.send("x" * 70_000)
            packets = served.packets(4, 2.0)
        with websockets.sync.client.connect(f"ws://127.0.0.1:{port}/") as adapter:
            with contextlib.suppress(ConnectionClosed):
                adapter.send("x" * 1_100_000)
            with pytest.raises(ConnectionClosed):
                adapter.recv(timeout=5)
    assert len(packets) == 3
    assert packets[1].sample.points_world.shape == (20_000, 3)
    assert served.inbox.refused == {f"ws:{port}: too large": 1}


def status_of(url: str, **options) -> int:
    """Status of a handshake; 101 where it succeeds."""
    try:
        with websockets.sync.client.connect(url, **options):
            return 101
    except InvalidStatus as refused:
        return refused.response.status_code


def test_a_websocket_is_guarded():
    port = free_port()
    with Served(f"ws://127.0.0.1:{port}?token=secret") as served:
        assert status_of(f"ws://127.0.0.1:{port}/?token=secret") == 101
        assert status_of(f"ws://127.0.0.1:{port}/?token=other") == 403
        assert status_of(f"ws://127.0.0.1:{port}/") == 403
        assert status_of(served.source.url) == 101
        foreign = {"origin": "http://evil.example"}
        assert status_of(served.source.url, **foreign) == 403
        assert status_of(served.source.url, origin=f"http://127.0.0.1:{port}") == 101
    assert served.error is None


def test_beyond_this_machine_a_token_is_made():
    source = source_of("ws://0.0.0.0:0")
    assert source.token
    assert source.token in source.url
    assert not source_of("ws").token


def test_a_port_in_use_is_one_line():
    for scheme, kind in (("ws", socket.SOCK_STREAM), ("watch+http", socket.SOCK_STREAM), ("json", socket.SOCK_DGRAM)):
        with socket.socket(type=kind) as taken:
            taken.bind(("127.0.0.1", 0))
            if kind == socket.SOCK_STREAM:
                taken.listen()
            with Served(f"{scheme}://127.0.0.1:{taken.getsockname()[1]}") as served:
                pass
            assert isinstance(served.error, WearcapError)
            assert "cannot listen" in str(served.error)


def test_every_source_has_an_address_and_words_for_it():
    ports = [source.port for source in SOURCES.values()]
    assert len(set(ports)) == len(ports)
    for scheme, source in SOURCES.items():
        assert source_of(scheme).address.port == source.port
        assert source.convention
        assert source_of(f"{scheme}://127.0.0.1:1?wearer=anna").wearer == "anna"
        with pytest.raises(WearcapError, match="no option 'colour'"):
            source_of(f"{scheme}://127.0.0.1?colour=red")
