"""A live capture outlives what names, files, sources and clocks may bring; what is lost is counted and reported."""

import asyncio
import contextlib
import json
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from test_live_capture import Broken, Kept, Scripted, Stalled, heads, small_hmd2, swaying
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from ports import free_port
from wearcap.apps.live.capture import LiveCapture
from wearcap.apps.live.devices import Device
from wearcap.apps.live.files_sink import FilesSink, join_sections
from wearcap.apps.live.packets import MAX_POINTS_WAITING, Inbox, Packet
from wearcap.apps.live.setup import Known, plain_name, read_setup, write_setup
from wearcap.apps.live.sink import SinkThread
from wearcap.apps.live.sinks import sink_of
from wearcap.apps.live.sinks.websocket import WebSocketSink
from wearcap.apps.live.source import Address, Budget, Source
from wearcap.apps.live.sources.replay import ReplaySource
from wearcap.errors import WearcapError
from wearcap.io.formats.motion_npz import read_motion
from wearcap.recording import Motion
from wearcap.sensors.samples import HeadSample
from wearcap.systems.hmd2.stream import HMD2Session
from wearcap_testing import swaying_motion


def later(motion: Motion, seconds: float) -> Motion:
    return replace(motion, timestamps=motion.timestamps + seconds)


def test_two_wearers_whose_names_look_alike_have_a_folder_each(tmp_path: Path):
    sink, motion = FilesSink(tmp_path), swaying_motion(60, 0)
    sink.open()
    for name in ("太郎", "花子"):
        sink.begin(name, motion.skeleton, 60.0)
    for k in range(3):
        for name in ("太郎", "花子"):
            sink.take(name, later(motion, k))
    sink.close()
    folders = [plain_name(name) for name in ("太郎", "花子")]
    assert [len(read_motion(tmp_path / folder / "motion.npz")) for folder in folders] == [180, 180]


def test_names_that_look_alike_have_files_of_their_own():
    names = ("anna", "", "a/b", "a.b", "a_b", "x" * 50, "x" * 51)
    assert len({plain_name(name) for name in names}) == len(names)
    assert (plain_name("anna"), plain_name("")) == ("anna", "wearer")


def test_a_wearer_without_a_name_and_one_called_wearer_are_both_in_the_report():
    sensed, kept = swaying(60), Kept()
    script = [packet for pair in zip(heads(sensed, ""), heads(sensed, "wearer")) for packet in pair]
    report = LiveCapture(
        small_hmd2(), [Scripted(script)], [kept], known=Known(setup=ReplaySource(sensed, HMD2Session).setup)
    ).run(30.0)
    assert {name: row["sessions"] for name, row in report["wearers"].items()} == {"unnamed wearer": 1, "wearer": 1}


def test_a_piece_that_cannot_be_written_costs_its_half_second(tmp_path: Path):
    thread, motion = SinkThread(FilesSink(tmp_path)), swaying_motion(30, 0)
    thread.start()
    for k in range(10):
        bad = replace(motion, t_world_root=motion.t_world_root * torch.nan) if k == 4 else motion
        thread.take("", later(bad, k / 2))
    thread.close()
    assert thread.failed >= 1
    assert "finite" in thread.last_error
    assert len(read_motion(tmp_path / "wearer" / "motion.npz")) >= 240


def test_a_clock_that_jumps_begins_another_motion(tmp_path: Path):
    sink, motion = FilesSink(tmp_path), swaying_motion(60, 0)
    sink.open()
    for start_s in (0.0, 1.0, 101.0, 102.0, 3.0):
        sink.take("", later(motion, start_s))
    sink.close()
    found = {path.parent.name: len(read_motion(path)) for path in tmp_path.glob("*/motion.npz")}
    assert found == {"wearer": 120, "wearer_2": 120, "wearer_3": 60}
    assert all(path.with_suffix(".bvh").is_file() for path in tmp_path.glob("*/motion.npz"))


def test_joining_goes_on_where_it_was_killed(tmp_path: Path):
    sink, motion = FilesSink(tmp_path), swaying_motion(60, 0)
    sink.open()
    for k in range(3):
        sink.take("", later(motion, k))
    sections = {path.name: path.read_bytes() for path in (tmp_path / "wearer").glob("motion-*")}
    assert len(sections) == 6
    sink.close()
    for name in sorted(sections)[-2:]:  # as if killed before the last section was removed
        (tmp_path / "wearer" / name).write_bytes(sections[name])
    (tmp_path / "wearer" / "motion.bvh").unlink()
    assert len(join_sections(tmp_path / "wearer")) == 180
    assert sorted(path.name for path in (tmp_path / "wearer").iterdir()) == ["motion.bvh", "motion.npz"]


def test_a_name_from_the_network_is_no_path_and_a_named_wearer_keeps_their_set_up(tmp_path: Path):
    sensed, kept = swaying(60), Kept()
    known = ReplaySource(sensed, HMD2Session).setup
    assert known is not None
    write_setup(known.with_height(1.61), tmp_path / f"setup_{plain_name('a/b')}.json")
    script = list(heads(sensed, "a/b"))
    LiveCapture(small_hmd2(), [Scripted(script)], [kept], known=Known(file=tmp_path / "setup.json")).run(30.0)
    assert kept.motion("a/b").skeleton.stature == pytest.approx(1.61, abs=1e-3)
    assert [path.name for path in tmp_path.iterdir()] == [f"setup_{plain_name('a/b')}.json"]


def test_a_height_that_is_given_is_that_of_a_known_set_up_too():
    sensed, kept = swaying(60), Kept()
    setup = ReplaySource(sensed, HMD2Session).setup
    capture = LiveCapture(
        small_hmd2(), [Scripted(list(heads(sensed)))], [kept], known=Known(setup=setup, height_m=1.85)
    )
    capture.run(30.0)
    assert kept.motion().skeleton.stature == pytest.approx(1.85, abs=1e-3)


def standing(seconds: float = 4.0):
    """Head packets of one who stands still, each as if it had come at once."""
    pose = swaying(2).head.T_world_device[0]
    for k in range(int(60 * seconds)):
        yield Packet("", "head", "device", k / 60, k / 60, HeadSample(k / 60, pose)), 0.0


def test_a_set_up_that_cannot_be_written_is_noted(tmp_path: Path):
    (tmp_path / "file").write_text("")
    capture = LiveCapture(
        small_hmd2(),
        [Scripted(list(standing()))],
        [Kept()],
        known=Known(height_m=1.7, file=tmp_path / "file" / "setup.json"),
    )
    about = capture.run(30.0)["wearers"]["wearer"]
    assert about["frames"] > 0
    assert any("setup.json" in note for note in about["notes"])
    capture = LiveCapture(
        small_hmd2(), [Scripted(list(standing()))], [], known=Known(height_m=1.7, file=tmp_path / "s.json")
    )
    capture.run(30.0)
    assert read_setup(tmp_path / "s.json").skeleton.stature == pytest.approx(1.7, abs=1e-3)


def test_a_recorder_that_fails_is_in_the_report(tmp_path: Path, monkeypatch):
    monkeypatch.setattr("wearcap.apps.live.capture.FilesSink", lambda _: Broken())
    sensed = swaying(120)
    setup = ReplaySource(sensed, HMD2Session).setup
    capture = LiveCapture(small_hmd2(), [Scripted(list(heads(sensed)))], [], record=tmp_path, known=Known(setup=setup))
    sinks = capture.run(30.0)["sinks"]
    assert sinks["broken"]["failed"] > 0
    assert sinks["broken"]["last_error"] == "the cable was pulled"


def test_a_file_that_cannot_be_written_at_the_end_costs_its_own_frames_alone(tmp_path: Path):
    sink, motion = FilesSink(tmp_path), swaying_motion(20, 0)
    sink.open()
    for name in ("anna", "ben"):
        for k in range(3):  # the last one fills no section before the end
            bad = replace(motion, t_world_root=motion.t_world_root * torch.nan) if k == 2 else motion
            sink.take(name, later(bad, k / 3))
    with pytest.raises(WearcapError, match="finite"):
        sink.close()
    assert [len(read_motion(tmp_path / name / "motion.npz")) for name in ("anna", "ben")] == [40, 40]


def test_wearers_who_come_and_leave_fill_no_memory_while_a_sink_stalls():
    stalled, motion = Stalled(), swaying_motion(5, 0)
    thread = SinkThread(stalled, capacity=10)
    thread.start()
    thread.take("", motion)
    for _ in range(100):
        thread.begin("", motion.skeleton, 60.0)
        thread.end("")
    assert len(thread._calls) <= 10
    stalled.go.set()
    thread.close()


@pytest.mark.parametrize("scheme", ["vmc", "osctrackers", "ws"])
def test_an_option_that_a_sink_does_not_have_is_refused(scheme):
    with pytest.raises(WearcapError, match="no option 'wearrer'.*wearer"):
        sink_of(f"{scheme}://127.0.0.1:39539?wearrer=anna", "127.0.0.1", True)


def test_what_a_stalled_sink_never_took_is_counted():
    stalled = Stalled()
    thread = SinkThread(stalled)
    thread.start()
    for _ in range(5):
        thread.take("", swaying_motion(5, 0))
    thread.close(0.2)
    stalled.go.set()
    thread.close()
    assert stalled.sent + 5 * thread.dropped == 5 * 5


@pytest.mark.parametrize("scheme", ["vmc", "osctrackers", "ws"])
def test_a_host_without_a_possible_name_is_refused(scheme):
    sink = sink_of(f"{scheme}://a..b:9102", "127.0.0.1", True)
    with pytest.raises(WearcapError, match=r"a\.\.b"):
        sink.open()


def test_what_sessions_refused_and_dropped_is_in_the_report_at_the_end(monkeypatch):
    """Of a wearer who has left and come back, both sessions' counts."""
    monkeypatch.setattr("wearcap.apps.live.wearer.AWAY_S", 0.4)
    sensed = swaying(60)
    script = [(packet._replace(arrived_s=0.0), pause_s) for packet, pause_s in heads(sensed, "", 59, 2.0)]
    bad = script[30][0].sample.T_world_device
    for k in (20, 30):
        packet = script[k][0]
        wrong = replace(bad, t=bad.t * torch.nan)
        script[k] = packet._replace(sample=packet.sample._replace(T_world_device=wrong)), 0.0
    again = [(packet._replace(sent_s=packet.sent_s + 9.0), 0.0) for packet, _ in script]
    setup = ReplaySource(sensed, HMD2Session).setup
    about = LiveCapture(small_hmd2(), [Scripted(script + again)], [], known=Known(setup=setup)).run(60.0)["wearers"][
        "wearer"
    ]
    assert about["sessions"] == 2
    assert about["refused"] == {"head: not finite": 4}
    assert about["dropped"] == 4


def test_packets_behind_the_newest_are_late_also_one_after_another():
    device, pose = Device(), swaying(2).head.T_world_device[0]
    for time_s in (1.0, 1.3, 1.1, 1.2, 1.4, 0.1, 0.2):  # at last the clock is set back
        device.see(Packet("", "head", "", time_s, time_s, HeadSample(time_s, pose)), "", time_s)
    assert device.late == 2


class Failing(Source):
    """Fails in its second run, or before its first."""

    scheme, port, hz, convention = "failing", 1, 60.0, "ours"

    def __init__(self, listens: bool):
        super().__init__(Address("failing", "127.0.0.1", 1))
        self.ready, self.runs = listens, 0

    async def run(self, inbox: Inbox) -> None:
        self.listens, self.runs = self.ready, self.runs + 1
        if self.runs < 3:
            raise ValueError("label too long")
        await asyncio.sleep(0)


def test_a_source_that_fails_is_started_again_and_ends_no_other(monkeypatch):
    monkeypatch.setattr("wearcap.apps.live.capture.RESTART_S", 0.01)
    sensed, kept, failing = swaying(60), Kept(), Failing(listens=True)
    setup = ReplaySource(sensed, HMD2Session).setup
    report = LiveCapture(small_hmd2(), [failing, Scripted(list(heads(sensed)))], [kept], known=Known(setup=setup)).run(
        30.0
    )
    assert failing.runs == 3
    assert len(kept.motion()) == 60
    assert report["refused"] == {"failing:1: failed (ValueError), and is started again": 2}


def test_a_source_that_never_runs_ends_the_capture_with_its_reason():
    with pytest.raises(WearcapError, match=r"failing:1: cannot start \(label too long\)"):
        LiveCapture(small_hmd2(), [Failing(listens=False)], []).run(10.0)


def test_silent_strangers_make_room(tmp_path: Path, monkeypatch):
    monkeypatch.setattr("wearcap.apps.live.recent.FORGOTTEN_S", 0.0)
    sensed, kept = swaying(60), Kept()
    strangers = [next(heads(sensed, f"stranger {k}")) for k in range(20)]
    lone = [(packet._replace(device=f"tracker {k}", wearer="anna"), 0.0) for k, (packet, _) in enumerate(strangers * 3)]
    script = [*strangers, *lone, *heads(sensed, "anna")]
    setup = ReplaySource(sensed, HMD2Session).setup
    assert setup is not None
    write_setup(setup, tmp_path / "setup_anna.json")
    LiveCapture(small_hmd2(), [Scripted(script)], [kept], known=Known(file=tmp_path / "setup.json")).run(30.0)
    assert len(kept.motion("anna")) == 60


def test_points_that_wait_are_bounded():
    inbox, pose = Inbox(), swaying(2).head.T_world_device[0]
    points = torch.zeros(MAX_POINTS_WAITING // 4, 3)
    for k in range(10):
        inbox.deliver([Packet("", "head", "", k / 60, 0.0, HeadSample(k / 60, pose, points))])
    assert inbox.waiting == 4
    assert inbox.overflowed == 6
    assert [packet.sent_s for packet in inbox.wait(0.0)] == [k / 60 for k in range(6, 10)]


def test_a_source_has_messages_bytes_and_time(monkeypatch):
    now, busy = [100.0], [0.0]
    monkeypatch.setattr("wearcap.apps.live.source.time.monotonic", lambda: now[0])
    monkeypatch.setattr("wearcap.apps.live.source.time.thread_time", lambda: busy[0])
    budget = Budget(messages=30, size=100, parse_s=0.2)
    assert [budget.allows(1) for _ in range(31)] == [True] * 30 + [False]
    now[0] = 101.0
    assert [budget.allows(60), budget.allows(60)] == [True, False]
    now[0] = 102.0
    assert budget.allows(1)
    with budget.spending(1_000_000):
        busy[0] += 0.56
    assert not budget.allows(1)
    for second, allowed in ((103.0, False), (104.0, True)):  # 0.36 and 0.16 s are left to pay
        now[0] = second
        assert budget.allows(1) == allowed, second


def test_a_pause_of_the_program_costs_a_sender_no_messages(monkeypatch):
    """A garbage collection, for example, falls into whichever message is being read."""
    busy = [0.0]
    monkeypatch.setattr("wearcap.apps.live.source.time.monotonic", lambda: 100.0)
    monkeypatch.setattr("wearcap.apps.live.source.time.thread_time", lambda: busy[0])
    budget = Budget()
    for _ in range(10):
        assert budget.allows(200)
        with budget.spending(200):
            busy[0] += 0.7


def test_the_last_frames_are_sent_before_a_capture_has_ended():
    """At their own rate, which takes longer than the capture needs."""
    sink, motion = WebSocketSink(Address("ws", "127.0.0.1", free_port())), swaying_motion(60, 0)
    thread = SinkThread(sink)
    thread.start()
    with connect(sink.url) as client:
        thread.begin("", motion.skeleton, 60.0)
        assert "skeleton" in json.loads(client.recv(10.0))  # the client is served from here on
        thread.take("", motion)
        reading = threading.Thread(target=lambda: [*client])
        reading.start()
        thread.close()
        assert sink.sent == 60
        reading.join(10.0)


def test_frames_of_two_wearers_are_sent_side_by_side():
    port, frames = free_port(), 60
    sink = WebSocketSink(Address("ws", "127.0.0.1", port))
    thread, motion, got = SinkThread(sink), swaying_motion(10, 0), []
    thread.start()
    with connect(sink.url) as client:
        for name in ("anna", "ben"):
            thread.begin(name, motion.skeleton, 60.0)
        for _ in range(2):  # the client is served from here on
            assert "skeleton" in json.loads(client.recv(10.0))
        begin_s = time.monotonic()
        for k in range(frames // 10):
            for name in ("anna", "ben"):
                thread.take(name, later(motion, k / 6))
            time.sleep(max(0.0, begin_s + (k + 1) / 6 - time.monotonic()))
        closing = threading.Thread(target=thread.close)
        closing.start()
        with contextlib.suppress(ConnectionClosed):
            while True:
                got.append(json.loads(client.recv(5.0)))
        closing.join()
    times = {name: [each["time"] for each in got if each.get("wearer") == name] for name in ("anna", "ben")}
    assert all(len(each) == frames and each == sorted(each) for each in times.values())
    names = [each["wearer"] for each in got if "time" in each]
    assert names[:10].count("anna") < 9  # side by side, not all of one after all of the other
