"""Silent, slow and too many connections, floods and invented wearers: whoever delivers keeps the place and the rate."""

import errno
import http.client
import json
import logging
import resource
import time
import tracemalloc
from pathlib import Path

import pytest
import websockets.sync.client
from serving import Served
from test_live_faults import later
from websockets.exceptions import ConnectionClosed, InvalidMessage

from ports import free_port
from silent_sockets import silent
from wearcap.apps.live import capture, files_sink
from wearcap.apps.live.files_sink import FilesSink
from wearcap.apps.live.packets import Packet
from wearcap.apps.live.sink import SinkThread
from wearcap.apps.live.sinks import sink_of
from wearcap.apps.live.source import Budget
from wearcap.apps.live.sources import source_of
from wearcap.apps.web import connections
from wearcap.apps.web.connections import CONNECTIONS, DELIVERING, SPOKEN, Connections
from wearcap.cli import live
from wearcap.errors import WearcapError
from wearcap.io.formats.motion_npz import read_motion
from wearcap.recording.store import save_recording
from wearcap.sensors.samples import HeadSample
from wearcap_testing import recording_of, swaying_motion

POSE = {"position": [0.1, 0.2, 1.6], "rotation_wxyz": [1, 0, 0, 0]}
MESSAGE = json.dumps({"device": "head", **POSE})
SAMPLE = {"motionTimestamp_sinceReboot": 1.0, "deviceID": "w"}
SAMPLE |= {f"motionQuaternion{axis}": float(axis == "W") for axis in "WXYZ"}
SAMPLE |= {f"motionGravity{axis}": -float(axis == "Z") for axis in "XYZ"}
SAMPLE |= {f"motionUserAcceleration{axis}": 0.0 for axis in "XYZ"}


@pytest.fixture
def few(monkeypatch):
    monkeypatch.setattr(CONNECTIONS, "most", 24)


def test_text_among_points_takes_neither_time_nor_memory():
    rows = [[1, 2, 3]] * 7000 + [["x" * 40_000, 2, 3]]
    message = json.dumps({"device": "head", "points": rows, **POSE}).encode()
    source, seconds, peaks = source_of("json"), [], []
    for measured in (False, True) * 3:  # threads of earlier tests allocate and compute, too: the least counts
        why: list[str] = []
        if measured:
            tracemalloc.start()  # slows parsing several times
        begin = time.thread_time()
        assert source.parse(message, 1.0, why.append) == []
        if measured:
            peaks.append(tracemalloc.get_traced_memory()[1])
            tracemalloc.stop()
        else:
            seconds.append(time.thread_time() - begin)
        assert why == ["wrong type or shape"]
    assert min(seconds) < 1.0
    assert min(peaks) < 20 * len(message)


def test_the_limit_leaves_files_to_the_recording(monkeypatch):
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    monkeypatch.setattr(connections.resource, "getrlimit", lambda _: (256, limits[1]))
    assert Connections().most == 64
    monkeypatch.setattr(connections.resource, "getrlimit", lambda _: (1 << 20, limits[1]))
    assert Connections().most == connections.MAX_CONNECTIONS


def test_who_has_said_least_goes_first():
    among, closed = Connections(3), []
    first, second, third = (among.enter(lambda name=name: closed.append(name)) for name in "abc")
    second.rise(SPOKEN)
    fourth = among.enter(lambda: closed.append("d"))
    assert closed == ["a"]
    third.rise(DELIVERING)
    fourth.rise(DELIVERING)
    fifth = among.enter(lambda: closed.append("e"))
    assert closed == ["a", "b"]
    fifth.rise(DELIVERING)
    assert among.enter(lambda: closed.append("f")) is None
    third.leave()
    first.leave()
    assert among.enter(lambda: closed.append("g")) is not None
    assert (closed, len(among)) == (["a", "b"], 3)


def post(port: int, time_s: float) -> int:
    client = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
    client.request("POST", "/", json.dumps(SAMPLE | {"motionTimestamp_sinceReboot": time_s}))
    status = client.getresponse().status
    client.close()
    return status


def test_an_honest_watch_gets_in_beside_silent_connections(few):
    port = free_port()
    with Served(f"watch+http://127.0.0.1:{port}") as served, silent(port, 200):
        begin, answered = time.monotonic(), 0
        for k in range(40):
            try:
                answered += post(port, 1.0 + k / 20) == 200
            except (OSError, http.client.HTTPException):  # its place went to another before it had spoken
                continue
        assert answered >= 36
        assert time.monotonic() - begin < 40
        kept = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
        for k in range(20):  # a connection that has delivered is never closed for one that has not
            kept.request("POST", "/", json.dumps(SAMPLE | {"motionTimestamp_sinceReboot": 10.0 + k / 20}))
            answer = kept.getresponse()
            assert (answer.status, answer.read()) == (200, b"")
            time.sleep(0.05)
        assert len(CONNECTIONS) <= 24
        assert len(served.packets(1)) > 0


@pytest.mark.parametrize("kind", ["source", "sink"])
def test_websockets_keep_who_delivers_beside_silent_connections(kind, few):
    port, url = free_port(), ""
    if kind == "sink":
        sink = sink_of(f"ws://127.0.0.1:{port}", "127.0.0.1", True)
        sink.open()
        url = sink.url
    with Served(f"ws://127.0.0.1:{port if kind == 'source' else free_port()}") as served, silent(port, 200):
        connected = None
        for _ in range(20):
            try:
                connected = websockets.sync.client.connect(url or f"ws://127.0.0.1:{port}/", open_timeout=3)
                break
            except (OSError, InvalidMessage, TimeoutError, ConnectionClosed):
                continue
        assert connected is not None
        for _ in range(100):
            if kind == "source":
                connected.send(MESSAGE)
            time.sleep(0.01)
        if kind == "source":
            assert len(served.packets(100)) == 100
        connected.ping().wait(5)
        connected.close()
        assert len(CONNECTIONS) <= 24
    if kind == "sink":
        sink.close()


def test_a_recording_is_whole_while_more_connect_than_there_are_files(tmp_path, monkeypatch):
    """The process may open 100 files more; 500 sockets try to take them."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    here = len(list(Path("/proc/self/fd").iterdir()))
    port, motion = free_port(), swaying_motion(30, 0)
    monkeypatch.setattr(CONNECTIONS, "most", (here + 100) // connections.SHARE)
    with Served(f"ws://127.0.0.1:{port}") as served:
        resource.setrlimit(resource.RLIMIT_NOFILE, (here + 100, hard))
        try:
            with silent(port, 500):
                thread = SinkThread(FilesSink(tmp_path))
                thread.start()
                for k in range(20):
                    thread.take("", later(motion, k / 2))
                    time.sleep(0.05)
                thread.close()
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert (thread.failed, thread.dropped) == (0, 0)
    assert len(read_motion(tmp_path / "wearer" / "motion.npz")) == 600
    assert served.error is None


def test_a_known_sender_keeps_its_share_of_a_flooded_source():
    budget = Budget(messages=100)
    assert budget.allows(10, "device")
    budget.know("device")
    for k in range(1000):
        budget.allows(10, f"stranger {k}")
    assert not budget.allows(10, "stranger")
    assert sum(budget.allows(10, "device") for _ in range(100)) >= 48
    for k in range(7):
        budget.know(f"invented {k}")
    assert not budget.allows(10, "invented 0") or budget.allows(10, "device") is False


def waiting(seconds: float) -> list[Packet]:
    """A packet that has waited."""
    return [Packet("", "head", "c", None, time.monotonic() - seconds, HeadSample(0.0, None))]


def test_who_came_last_goes_when_the_machine_is_too_slow(monkeypatch):
    monkeypatch.setattr(capture, "TOO_LONG_S", 0.05)
    monkeypatch.setattr(capture, "CALM_S", 0.1)
    capacity = capture._Capacity()
    assert not capacity.is_exceeded(waiting(0.0), 8)
    assert not capacity.is_exceeded(waiting(1.0), 8), "a pause is no overload"
    time.sleep(0.06)
    assert capacity.is_exceeded(waiting(1.0), 8)
    assert capacity.most == 7
    time.sleep(0.06)
    assert not capacity.is_exceeded(waiting(1.0), 1), "whoever came first stays"
    time.sleep(0.25)
    assert not capacity.is_exceeded([], 7)
    assert capacity.most == 8, "one more is tried"


def test_an_error_that_repeats_is_one_line_with_a_count(capsys, monkeypatch):
    monkeypatch.setattr(logging.getLogger(), "handlers", [])  # of other tests, whose streams are closed
    logger = logging.getLogger("asyncio.of.a.test")
    with live._repeats_counted():
        for k in range(3000):
            try:
                raise OSError(errno.EMFILE, "Too many open files")
            except OSError:
                logger.exception("socket.accept() out of system resource %s", k)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert "socket.accept()" in lines[0]
    assert lines[1].startswith("3000 times: socket.accept() out of system resource N: ")


@pytest.mark.slow
def test_a_full_disk_ends_a_capture_with_an_error(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(files_sink, "write_motion", full)
    save_recording(recording_of(swaying_motion(200, 0), "sway"), tmp_path / "in.safetensors")
    command = ["system=hmd2", "source=replay", f"recording={tmp_path / 'in.safetensors'}", "speed=inf", "to=[]"]
    command += [f"record={tmp_path / 'out'}", f"report={tmp_path / 'report.json'}", f"hydra.run.dir={tmp_path}"]
    with pytest.raises(WearcapError, match="parts of the recording are lost.*No space left"):
        live.main(command)
    assert json.loads((tmp_path / "report.json").read_text())["wearers"]["wearer"]["frames"] == 200
