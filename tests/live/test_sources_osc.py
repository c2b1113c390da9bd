"""VMC devices and OSC trackers: poses of an independent sender come out in wearcap's axes, and hostile bytes do no harm."""

import math
import struct
from collections import Counter

import numpy as np
import pytest
from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
from pythonosc.osc_message_builder import OscMessageBuilder
from scipy.spatial.transform import Rotation

from wearcap.apps.live.packets import Packet
from wearcap.apps.live.sources import source_of

TURN = Rotation.from_rotvec([0.4, -0.7, 1.1])
PLACE = np.array([0.3, -1.2, 1.65])
"""A pose in wearcap's axes: x forward, y left, z up."""


def to_unity(turn: Rotation, place: np.ndarray) -> tuple[list[float], list[float]]:
    """Position and quaternion x y z w in Unity's axes (x right, y up, z forward), whose turns are left-handed."""
    x, y, z, w = turn.as_quat()
    return [-place[1], place[2], place[0]], [y, -z, -x, w]


def message(address: str, *values) -> bytes:
    builder = OscMessageBuilder(address)
    for value in values:
        builder.add_arg(value)
    return builder.build().dgram


def bundle(*parts: bytes) -> bytes:
    """A bundle whose time is "at once", written by hand."""
    return b"#bundle\0" + struct.pack(">Q", 1) + b"".join(struct.pack(">i", len(part)) + part for part in parts)


def device(kind: str, serial: str, turn: Rotation = TURN, place: np.ndarray = PLACE) -> bytes:
    p, q = to_unity(turn, place)
    return message(f"/VMC/Ext/{kind}", serial, *map(float, (*p, *q)))


def parsed(source, data: bytes, at: float = 100.0) -> tuple[list[Packet], Counter]:
    refused: Counter = Counter()
    return source.parse(data, at, lambda why: refused.update([why])), refused


def near(packet: Packet, turn: Rotation = TURN, place: np.ndarray = PLACE) -> bool:
    pose = getattr(packet.sample, "T_world_device", None) or packet.sample.T_world_joint
    return np.allclose(pose.R, turn.as_matrix(), atol=1e-4) and np.allclose(pose.t, place, atol=1e-4)


def test_devices_of_a_bundle_in_our_axes_with_its_time():
    source = source_of("vmc://127.0.0.1:0?wearer=anna")
    builder = OscBundleBuilder(IMMEDIATELY)
    for kind, serial in (("Hmd/Pos", "HMD-1"), ("Con/Pos", "LeftHand"), ("Tra/Pos", "LHR-123")):
        p, q = to_unity(TURN, PLACE)
        inner = OscMessageBuilder(f"/VMC/Ext/{kind}")
        for value in (serial, *map(float, (*p, *q))):
            inner.add_arg(value)
        builder.add_content(inner.build())
    timed = OscMessageBuilder("/VMC/Ext/T")
    timed.add_arg(12.5)
    builder.add_content(timed.build())
    packets, refused = parsed(source, builder.build().dgram)
    assert [packet.device for packet in packets] == ["head", "left_wrist", "LHR-123"]
    assert all(near(packet) for packet in packets)
    assert {(packet.wearer, packet.sent_s, packet.sample.timestamp) for packet in packets} == {("anna", 12.5, 12.5)}
    assert packets[1].sample.joint == "left_wrist"
    assert not refused


def test_unity_looks_where_we_look():
    """Unity's 90° about its y (up) turns forward to the right; ours is then -90° about z."""
    half = math.sqrt(0.5)
    data = message("/VMC/Ext/Hmd/Pos", "HMD", 0.0, 1.7, 2.0, 0.0, half, 0.0, half)
    (packet,), _ = parsed(source_of("vmc"), data)
    assert np.allclose(packet.sample.T_world_device.R @ np.array([1.0, 0, 0], "f4"), [0, -1, 0], atol=1e-6)
    assert np.allclose(packet.sample.T_world_device.t, [2.0, 0.0, 1.7])


def test_a_time_before_the_poses_stands_for_one_of_each():
    source = source_of("vmc")
    assert parsed(source, device("Hmd/Pos", "h"))[0][0].sent_s is None
    parsed(source, message("/VMC/Ext/T", 7.0))
    assert parsed(source, device("Hmd/Pos", "h"))[0][0].sent_s == 7.0
    assert parsed(source, device("Con/Pos", "c"))[0][0].sent_s == 7.0
    packet = parsed(source, device("Hmd/Pos", "h"), 101.0)[0][0]
    assert (packet.sent_s, packet.sample.timestamp) == (None, 101.0)


def test_poses_in_the_tracking_space_stand_in_for_missing_ones():
    source = source_of("vmc")
    other = PLACE + 1
    both = bundle(device("Hmd/Pos/Local", "h", place=other), device("Hmd/Pos", "h"))
    (packet,), _ = parsed(source, both, 0.0)
    assert near(packet)
    alone = device("Tra/Pos/Local", "t", place=other)
    assert parsed(source, alone, 1.0)[0] == []
    (packet,), _ = parsed(source, alone, 2.0)
    assert near(packet, place=other)


@pytest.mark.parametrize(
    ("serial", "expected"),
    [
        ("Controller (Right)", "right_wrist"),
        ("right_wrist", "right_wrist"),
        ("LeftFoot", "LeftFoot"),
        ("LHR-FF", "LHR-FF"),
        ("head", "tracker head"),
    ],
)
def test_serials_name_wrists_only_plainly(serial, expected):
    (packet,), _ = parsed(source_of("vmc"), device("Tra/Pos", serial))
    assert (packet.device, packet.sample.joint) == (expected, expected)


def test_an_unseen_headset_is_lost_and_an_unseen_tracker_nothing():
    zero = (0.0,) * 6
    data = bundle(message("/VMC/Ext/Hmd/Pos", "h", *zero, 1.0), message("/VMC/Ext/Tra/Pos", "t", *zero, 1.0))
    packets, refused = parsed(source_of("vmc"), data)
    assert [(packet.device, packet.sample.T_world_device) for packet in packets] == [("head", None)]
    assert refused == {"not tracked": 2}


@pytest.mark.parametrize(
    ("values", "why"),
    [
        (("h", math.nan, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), "not finite"),
        (("h", 0.0, 0.0, 0.0, math.inf, 0.0, 0.0, 1.0), "not finite"),
        (("h", 1e30, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), "out of range"),
        (("h", 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.3), "not a rotation"),
        (("h", 1.0, 0.0), "wrong arguments"),
        (("h", *"1234567"), "wrong arguments"),
    ],
)
def test_bad_values_are_counted(values, why):
    packets, refused = parsed(source_of("vmc"), message("/VMC/Ext/Hmd/Pos", *values))
    assert not packets
    assert refused == {why: 1}


def test_what_is_not_known_is_passed_over():
    data = bundle(message("/VMC/Ext/OK", 1), message("/VMC/Ext/Bone/Pos", "Hips", *(0.0,) * 7), device("Hmd/Pos", "h"))
    packets, refused = parsed(source_of("vmc"), data)
    assert len(packets) == 1
    assert not refused


def test_a_bomb_of_bundles_does_not_go_off():
    deep = b""
    for _ in range(3000):
        deep = bundle(deep) if deep else bundle()
    assert len(deep) < 65_536
    assert parsed(source_of("vmc"), deep)[1] == {"bundles nested too deeply": 1}
    endless = b"#bundle\0" + struct.pack(">Qi", 1, -4) + b"\0" * 8
    assert parsed(source_of("vmc"), endless)[1] == {"no OSC": 1}
    many = bundle(*[message("/x")] * 3000)
    assert parsed(source_of("vmc"), many)[1] == {"too many messages": 1}


def test_serials_do_not_fill_the_memory():
    source = source_of("vmc")
    refused = Counter()
    for number in range(500):
        refused += parsed(source, device("Tra/Pos", f"serial {number}"))[1]
    assert refused == {"too many devices": 500 - 64}
    assert parsed(source, device("Tra/Pos", "later"), 200.0)[0]


def test_trackers_that_come_and_go_are_forgotten():
    """Ever other serials in the tracking space, far more of them than are remembered."""
    source = source_of("vmc")
    for number in range(300):
        data = device("Tra/Pos/Local", f"serial {number}")
        packets = [packet for late in (0, 1, 2) for packet in parsed(source, data, 100.0 * number + late)[0]]
        assert packets
        assert all(near(packet) for packet in packets)


def unity_euler(turn: Rotation, place: np.ndarray) -> tuple[list[float], list[float]]:
    """Position and Euler degrees (x, y, z) as Unity's Transform has them: turned about z, then x, then y."""
    p, q = to_unity(turn, place)
    y, x, z = Rotation.from_quat(q).as_euler("YXZ", degrees=True)
    return p, [x, y, z]


def tracker(name: str, half: str, values) -> bytes:
    return message(f"/tracking/trackers/{name}/{half}", *map(float, values))


def test_trackers_in_our_axes():
    source = source_of("osctrackers")
    p, e = unity_euler(TURN, PLACE)
    halves = [tracker(name, half, v) for name in ("head", "3") for half, v in (("position", p), ("rotation", e))]
    packets, refused = parsed(source, bundle(*halves))
    assert [packet.device for packet in packets] == ["head", "tracker3"]
    assert all(near(packet) and packet.sent_s is None for packet in packets)
    assert not refused


def test_halves_of_one_frame_are_paired():
    """After a lost half, poses are never put together from two frames while whole frames come."""
    source = source_of("osctrackers")
    got = []
    for frame in range(20):
        turn, place = TURN * Rotation.from_rotvec([0, 0, 0.1 * frame]), PLACE + 0.1 * frame
        p, e = unity_euler(turn, place)
        for number, data in enumerate((tracker("1", "position", p), tracker("1", "rotation", e))):
            if (frame, number) not in ((0, 0), (7, 0), (12, 1)):
                for packet in parsed(source, data, frame / 60 + 1e-4 * number)[0]:
                    assert near(packet, turn, place)
                    got.append(frame)
    assert got == [frame for frame in range(20) if frame not in (0, 7, 12)]


def test_a_tracker_that_only_turns_is_heard():
    source = source_of("osctrackers")
    p, e = unity_euler(TURN, PLACE)
    parsed(source, tracker("2", "position", p), 0.0)
    packets = [packet for k in range(1, 20) for packet in parsed(source, tracker("2", "rotation", e), k / 60)[0]]
    assert packets
    assert all(near(packet) for packet in packets)


def test_bad_trackers_are_counted():
    source = source_of("osctrackers")
    p, _ = unity_euler(TURN, PLACE)
    data = bundle(
        tracker("1", "position", p), tracker("1", "rotation", [1e9, 0, 0]), tracker("2", "position", [math.nan] * 3)
    )
    packets, refused = parsed(source, data)
    assert not packets
    assert refused == {"out of range": 1, "not finite": 1}
