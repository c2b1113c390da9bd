"""Objects live: which one is active, where it is seen, and where it goes."""

import json
import math
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from pythonosc.osc_packet import OscPacket
from test_live_capture import UNITY, Kept
from websockets.sync.client import connect

from carried_box import boxes, carrying, drawn_echo
from ports import free_port, listens
from wearcap.apps.live import wearer as wearer_module
from wearcap.apps.live.capture import LiveCapture
from wearcap.apps.live.packets import HEAD, OBJECT, Packet
from wearcap.apps.live.setup import Known, Setup
from wearcap.apps.live.sink import Sink
from wearcap.apps.live.sinks.objects import objects_of
from wearcap.apps.live.sinks.vmc import VmcSink
from wearcap.apps.live.sinks.websocket import WebSocketSink
from wearcap.apps.live.source import Address
from wearcap.apps.live.sources import source_of
from wearcap.apps.live.sources.replay import ReplaySource
from wearcap.apps.live.wearer import LiveWearer, Opener
from wearcap.body.skeleton import xsens23
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import matrix_from_quat_wxyz, quat_wxyz_from_matrix
from wearcap.io.formats.environment import write_environment
from wearcap.recording import Motion, Recording
from wearcap.recording.active_objects import active_at
from wearcap.runtime.system import CaptureInput
from wearcap.runtime.wearer import Wearer
from wearcap.sensors.samples import ActiveObject, HeadSample, ObjectSample
from wearcap.systems.echo.stream import EchoSession
from wearcap_testing import swaying_motion

TWO = (("box_1", "left", 0.1, 0.4), ("box_2", "right", 0.7, 0.9))
ACTS = [
    {"object": "box_1", "start_s": 0.2, "stop_s": 0.5},
    {"object": "box_2", "start_s": 0.4, "stop_s": 0.45},
    {"object": "box_2", "start_s": 0.8, "stop_s": 9.0},
]
"""One within another, and a while without any."""


def placed(folder: Path, seconds: float = 1.2) -> CaptureInput:
    """A walk with two boxes, and the file of the boxes."""
    write_environment(boxes(TWO), folder / "scene")
    walk = replace(carrying(seconds, carried=TWO), environment="scene/environment.json")
    return CaptureInput.in_dataset(walk, folder)


@pytest.mark.parametrize("settings", [{}, {"active_objects": ACTS, "placed": True}])
def test_a_replay_gives_the_offline_capture_with_its_objects(settings, tmp_path: Path):
    system, place, kept = drawn_echo(**settings), placed(tmp_path), Kept()
    source = ReplaySource(place.recording, EchoSession, math.inf, objects=EchoSession.of_objects(system, place))
    report = LiveCapture(system, [source], [kept], source=place, known=Known(setup=source.setup)).run(120.0)
    motion, whole = kept.motion(), system(place, 0)
    torch.testing.assert_close(motion.timestamps, whole.timestamps, atol=1e-6, rtol=0)
    torch.testing.assert_close(motion.T_world_joint.t, whole.T_world_joint.t, atol=1e-3, rtol=0)
    torch.testing.assert_close(motion.body_contact_prob, whole.body_contact_prob, atol=1e-3, rtol=0)
    spans = system.scenario(place.recording, system.objects(place)).active_objects
    names = ["box_1", "box_2"]
    active = active_at(spans, names, whole.timestamps)
    assert set(motion.object_motion) == set(names)
    for number, name in enumerate(names):
        # A stream has an object's pose while it is active, a capture of the whole recording always.
        found, given = motion.object_motion[name], whole.object_motion[name][active == number]
        torch.testing.assert_close(found.timestamps, given.timestamps, atol=1e-6, rtol=0)
        torch.testing.assert_close(found.t_world_body, given.t_world_body, atol=1e-3, rtol=0)
        torch.testing.assert_close(found.R_world_body, given.R_world_body, atol=1e-3, rtol=0)
    about = report["wearers"]["wearer"]
    assert not any(about[name] for name in ("dropped", "late", "refused", "unknown"))
    assert not [note for note in about["notes"] if "box" in note]


def test_a_replay_of_a_walk_without_interactions_names_no_object(tmp_path: Path):
    place = placed(tmp_path)
    bare = replace(place, recording=replace(place.recording, interactions=None, object_motion={}))
    assert EchoSession.of_objects(drawn_echo(), bare) == []
    assert EchoSession.of_objects(drawn_echo(active_objects="none"), place) == []


def test_a_users_own_environment_needs_no_recording(tmp_path: Path):
    write_environment(boxes(TWO), tmp_path / "flat")
    capture = LiveCapture(drawn_echo(environment=str(tmp_path / "flat")), [], [])
    assert [item.name for item in capture.objects] == ["box_1", "box_2"]
    capture.opener.session(Wearer(xsens23())).streams[0].activate("box_2", 0.0)
    assert LiveCapture(drawn_echo(), [], []).objects == ()
    with pytest.raises(WearcapError, match="nowhere"):
        LiveCapture(drawn_echo(environment=str(tmp_path / "nowhere")), [], [])


# --- over sockets ---------------------------------------------------------------------------------------------------


def messages(recording: Recording) -> list[dict]:
    """What an adapter sends of a walk: head and wrists, the box from frame 6 on and none from frame 30 on, the box's pose
    of frame 12, and some that cannot be used."""
    head, truth, box = recording.head, recording.motion, recording.object_motion["box_1"]
    found: list[dict] = []
    for k, time_s in enumerate(head.timestamps.tolist()):
        if k in (6, 30):
            found.append({"active_object": "box_1" if k == 6 else None, "time": time_s})
        if k == 14:  # found two frames later
            found.append({"object": "box_1", "time": box.timestamps[12].item(), **pose_of(box.T_world_body[12])})
            found.append({"object": "box_7", "time": time_s, **pose_of(box.T_world_body[12])})
            found.append({"active_object": "x" * 65})
        poses = {joint: truth.joint(joint)[k] for joint in ("left_wrist", "right_wrist")}
        for device, pose in (poses | {"head": head.T_world_device[k]}).items():
            found.append({"device": device, "time": time_s, **pose_of(pose)})
    return found


def pose_of(pose: Rigid) -> dict:
    return {"position": pose.t.tolist(), "matrix": pose.R.tolist()}


def sent_over_udp(place: CaptureInput, *sinks: Sink) -> tuple[Motion, dict]:
    """The motion of an adapter's messages, and the report."""
    port, kept = free_port(socket.SOCK_DGRAM), Kept()
    setup = ReplaySource(place.recording, EchoSession).setup
    source = source_of(f"json://127.0.0.1:{port}")
    capture = LiveCapture(drawn_echo(anchor=False), [source], [kept, *sinks], source=place, known=Known(setup=setup))
    reports: list[dict] = []
    thread = threading.Thread(target=lambda: reports.append(capture.run(240.0)))
    thread.start()
    sound = [each for each in messages(place.recording) if "device" in each]
    with socket.socket(type=socket.SOCK_DGRAM) as sender:
        wait_for(lambda: listens(port, socket.SOCK_DGRAM))
        for message in messages(place.recording):
            sender.sendto(json.dumps(message).encode(), ("127.0.0.1", port))
        head = [each for each in sound if each["device"] == "head"]
        wait_for(lambda: sum(map(len, kept.pieces.get("", []))) >= len(head) - 8)  # all but the lookahead's
    capture.stop()
    thread.join(120.0)
    return kept.motion(), reports[0]


def wait_for(wanted: Callable[[], bool], seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not wanted():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_an_adapter_names_the_active_object_and_sinks_send_it(tmp_path: Path):
    place, port = placed(tmp_path), free_port()
    served = WebSocketSink(Address("ws", "127.0.0.1", port), pace=False)
    frames: list[dict] = []

    def read() -> None:
        wait_for(lambda: listens(port))
        with connect(served.url) as client:
            for text in client:
                frames.append(json.loads(text))

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    with socket.socket(type=socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        receiver.settimeout(2.0)
        vmc = VmcSink(Address("vmc", "127.0.0.1", receiver.getsockname()[1]), pace=False)
        motion, report = sent_over_udp(place, served, vmc)
        bundles = [receiver.recv(65536) for _ in range(len(motion))]
    reader.join(10.0)

    box, truth = motion.object_motion["box_1"], place.recording.object_motion["box_1"]
    torch.testing.assert_close(box.timestamps, motion.timestamps[6:30], atol=1e-6, rtol=0)
    torch.testing.assert_close(box.t_world_body[6], truth.t_world_body[12], atol=1e-4, rtol=0)
    torch.testing.assert_close(box.R_world_body[6], truth.R_world_body[12], atol=1e-4, rtol=0)
    (note,) = (note for note in report["wearers"]["wearer"]["notes"] if "box_7" in note)
    assert "one of box_1, box_2" in note
    assert [reason.partition(": ")[2] for reason in report["refused"]] == ["no name"]

    for k, data in enumerate(bundles):
        trackers = [m.message.params for m in OscPacket(data).messages if m.message.address == "/VMC/Ext/Tra/Pos"]
        assert len(trackers) == (6 <= k < 30)
        for name, *values in trackers:
            place_unity, (x, y, z, w) = torch.tensor(values[:3]), values[3:]
            turn = matrix_from_quat_wxyz(torch.tensor([w, x, y, z], dtype=torch.float64)).float()
            assert name == "box_1"
            torch.testing.assert_close(UNITY @ place_unity, box.t_world_body[k - 6], atol=1e-4, rtol=0)
            torch.testing.assert_close(UNITY @ turn @ UNITY.T, box.R_world_body[k - 6], atol=1e-4, rtol=0)

    assert frames[0]["skeleton"]["joints"] == list(motion.skeleton.joint_names)
    frames = [frame for frame in frames if "time" in frame]
    assert len(frames) == len(motion)
    for k, frame in enumerate(frames):
        assert ("objects" in frame) == (6 <= k < 30)
        if "objects" in frame:
            row = frame["objects"]["box_1"]
            wxyz = quat_wxyz_from_matrix(box.R_world_body[k - 6].double())
            np.testing.assert_allclose(row["position"], box.t_world_body[k - 6], atol=1e-4)
            assert abs(np.dot(row["rotation_wxyz"], wxyz)) == pytest.approx(1.0, abs=1e-4)
            assert row["contact"] == pytest.approx(motion.body_contact_prob[k].max().item(), abs=1e-3)


def test_touch_is_of_the_only_object_of_a_frame():
    motion = swaying_motion(4, 0)
    track = carrying(1.0).object_motion["box_1"]
    track = replace(track[:3], timestamps=motion.timestamps[1:4])
    prob = torch.linspace(0, 1, 4 * 64).reshape(4, 64)
    motion = replace(motion, object_motion={"a": track, "b": track[2:]}, body_contact_prob=prob)
    found = objects_of(motion)
    assert [sorted(frame) for frame in found] == [[], ["a"], ["a"], ["a", "b"]]
    assert [frame["a"].contact for frame in found[1:]] == pytest.approx(
        [prob[1].max().item(), prob[2].max().item(), None]
    )
    assert objects_of(replace(motion, object_motion=None)) == [{}] * 4


# --- when a choice counts -------------------------------------------------------------------------------------------


class Pushed:
    """A session that only notes what it gets."""

    fps, dropped, refused = 30.0, (0,), ({},)

    def __init__(self):
        self.samples: list = []

    def push(self, samples) -> None:
        self.samples += samples[0]

    def poses(self, ended: bool = False):
        return [None]

    @property
    def chosen(self) -> list[ActiveObject]:
        return [sample for sample in self.samples if isinstance(sample, ActiveObject)]


def opened(takes_objects: bool = True) -> tuple[LiveWearer, list[Pushed]]:
    """A wearer whose set-up is known, and the sessions that were opened."""
    sessions: list[Pushed] = []

    def session(_) -> Pushed:
        sessions.append(Pushed())
        return sessions[-1]

    setup = Setup(swaying_motion(1, 0).skeleton)
    return LiveWearer("", Opener(session, (HEAD,), True, takes_objects, lambda *_: None), setup), sessions  # type: ignore


def head(time_s: float, arrived_s: float) -> Packet:
    pose = Rigid(torch.eye(3), torch.zeros(3))
    return Packet("", HEAD, "device", time_s, arrived_s, HeadSample(time_s, pose))


def choice(name: str | None, time_s: float | None, arrived_s: float, clock: str = "device") -> Packet:
    return Packet("", OBJECT, clock, time_s, arrived_s, ActiveObject(name, time_s or arrived_s))


def test_a_choice_before_the_capture_begins_counts_from_its_time_on():
    for packet in (choice("box_1", 4.5, 104.5), choice("box_1", None, 104.5), choice("box_1", 8.0, 104.5, "other")):
        wearer, sessions = opened()
        wearer.take(packet)
        assert not sessions
        wearer.take(head(5.0, 105.0))
        (session,) = sessions
        assert [type(sample) for sample in session.samples] == [ActiveObject, HeadSample]
        assert session.chosen == [ActiveObject("box_1", pytest.approx(4.5))]


def test_a_choice_counts_at_once_and_its_time_moves_no_clock():
    wearer, (sessions) = opened()
    wearer.take(head(5.0, 105.0))
    wearer.take(choice("box_1", 5.6, 105.1))  # beforehand
    wearer.take(choice(None, 3.0, 105.2))
    assert sessions[0].chosen == [ActiveObject("box_1", 5.6), ActiveObject(None, 3.0)]
    assert wearer.clocks.ours(5.0) == 105.0


def test_what_is_active_stays_so_when_a_wearer_comes_back(monkeypatch):
    monkeypatch.setattr(wearer_module.time, "monotonic", lambda: 0.0)
    wearer, sessions = opened()
    wearer.take(head(5000.0, 105.0))
    wearer.take(choice("box_1", 5000.0, 105.0))
    pose = Rigid(torch.eye(3), torch.zeros(3))
    seen = Packet("", f"{OBJECT} box_1", "device", 5000.1, 130.0, ObjectSample("box_1", 5000.1, pose))
    wearer.take(seen)
    assert isinstance(sessions[0].samples[-1], ObjectSample)
    wearer.poses(110.1)  # the wearer is away, though the object is still seen
    assert wearer.stage == "away"
    wearer.take(seen)
    assert len(sessions) == 1
    wearer.take(head(7.0, 140.0))  # on a clock that began anew
    assert sessions[1].chosen == [ActiveObject("box_1", 7.0)]


def test_other_systems_count_objects_as_unknown():
    wearer, sessions = opened(takes_objects=False)
    wearer.take(choice("box_1", 5.0, 105.0))
    wearer.take(head(5.0, 105.0))
    assert wearer.status().counts.unknown == 1
    assert not sessions[0].chosen
