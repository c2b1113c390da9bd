"""Fingers in a live capture: JSON and MVN hands in, finger joints out at the capture's rate."""

import json
import struct
from dataclasses import replace

import mvn_datagrams as mvn
import numpy as np
import torch
from scipy.spatial.transform import Rotation
from test_live_capture import Kept, small_hmd2, swaying

import planted_hands as planted
from wearcap.apps.live.capture import LiveCapture
from wearcap.apps.live.packets import HEAD, Inbox, Packet
from wearcap.apps.live.setup import Known
from wearcap.apps.live.sinks.vmc import BONES, FINGER_BONES, bones_of
from wearcap.apps.live.sinks.websocket import _frame
from wearcap.apps.live.source import Address, Source
from wearcap.apps.live.sources import source_of
from wearcap.apps.live.sources.mvn import FINGER_SEGMENTS
from wearcap.apps.live.sources.replay import ReplaySource
from wearcap.body.hands import FINGER_NAMES, HAND_JOINTS, MEDIAPIPE, OPENXR
from wearcap.geometry.rotation import geodesic
from wearcap.io.devices.headset_axes import CONVENTIONS
from wearcap.recording import FingerStream
from wearcap.tracking.fingers import fit_hand, with_fingers


def message(places: np.ndarray, names, side="left", **more) -> bytes:
    joints = np.nan_to_num(planted.at(places[None], names)[0]).tolist()
    return json.dumps({"device": f"{side}_hand", "joints": joints, **more}).encode()


def whole(parts: list[FingerStream]) -> FingerStream:
    rows = {name: [getattr(part, name) for part in parts] for name in vars(parts[0])}
    return FingerStream(**{name: None if row[0] is None else torch.cat(row) for name, row in rows.items()})


def test_json_hands_in_every_layout_and_axes():
    angles = planted.moving(5)
    places = planted.joints(angles, "left")
    for names, axes in ((OPENXR, "unity"), (HAND_JOINTS, "openxr"), (MEDIAPIPE, "wearcap")):
        M = torch.eye(3) if axes == "wearcap" else CONVENTIONS[axes]
        turned, refused = places @ M.double().numpy(), []
        packets = [
            source_of("json").parse(message(each, names, axes=axes, time=k / 30), 1.0, refused.append)[0]
            for k, each in enumerate(turned)
        ]
        samples = [packet.sample for packet in packets]
        assert not refused
        assert {packet.device for packet in packets} == {"left_hand"}
        fitted = fit_hand(whole([sample.joints for sample in samples]), "left")
        assert np.degrees(np.abs(fitted.angles.numpy() - angles)).max() < 1.0
    refused = []
    for bad in (
        {"joints": [[0, 0, 0]] * 22},
        {"joints": [[0, 0, float("inf")]] * 26},
        {"joints": "x"},
        {"confidence": 7, "joints": [[0, 0, 0]] * 21},
    ):
        assert not source_of("json").parse(json.dumps({"device": "left_hand", **bad}).encode(), 1.0, refused.append)
    assert len(refused) == 4
    (lost,) = source_of("json").parse(b'{"device": "right_hand", "lost": true}', 1.0, refused.append)
    assert not lost.sample.joints.valid.any()


class WithHands(Source):
    """A recording's head, and left hands beside it that are later lost."""

    scheme, port, hz, convention, lossless = "scripted", 0, 60.0, "ours", True

    def __init__(self, recording, kind, angles):
        super().__init__(Address("scripted", "127.0.0.1", 0))
        self.replay, self.places = ReplaySource(recording, kind, float("inf")), planted.joints(angles, "left")

    async def run(self, inbox: Inbox) -> None:
        json_source = source_of("json")
        for k, (sent_s, device, sample) in enumerate(self.replay.events()):
            inbox.deliver([Packet("", device, "clock", sent_s, sent_s, sample)])
            if 5 <= k < 100:
                inbox.deliver(
                    [
                        packet._replace(clock="clock")
                        for packet in json_source.parse(
                            message(self.places[k], HAND_JOINTS, time=sent_s), sent_s, print
                        )
                    ]
                )


def test_a_live_capture_has_the_hands_fingers_at_its_own_rate():
    system, recording, angles = small_hmd2(), swaying(), planted.moving(200)
    kept, source = Kept(), WithHands(recording, system.session_class(), angles)
    begun = []
    kept.begin = lambda wearer, skeleton, fps: begun.append(len(skeleton))
    LiveCapture(system, [source], [kept], known=Known(setup=source.replay.setup)).run(60.0)
    motion = kept.motion("wearer") if "wearer" in kept.pieces else kept.motion()
    assert begun[-1] == 53
    assert len(motion) == len(system(recording, 0))
    joint = motion.skeleton.index("left_index2")
    bend = -Rotation.from_matrix(motion.R_parent_joint[:, joint].numpy()).as_rotvec()[:, 0]
    measured = motion.fingers_measured[:, 0].bool().numpy()
    assert measured[10:95].all()
    assert not measured[105:].any()
    assert not motion.fingers_measured[:, 1].any()
    assert np.degrees(np.abs(bend - angles[: len(bend), 1, 3])[10:95]).max() < 1.0
    assert np.ptp(bend[120:]) < 1e-4
    assert bones_of(motion)[0].shape[1] == len(BONES) + len(FINGER_BONES)
    assert json.loads(_frame("", motion, 20, {}))["fingers_measured"] == [True, False]
    assert HEAD == "head"


def test_a_replay_has_the_recordings_fingers():
    system, angles = small_hmd2(), planted.moving(150)
    recording = swaying()
    stream = planted.stream(planted.carried(planted.joints(angles, "right")))
    recording = replace(recording, fingers={"right": stream})
    kept, source = Kept(), ReplaySource(recording, system.session_class(), float("inf"))
    LiveCapture(system, [source], [kept], known=Known(setup=source.setup)).run(60.0)
    motion, expected = kept.motion(), with_fingers(system(recording, 0), recording.fingers)
    torch.testing.assert_close(motion.timestamps, expected.timestamps)
    assert motion.fingers_measured is not None and expected.fingers_measured is not None  # noqa: PT018
    rows = slice(5, None)  # samples before the head's first have no clock yet
    torch.testing.assert_close(motion.fingers_measured[rows], expected.fingers_measured[rows])
    assert expected.fingers_measured[rows, 1].sum() > 100
    off = geodesic(motion.R_parent_joint[rows, -30:].double(), expected.R_parent_joint[rows, -30:].double())
    assert torch.rad2deg(off).max() < 0.5


def test_mvn_gloves():
    angles = planted.moving(4)
    source, samples = source_of("mvn"), []
    for datagram in mvn.size():
        source.parse(datagram, 0.0, print)
    for k in range(4):
        quat, position = mvn.posed(k)
        items = [struct.pack(">i3f4f", n + 1, *position[n], *quat[n]) for n in range(23)]
        number = 24
        for side in ("left", "right"):
            places = planted.joints(angles[k : k + 1], side)[0]
            for name in FINGER_SEGMENTS:
                turn, at = Rotation.identity(), np.nan_to_num(places[HAND_JOINTS.index(name)])
                if name.endswith("_distal"):
                    y = places[HAND_JOINTS.index(name.replace("distal", "tip"))] - at
                    y = y / np.linalg.norm(y) * (1 if side == "left" else -1)
                    x = np.cross(y, [0.3, 0.2, 0.9])
                    turn = Rotation.from_matrix(
                        np.stack([x / np.linalg.norm(x), y, np.cross(x / np.linalg.norm(x), y)], 1)
                    )
                items.append(struct.pack(">i3f4f", number, *at, *turn.as_quat()[[3, 0, 1, 2]]))
                number += 1
        payload = b"".join(items)
        head = struct.pack(">6sIBBI", b"MXTP02", k + 1, 0x80, len(items), 10 * k)
        data = head + struct.pack(">BBBBHH", 0, 23, 0, 40, 0, len(payload) % 65536) + payload
        packets = source.parse(data, 2.0 + k, print)
        assert [packet.device for packet in packets] == ["suit", "left_hand", "right_hand"]
        samples.append([packet.sample for packet in packets[1:]])
    for n, side in enumerate(("left", "right")):
        hand = whole([row[n].joints for row in samples])
        off = np.degrees(np.abs(fit_hand(hand, side).angles.numpy() - angles))
        assert off.max() < 1.0
    assert len(FINGER_NAMES) == 5
