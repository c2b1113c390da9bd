"""A live capture from source to sink: what comes out is the offline capture, whatever sources and sinks do."""

import json
import math
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
from pythonosc.osc_message_builder import OscMessageBuilder
from pythonosc.osc_packet import OscPacket
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

import wearcap
from carried_box import carrying, drawn_echo
from own_bvh import read_bvh
from ports import free_port
from small_hmd2 import hmd2_of
from watched_walk import drawn_pipeline, watched_walk
from wearcap.apps.live import wearer as wearer_module
from wearcap.apps.live.capture import LiveCapture, report_text
from wearcap.apps.live.files_sink import FilesSink, join_sections
from wearcap.apps.live.packets import HEAD, Inbox, Packet
from wearcap.apps.live.setup import Known, Seat, Setup, plain_name
from wearcap.apps.live.sink import Sink, SinkThread
from wearcap.apps.live.sinks import sink_of
from wearcap.apps.live.sinks.vmc import BONES, VmcSink
from wearcap.apps.live.sinks.websocket import WebSocketSink
from wearcap.apps.live.source import Address, Source
from wearcap.apps.live.sources import source_of
from wearcap.apps.live.sources.replay import ReplaySource
from wearcap.apps.live.wearer import LiveWearer
from wearcap.body.skeleton import xsens23
from wearcap.errors import WearcapError
from wearcap.geometry.rotation import about_axis, matrix_from_quat_wxyz
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.formats.motion_npz import read_motion
from wearcap.models.layers import TransformerSize
from wearcap.recording import Motion, Recording
from wearcap.recording.timing import joined
from wearcap.sensors.samples import HeadSample, WatchSample
from wearcap.systems.hmd2.features import HeadFeatures
from wearcap.systems.hmd2.model import MotionDenoiser
from wearcap.systems.hmd2.stream import HMD2Session
from wearcap_testing import recording_of, swaying_motion

UNITY = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # Unity's axes in ours, as columns


class Kept(Sink):
    """Keeps what it gets."""

    name = convention = "kept"

    def __init__(self):
        self.pieces: dict[str, list[Motion]] = {}
        self.left: list[str] = []

    def take(self, wearer: str, motion: Motion) -> None:
        self.pieces.setdefault(wearer, []).append(motion)

    def end(self, wearer: str) -> None:
        self.left.append(wearer)

    def motion(self, wearer: str = "") -> Motion:
        whole = joined(self.pieces[wearer])
        assert whole is not None
        return whole


def small_hmd2(hands: bool = False, **changes):
    torch.manual_seed(0)
    features = HeadFeatures(contacts=True, body=True)
    net = MotionDenoiser(
        features.motion_size,
        features.condition_size,
        60,
        TransformerSize(32, 1, 4, 64, 0.0),
        4,
        conditions={"hands": 20} if hands else {},
        blend=5,
    )
    for parameter in net.parameters():
        torch.nn.init.normal_(parameter, std=0.05)
    return hmd2_of(net, features, steps=3, **{"stride": 10, "lookahead": 14, "fade": 6, "live": True} | changes)


def watched() -> Recording:
    walk = watched_walk()
    return replace(walk, points=replace(walk.points, first_seen=torch.zeros(len(walk.points.points_world)).double()))


def swaying(frames: int = 200) -> Recording:
    return recording_of(swaying_motion(frames, 0), "sway")


def waving(frames: int = 200) -> Recording:
    """The right hand is tracked, but in the middle."""
    recording = swaying(frames)
    assert recording.motion is not None
    hand = recording.motion.joint("right_wrist")
    seen = torch.cat([torch.arange(60), torch.arange(120, frames)])
    track = Trajectory(recording.motion.timestamps[seen], hand.R[seen], hand.t[seen])
    return replace(recording, tracked={"right_wrist": track})


def carried() -> Recording:
    return replace(carrying(1.2), object_motion={}, interactions=None, environment=None)


def replayed(system, recording: Recording, *sinks: Sink, speed: float = math.inf) -> tuple[Motion, dict]:
    """What a replay gives, and its report."""
    kept, source = Kept(), ReplaySource(recording, system.session_class(), speed)
    capture = LiveCapture(system, [source], [kept, *sinks], known=Known(setup=source.setup))
    report = capture.run(60.0)
    return kept.motion(), report


@pytest.mark.parametrize(
    ("system", "recording"),
    [(drawn_pipeline, watched), (small_hmd2, swaying), (lambda: small_hmd2(hands=True), waving), (drawn_echo, carried)],
)
def test_a_replay_gives_the_offline_capture(system, recording):
    made, sensed = system(), recording()
    motion, report = replayed(made, sensed)
    whole = made(sensed, 0)
    torch.testing.assert_close(motion.timestamps, whole.timestamps, atol=1e-6, rtol=0)
    torch.testing.assert_close(motion.T_world_joint.t, whole.T_world_joint.t, atol=1e-3, rtol=0)
    about = report["wearers"]["wearer"]
    assert about["frames"] == len(whole)
    assert not any(about[name] for name in ("dropped", "late", "refused", "unknown"))
    assert report["overflowed"] == 0


def test_at_its_own_pace_poses_leave_after_the_systems_latency():
    system, sensed = drawn_pipeline(), watched()
    begin_s = time.monotonic()
    _, report = replayed(system, sensed, speed=1.0)
    assert time.monotonic() - begin_s > sensed.head.timestamps[-1].item()
    latency = report["wearers"]["wearer"]["latency_ms"]
    # The quickest packet's delay counts as none; frames of a stride but the first wait for less than the system's.
    assert latency["of_the_system"] - 1000 * system.overlap.stride / system.fps < latency["median"]


class Scripted(Source):
    """Delivers given packets, then ends."""

    scheme, port, hz, convention = "scripted", 0, 60.0, "ours"
    lossless = True

    def __init__(self, packets):
        super().__init__(Address("scripted", "127.0.0.1", 0))
        self.packets = packets

    async def run(self, inbox: Inbox) -> None:
        for packet, pause_s in self.packets:
            inbox.deliver([packet])
            if pause_s:
                import asyncio

                await asyncio.sleep(pause_s)


def heads(recording: Recording, wearer: str = "", pause_at: int = -1, pause_s: float = 0.0, start_s: float = 0.0):
    """Head packets of a recording at 60 Hz, as if each arrived at once."""
    stream = recording.head
    for k, time_s in enumerate(stream.timestamps.tolist()):
        sample = HeadSample(time_s, stream.T_world_device[k])
        yield Packet(wearer, HEAD, "device", time_s, start_s + time_s, sample), pause_s if k == pause_at else 0.0


def test_a_wearer_who_leaves_and_comes_back_begins_anew(monkeypatch):
    monkeypatch.setattr(wearer_module, "AWAY_S", 0.4)
    sensed, kept = swaying(120), Kept()
    again = [(packet._replace(sent_s=packet.sent_s + 5.0), 0.0) for packet, _ in heads(sensed)]
    script = [*heads(sensed, pause_at=119, pause_s=5.0), *again]
    setup = ReplaySource(sensed, HMD2Session).setup
    now_s = time.monotonic()
    script = [
        (packet._replace(arrived_s=now_s + (1000.0 if k >= 120 else 0.0)), pause)
        for k, (packet, pause) in enumerate(script)
    ]
    report = LiveCapture(small_hmd2(), [Scripted(script)], [kept], known=Known(setup=setup)).run(30.0)
    assert kept.left == ["", ""], "when they left, and when the capture ended"
    assert report["wearers"]["wearer"]["frames"] == 2 * 120
    torch.testing.assert_close(kept.pieces[""][-1].timestamps[-1].item(), 5.0 + 119 / 60)


def test_two_wearers_have_their_own_clocks_and_motion():
    first, second = swaying(100), swaying(100)
    script = [pair for both in zip(heads(first, "anna"), heads(second, "ben")) for pair in both]
    kept = Kept()
    LiveCapture(
        small_hmd2(), [Scripted(script)], [kept], known=Known(setup=ReplaySource(first, HMD2Session).setup)
    ).run(30.0)
    torch.testing.assert_close(kept.motion("anna").T_world_joint.t, kept.motion("ben").T_world_joint.t)
    assert len(kept.motion("anna")) == 100


def test_sinks_count_the_frames_that_they_really_send(tmp_path: Path):
    """A sink of one wearer, one to which nobody is connected, one with a client, and files of a disk that fails once."""
    motion = swaying_motion(30, 0)
    with socket.socket(type=socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        vmc = VmcSink(Address("vmc", "127.0.0.1", receiver.getsockname()[1], {"wearer": "anna"}), pace=False)
        heard, unheard = (WebSocketSink(Address("ws", "127.0.0.1", free_port()), pace=False) for _ in range(2))
        files = FilesSink(tmp_path)
        threads = [SinkThread(sink) for sink in (vmc, heard, unheard, files)]
        for thread in threads:
            thread.start()
        with connect(heard.url) as client:
            got: list[dict] = []
            for name, pieces in (("anna", 4), ("ben", 6)):
                for thread in threads:
                    thread.begin(name, motion.skeleton, 60.0)
                got.append(json.loads(client.recv(10.0)))  # from now on it is one of the clients
                for thread in threads:
                    for k in range(pieces):
                        bad = thread.sink is files and name == "ben" and k == 2
                        root = motion.t_world_root * (torch.nan if bad else 1.0)
                        thread.take(name, replace(motion, timestamps=motion.timestamps + k / 2, t_world_root=root))
                got += [json.loads(client.recv(10.0)) for _ in range(30 * pieces)]
        for thread in threads:
            thread.close()
    assert sum("time" in message for message in got) == heard.sent == 10 * 30
    assert vmc.sent == 4 * 30
    assert unheard.sent == 0
    kept = sum(len(read_motion(tmp_path / name / "motion.npz")) for name in ("anna", "ben"))
    assert files.sent == kept < 10 * 30


class Broken(Sink):
    name, convention = "broken", ""

    def take(self, wearer: str, motion: Motion) -> None:
        raise RuntimeError("the cable was pulled")


class Stalled(Sink):
    name, convention = "stalled", ""

    def __init__(self):
        self.go = threading.Event()

    def take(self, wearer: str, motion: Motion) -> None:
        self.go.wait(20.0)
        self.sent += len(motion)


def test_a_broken_and_a_stalled_sink_delay_nobody():
    stalled = Stalled()
    threading.Timer(3.0, stalled.go.set).start()
    motion, report = replayed(drawn_pipeline(), watched(), Broken(), stalled)
    assert len(motion) == len(watched().head.timestamps)
    assert report["sinks"]["kept"]["failed"] == 0
    assert report["sinks"]["broken"]["failed"] > 0


def test_a_full_sink_drops_the_oldest_pieces_and_counts_them():
    stalled = Stalled()
    thread = SinkThread(stalled, capacity=3)
    thread.start()
    for _ in range(10):
        thread.take("", swaying_motion(5, 0))
    assert thread.dropped >= 6
    stalled.go.set()
    thread.close()
    assert 0 < stalled.sent <= 4 * 5


def rebuilt(frame: dict[str, list[float]]) -> torch.Tensor:
    """World positions (m, our axes) of the bones of one VMC frame, by forward kinematics in Unity's axes."""
    parents = {
        "Hips": None,
        "Spine": "Hips",
        "Chest": "Spine",
        "UpperChest": "Chest",
        "Neck": "UpperChest",
        "Head": "Neck",
    }
    for side in ("Left", "Right"):
        chain = ["UpperChest", f"{side}Shoulder", f"{side}UpperArm", f"{side}LowerArm", f"{side}Hand"]
        legs = ["Hips", f"{side}UpperLeg", f"{side}LowerLeg", f"{side}Foot", f"{side}Toes"]
        for names in (chain, legs):
            parents |= dict(zip(names[1:], names))
    world: dict[str, tuple[torch.Tensor, torch.Tensor]] = {}
    while len(world) < len(parents):
        for name, parent in parents.items():
            if name in world or (parent is not None and parent not in world):
                continue
            values = torch.tensor(frame[name], dtype=torch.float64)
            x, y, z, w = values[3:]
            t, R = values[:3], matrix_from_quat_wxyz(torch.stack([w, x, y, z]))
            if parent is not None:
                R_parent, t_parent = world[parent]
                t, R = t_parent + R_parent @ t, R_parent @ R
            world[name] = R, t
    return torch.stack([UNITY.double() @ world[name][1] for name in BONES])


def test_an_independent_receiver_of_vmc_rebuilds_the_body():
    with socket.socket(type=socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        receiver.settimeout(1.0)
        address = Address("vmc", "127.0.0.1", receiver.getsockname()[1])
        motion, _ = replayed(drawn_pipeline(), watched(), VmcSink(address, pace=False))
        frames = []
        for _ in range(len(motion)):
            messages = [timed.message for timed in OscPacket(receiver.recv(65536)).messages]
            frame = {m.params[0]: m.params[1:] for m in messages if m.address == "/VMC/Ext/Bone/Pos"}
            assert [m.params for m in messages if m.address == "/VMC/Ext/OK"] == [[1, 3, 0]]
            frames.append(frame)
    assert set(frames[0]) == set(BONES)
    joints = motion.skeleton.indices(*BONES.values())
    for k in range(0, len(frames), 7):
        torch.testing.assert_close(rebuilt(frames[k]).float(), motion.T_world_joint.t[k, joints], atol=1e-4, rtol=0)
    # The rest pose has no rotations: where all our joints have none, all bones have none.
    still = replace(motion, R_parent_joint=torch.eye(3).expand(len(motion), 23, 3, 3).contiguous())
    from wearcap.apps.live.sinks.vmc import bones_of

    torch.testing.assert_close(bones_of(still)[1].abs(), torch.tensor([0.0, 0.0, 0.0, 1.0]).expand(len(motion), 22, 4))


def vmc_head(time_s: float, place, wxyz=(1.0, 0.0, 0.0, 0.0)) -> bytes:
    """A headset's message in Unity's axes, written without our code."""
    built = OscBundleBuilder(IMMEDIATELY)
    for address, values in (("/VMC/Ext/T", [time_s]), ("/VMC/Ext/Hmd/Pos", ["hmd", *place, *wxyz[1:], wxyz[0]])):
        message = OscMessageBuilder(address)
        for value in values:
            message.add_arg(value)
        built.add_content(message.build())
    return built.build().dgram


def test_over_a_socket_a_headset_becomes_a_body_with_its_measured_height():
    """Two seconds of a standing wearer at 60 Hz through UDP: set up by themselves, then captured."""
    port, kept = free_port(socket.SOCK_DGRAM), Kept()
    capture = LiveCapture(small_hmd2(), [source_of(f"vmc://127.0.0.1:{port}?wearer=anna")], [kept])
    done: list[dict] = []
    thread = threading.Thread(target=lambda: done.append(capture.run(30.0)))
    thread.start()
    with socket.socket(type=socket.SOCK_DGRAM) as sender:
        for k in range(300):
            # 1.62 m up, walking slowly along Unity's z after three seconds of standing
            forward = max(0.0, k / 60 - 3.0) * 0.5
            sender.sendto(vmc_head(k / 60, (0.0, 1.62, forward)), ("127.0.0.1", port))
            time.sleep(1 / 60)
            if k > 240 and kept.pieces:
                break
    capture.stop()
    thread.join(30.0)
    motion = kept.motion("anna")
    assert 1.6 < motion.skeleton.stature < 1.85
    head = motion.joint("head").t
    assert head[-1, 0] > head[0, 0] - 0.01  # forward is x
    assert head[:, 1].abs().max() < 0.05
    assert done[0]["wearers"]["anna"]["frames"] == len(motion)


def test_the_files_of_a_killed_capture_open_and_lack_at_most_a_second(tmp_path: Path):
    """The recorder runs at its own pace in a process that is killed."""
    script = f"""
import sys, time
sys.path[:0] = {[str(Path(__file__).parents[1])]!r}
from wearcap.apps.live.files_sink import FilesSink
from pathlib import Path
from dataclasses import replace
from wearcap_testing import swaying_motion
sink, motion = FilesSink(Path(sys.argv[1])), swaying_motion(6, 0)
sink.open(); sink.begin("", motion.skeleton, 60.0)
begin = time.monotonic()
for k in range(1000):
    sink.take("", replace(motion, timestamps=motion.timestamps + k / 10))
    print(k, flush=True)
    time.sleep(max(0, begin + (k + 1) / 10 - time.monotonic()))
"""
    for number, after_s in enumerate((0.9, 1.6, 2.4)):
        folder = tmp_path / str(number)
        process = subprocess.Popen([sys.executable, "-c", script, str(folder)], stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        process.stdout.readline()
        time.sleep(after_s)
        os.kill(process.pid, signal.SIGKILL)
        sent = 1 + len(process.stdout.read().split())
        process.wait()
        files = list((folder / "wearer").glob("motion-*.npz"))
        assert files
        for path in files:
            assert len(read_bvh(path.with_suffix(".bvh"))) == len(read_motion(path))
        left = wearcap.read(folder / "wearer").motion
        whole = join_sections(folder / "wearer")
        assert left is not None
        assert len(left) == len(whole) == len(wearcap.read(folder / "wearer").motion)
        assert (sent - 1) * 0.1 - whole.timestamps[-1].item() <= 1.0
        assert sorted(path.name for path in (folder / "wearer").iterdir()) == ["motion.bvh", "motion.npz"]


def test_a_recording_of_many_sections_is_one_motion(tmp_path: Path):
    sink, motion = FilesSink(tmp_path), swaying_motion(60, 0)
    sink.open()
    sink.begin("../..", motion.skeleton, 60.0)
    for k in range(25):
        sink.take("../..", replace(motion, timestamps=motion.timestamps + k))
    sink.close()
    whole = read_motion(tmp_path / plain_name("../..") / "motion.npz")
    torch.testing.assert_close(whole.timestamps, torch.arange(1500, dtype=torch.float64) / 60)
    torch.testing.assert_close(whole.R_parent_joint[-60:], motion.R_parent_joint)


def test_clients_of_the_websocket_get_skeleton_and_frames():
    port = free_port()
    sink = WebSocketSink(Address("ws", "127.0.0.1", port), pace=False)
    std = torch.rand(5, 23, generator=torch.Generator().manual_seed(0))
    thread, motion = SinkThread(sink), replace(swaying_motion(5, 0), joint_std=std)
    thread.start()
    with connect(sink.url) as client:
        thread.begin("anna", motion.skeleton, 60.0)
        about = json.loads(client.recv(5.0))  # from now on it is one of the clients
        thread.take("anna", motion)
        assert about["skeleton"]["joints"] == list(motion.skeleton.joint_names)
        frames = [json.loads(client.recv(5.0)) for _ in range(5)]
    R = matrix_from_quat_wxyz(torch.tensor([frame["rotations_wxyz"] for frame in frames], dtype=torch.float64))
    torch.testing.assert_close(R.float(), motion.R_parent_joint, atol=1e-4, rtol=0)
    torch.testing.assert_close(torch.tensor([frame["joint_std"] for frame in frames]), std, atol=6e-5, rtol=0)
    with pytest.raises(InvalidStatus):
        connect(sink.url, origin="http://elsewhere.example")  # type: ignore[arg-type]
    thread.close()


def test_a_client_that_does_not_read_is_disconnected_and_the_others_get_all():
    port = free_port()
    sink = WebSocketSink(Address("ws", "127.0.0.1", port), pace=False)
    thread, motion = SinkThread(sink, capacity=10_000), swaying_motion(200, 0)
    thread.start()
    with connect(sink.url, max_queue=1) as stalled, connect(sink.url) as reader:
        stalled.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        got: list[dict] = []

        def read() -> None:
            try:
                while len(got) < 8001:
                    got.append(json.loads(reader.recv(10.0)))
            except (TimeoutError, ConnectionClosed):
                pass

        reading = threading.Thread(target=read)
        reading.start()
        thread.begin("anna", motion.skeleton, 60.0)
        begun_s = time.monotonic()
        while not got and time.monotonic() < begun_s + 10.0:  # the reader is served from here on
            time.sleep(0.01)
        for _ in range(40):
            thread.take("anna", motion)
            time.sleep(0.05)
        reading.join(60.0)
        assert sink.slow == 1
        assert ["skeleton" in message for message in got] == [True] + [False] * 8000
    thread.close()


def test_the_page_starts_and_stops_recordings_while_the_capture_runs(tmp_path: Path):
    sensed, kept = swaying(400), Kept()
    source = ReplaySource(sensed, HMD2Session, 1.5)
    capture = LiveCapture(small_hmd2(), [source], [kept], recordings=tmp_path / "all", known=Known(setup=source.setup))

    def press() -> None:
        for frames, on in ((20, True), (120, False), (150, True)):
            while sum(len(piece) for piece in kept.pieces.get("", [])) < frames:
                time.sleep(0.02)
            capture.record(on)

    threading.Thread(target=press, daemon=True).start()
    report = capture.run(60.0)
    assert report["wearers"]["wearer"]["frames"] == 400
    recorded = [read_motion(path) for path in sorted((tmp_path / "all").glob("*/wearer/motion.npz"))]
    assert len(recorded) == 2
    whole = kept.motion()
    for motion in recorded:
        first = int((whole.timestamps - motion.timestamps[0]).abs().argmin())
        part = whole.sliced(first, first + len(motion))
        torch.testing.assert_close(motion.t_world_root, part.t_world_root)


def test_the_status_says_who_wears_a_watch_and_turns_it_to_the_heads_world():
    quarter = about_axis("z", torch.tensor(math.pi / 2))
    setup = Setup(xsens23(), {"watch-7": Seat("left_wrist", torch.eye(3), torch.zeros(3), math.pi / 2)}, 0.0)
    wearer = LiveWearer("", LiveCapture(drawn_pipeline(), [], []).opener, setup)
    for device in ("watch-7", "watch-9"):
        sample = WatchSample(0.0, torch.eye(3), torch.zeros(3), device)
        wearer.take(Packet("", device, device, 0.0, time.monotonic(), sample))
    worn, unknown = wearer.status().devices
    assert (worn.joint, worn.title) == ("left_wrist", "left wrist (watch-7)")
    torch.testing.assert_close(worn.T_world_device.R, quarter)
    assert (unknown.joint, unknown.title) == (None, "watch-9")
    torch.testing.assert_close(unknown.T_world_device.R, torch.eye(3))


def test_reports_are_json_also_without_poses():
    report = LiveCapture(small_hmd2(), [Scripted([])], []).run(5.0)
    assert json.loads(report_text(report))["wearers"] == {}


@pytest.mark.parametrize(
    ("call", "names"),
    [
        (lambda: sink_of("vcm://localhost:1", "127.0.0.1", True), ("vcm", "vmc")),
        (lambda: sink_of("vmc://localhost:99999", "127.0.0.1", True), ("vmc://localhost:99999",)),
        (lambda: source_of("telepathy://:1"), ("telepathy",)),
        (lambda: ReplaySource(Recording("bare"), HMD2Session), ("head", "bare")),
        (lambda: ReplaySource(swaying(10), HMD2Session, speed=0.0), ("speed",)),
        (lambda: join_sections(Path("nowhere")), ("no recorded motion",)),
    ],
)
def test_what_is_wrong_is_named(call, names):
    with pytest.raises(WearcapError) as error:
        call()
    assert all(name in str(error.value) for name in names)


def test_a_port_that_is_taken_ends_the_capture_with_its_reason():
    with socket.socket(type=socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        source = source_of(f"vmc://127.0.0.1:{taken.getsockname()[1]}")
        with pytest.raises(WearcapError, match="cannot listen"):
            LiveCapture(small_hmd2(), [source], []).run(10.0)


def test_a_replay_of_an_export_has_wrists_and_no_controllers_also_with_a_height(tmp_path: Path, monkeypatch):
    from wearcap.apps.live import __main__ as command
    from wearcap.recording.store import save_recording

    given: dict = {}
    monkeypatch.setattr(command, "load_exported", lambda _: drawn_echo())
    ran = SimpleNamespace(run=lambda _: {})
    monkeypatch.setattr(command, "LiveCapture", lambda *_, **settings: given.update(settings) or ran)
    save_recording(carried(), tmp_path / "in.safetensors")
    command.main(["model.onnx", "--recording", str(tmp_path / "in.safetensors"), "--height", "1.8"])
    assert (given["known"].hands, given["known"].setup) == ("joint", None)
    command.main(["model.onnx", "--source", "vmc://:39540"])
    assert given["known"].hands == "grip"


@pytest.mark.slow
def test_an_exported_model_captures_live_without_lightning_and_hydra(tmp_path: Path):
    """The command of an export, on a replay as fast as it goes, against the same export on the whole recording."""
    from wearcap.export import files
    from wearcap.recording.store import save_recording

    sensed = swaying(120)
    files.write_exports(small_hmd2().exports(), tmp_path / "model.onnx", "onnx")
    save_recording(sensed, tmp_path / "in.safetensors")
    program = (
        "import sys; from wearcap.apps.live.__main__ import main; main(sys.argv[1:]); "
        "assert not {'lightning', 'hydra', 'omegaconf'} & set(sys.modules)"
    )
    arguments = [tmp_path / "model.onnx", "--recording", tmp_path / "in.safetensors", "--speed", "inf"]
    command = [sys.executable, "-c", program, *arguments, "--record", tmp_path / "live"]
    report = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    assert report["wearers"]["wearer"]["frames"] == 120
    whole = files.load_exported(tmp_path / "model.onnx")(sensed, 0)
    found = read_motion(tmp_path / "live" / "wearer" / "motion.npz")
    torch.testing.assert_close(found.T_world_joint.t, whole.T_world_joint.t, atol=1e-3, rtol=0)
