"""`wearcap live` over real sockets for a long time: memory, wearers and latency, with a sound and with a rough network.

    python -m benchmarks.faults.live_soak [SYSTEM ...] [--minutes 30] [--rough] [--recording DATASET/NAME] [--threads N]

A recording is played forth and back as JSON datagrams: head and wrists 60 times a second, or head 60 and each of two watches
100 times, on clocks of their own. `--rough`: 5 % of the packets are lost, all are late by up to 20 ms, 1 % overtake others, a
WebSocket client reads nothing, and the receiver of the body goes away for a minute. Nothing is faster than real time.
Prints one JSON line per system: frames, gaps, sessions ended, latency (ms) from a packet's device time to the pose that leaves
and to the datagram's arrival at an independent receiver, each against the system's own latency, and the process's memory after
the first minute and at the end. Leaves with 1 when memory grows by more than 16 MiB, a wearer is lost, or the pose that leaves
or arrives is later than the system's latency and 25 ms at the 95th percentile.
"""

import argparse
import heapq
import json
import os
import random
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from pythonosc.osc_packet import OscPacket
from websockets.sync.client import connect

sys.path[:0] = [str(Path(__file__).resolve().parents[2] / "tests")]

from ports import free_port, listens  # noqa: E402
from wearcap.apps.live.sources.replay import ReplaySource  # noqa: E402
from wearcap.cli.conf import compose, load_pipeline  # noqa: E402
from wearcap.geometry.rotation import quat_wxyz_from_matrix  # noqa: E402
from wearcap.reading import read  # noqa: E402
from wearcap.sensors.samples import HeadSample, WatchSample, WristSample  # noqa: E402

SYSTEMS = ("hmd2", "mocap_every", "echo")
LOSS, JITTER_S, OVERTAKES, OVERTAKEN_S = 0.05, 0.02, 0.01, 0.03
GROWTH_MIB, BEYOND_MS, WATCH_HZ = 16.0, 25.0, 100.0
CLOCKS = {"left_wrist": -51.3, "right_wrist": 7200.7}
"""Seconds by which the watches' clocks differ from the head's."""


class Sender(threading.Thread):
    """Sends a recording's samples in real time, forth and back."""

    def __init__(self, system: str, where: str, port: int, seconds: float, rough: bool):
        super().__init__(daemon=True)
        pipeline = load_pipeline(
            None, compose("live", ["recording=x", f"pipeline={system}_online"]).pipeline, "cpu", True
        )
        self.latency_ms = 1000 * pipeline.latency_s
        self.setup = (source := ReplaySource(read(where), pipeline.session_class())).setup
        self.samples: dict[str, list[tuple[float, Any]]] = {}
        for sent_s, device, sample in source.events():
            self.samples.setdefault(device, []).append((sent_s, sample))
        self.port, self.seconds, self.rough, self.draw = port, seconds, rough, random.Random(0)
        self.begun_s = 0.0
        self.sent = 0

    def run(self) -> None:
        out, waiting, number = socket.socket(type=socket.SOCK_DGRAM), [], 0
        hz = {
            device: WATCH_HZ if isinstance(rows[0][1], WatchSample) else 60.0 for device, rows in self.samples.items()
        }
        for device in self.samples:
            heapq.heappush(waiting, (0.0, number := number + 1, device, 0, None))
        self.begun_s = time.monotonic()
        while waiting:
            due_s, _, device, k, message = heapq.heappop(waiting)
            if due_s > self.seconds:
                break
            if (left_s := self.begun_s + due_s - time.monotonic()) > 0:
                time.sleep(left_s)
            if message is not None:
                out.sendto(message, ("127.0.0.1", self.port))
                self.sent += 1
                continue
            message = self._message(device, k / hz[device])
            if not self.rough:
                out.sendto(message, ("127.0.0.1", self.port))
                self.sent += 1
            elif self.draw.random() >= LOSS:
                late_s = JITTER_S * self.draw.random() + OVERTAKEN_S * (self.draw.random() < OVERTAKES)
                heapq.heappush(waiting, (due_s + late_s, number := number + 1, device, k, message))
            heapq.heappush(waiting, ((k + 1) / hz[device], number := number + 1, device, k + 1, None))

    def _message(self, device: str, at_s: float) -> bytes:
        """The sample nearest to a time of the recording that is played forth and back."""
        rows = self.samples[device]
        first_s, last_s = rows[0][0], rows[-1][0]
        phase = at_s % (2 * (last_s - first_s))
        place = min(phase, 2 * (last_s - first_s) - phase) / (last_s - first_s)
        sample = rows[round(place * (len(rows) - 1))][1]
        about: dict[str, Any] = {"device": device, "time": at_s}
        match sample:
            case HeadSample() | WristSample():
                pose = sample.T_world_device if isinstance(sample, HeadSample) else sample.T_world_joint
                about |= {"position": pose.t.tolist(), "rotation_wxyz": quat_wxyz_from_matrix(pose.R.double()).tolist()}
            case WatchSample():
                R = quat_wxyz_from_matrix(sample.R_world_imu.double()).tolist()
                about |= {"rotation_wxyz": R, "acceleration": sample.acc_world.tolist()}
                about |= {"time": at_s + CLOCKS[device], "clock": device}
        return json.dumps(about).encode()


class Receiver(threading.Thread):
    """Takes the body's datagrams, and how late they are; in a rough network it goes away for a minute."""

    def __init__(self, sender: Sender, rough: bool):
        super().__init__(daemon=True)
        self.sender, self.rough, self.late_ms = sender, rough, []
        self.socket = socket.socket(type=socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.port = self.socket.getsockname()[1]

    def run(self) -> None:
        away = False
        while True:
            data, now_s = self.socket.recv(65536), time.monotonic()
            times = [m.message.params[0] for m in OscPacket(data).messages if m.message.address == "/VMC/Ext/T"]
            self.late_ms.append(1000 * (now_s - self.sender.begun_s - times[0]))
            if self.rough and not away and now_s - self.sender.begun_s > self.sender.seconds / 3:
                self.socket.close()
                time.sleep(min(60.0, self.sender.seconds / 6))
                self.socket = socket.socket(type=socket.SOCK_DGRAM)
                self.socket.bind(("127.0.0.1", self.port))
                away = True


def stalled_client(port: int) -> None:
    """A WebSocket client that reads nothing, anew whenever it is thrown out."""
    while True:
        try:
            with connect(f"ws://127.0.0.1:{port}", max_queue=1, open_timeout=2.0, ping_interval=None) as client:
                client.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
                time.sleep(30.0)
        except Exception:  # not there yet, or gone
            time.sleep(1.0)


def soak(system: str, minutes: float, rough: bool, where: str, threads: int | None = None) -> dict[str, Any]:
    """Run one system; the row that is printed."""
    port, ws_port = free_port(socket.SOCK_DGRAM), free_port()
    sender = Sender(system, where, port, 60 * minutes, rough)
    receiver = Receiver(sender, rough)
    assert sender.setup is not None
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        command = [
            sys.executable,
            "-m",
            "wearcap.cli.main",
            "live",
            f"system={system}",
            f"source=json://127.0.0.1:{port}",
        ]
        command += [f"to=[vmc://127.0.0.1:{receiver.port},ws://127.0.0.1:{ws_port}]", f"report={report}"]
        command += [f"height={sender.setup.skeleton.stature:.3f}", f"hydra.run.dir={folder}"]
        command += [] if threads is None else [f"threads={threads}"]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        errors: list[str] = []
        threading.Thread(target=lambda: errors.extend(process.stderr or []), daemon=True).start()
        watched, memory = psutil.Process(process.pid), []
        while not listens(port, socket.SOCK_DGRAM) and process.poll() is None:
            time.sleep(0.5)
        time.sleep(3.0)
        if rough:
            threading.Thread(target=stalled_client, args=(ws_port,), daemon=True).start()
        receiver.start()
        sender.start()
        while sender.is_alive() and process.poll() is None:
            sender.join(10.0)
            if process.poll() is None:
                memory.append((time.monotonic() - sender.begun_s, watched.memory_info().rss / 2**20))
        time.sleep(1.0)
        cpu_s = sum(watched.cpu_times()[:2]) if process.poll() is None else float("nan")
        process.send_signal(signal.SIGTERM)
        process.wait(60)
        if not report.is_file():
            raise SystemExit("".join(errors[-20:]))
        found = json.loads(report.read_text())
    return row_of(system, minutes, rough, sender, receiver, found, memory, cpu_s)


def row_of(
    system: str,
    minutes: float,
    rough: bool,
    sender: Sender,
    receiver: Receiver,
    found: dict[str, Any],
    memory: list[tuple[float, float]],
    cpu_s: float,
) -> dict[str, Any]:
    """What is printed of a run: of its report, of its memory over time (s, MiB), and of its processor time."""
    about = found["wearers"]["wearer"]
    early = next((mib for at_s, mib in memory if at_s > min(60.0, 30.0 * minutes)), memory[0][1])
    latency, arrived = about["latency_ms"], np.array(receiver.late_ms)
    row = {
        "name": f"live_{system}" + ("_rough" if rough else ""),
        "minutes": minutes,
        "packets": sender.sent,
        "frames": about["frames"],
        "gaps": about["gaps"],
        "late": about["late"],
        "sessions": about["sessions"],
        "own_latency_ms": round(sender.latency_ms, 1),
        "median_ms": latency["median"],
        "p95_ms": latency["p95"],
        "p99_ms": latency["p99"],
        "p95_beyond_ms": round(latency["p95"] - sender.latency_ms, 1),
        "received": len(arrived),
        "received_p95_beyond_ms": round(float(np.quantile(arrived, 0.95)) - sender.latency_ms, 1),
        "memory_mib": [round(early, 1), round(memory[-1][1], 1)],
        "cores": round(cpu_s / (60 * minutes), 2),
        "refused": found["refused"],
        "sinks": found["sinks"],
    }
    lost = about["sessions"] != 1
    latest = max(row["p95_beyond_ms"], row["received_p95_beyond_ms"])
    row["sound"] = bool(memory[-1][1] - early <= GROWTH_MIB and not lost and latest <= BEYOND_MS)
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("systems", nargs="*", default=SYSTEMS, metavar="SYSTEM", help=", ".join(SYSTEMS))
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--rough", action="store_true")
    parser.add_argument("--recording", default="datasets/simulated/sim-test-0-0000")
    parser.add_argument("--threads", type=int, help="of the network; default: wearcap live's own")
    options = parser.parse_args()
    sound = True
    for system in options.systems:
        row = soak(system, options.minutes, options.rough, options.recording, options.threads)
        print(json.dumps(row), flush=True)
        sound &= row["sound"]
    os._exit(not sound)


if __name__ == "__main__":
    main()
