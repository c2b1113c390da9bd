"""`wearcap live` under 2,000 silent sockets, slow writers and floods on every source, the sink and the page at once.

    python -m benchmarks.faults.live_siege [SYSTEM] [--minutes 10] [--sockets 2000] [--rate 500] [--recording DATASET/NAME]

A recording's head is played forth and back, 60 times a second, over a WebSocket; a watch posts over HTTP twice a second. The
others: silent sockets on all TCP ports, opened again 5 s after they are closed; 100 that write a byte a second; and, each so
many times a second, damaged messages and well-formed ones of seven invented wearers to every UDP source, requests and
handshakes that are wrong to every server. They give way to the capture (nice 10), as on another machine. Prints one JSON line:
messages and posts of the devices and how many arrived, frames recorded and due, memory (MiB) after the first minute and at the
end, connections at most, lines printed, latency (ms). Leaves with 1 when a device's message or a frame is lost, memory grows by
more than 16 MiB, or 50 lines or more are printed.
"""

import argparse
import http.client
import json
import math
import multiprocessing
import os
import random
import resource
import select
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

from benchmarks.faults.live_soak import Sender

sys.path[:0] = [str(Path(__file__).resolve().parents[2] / "tests")]

from ports import free_port, listens  # noqa: E402
from wearcap.apps.live.files_sink import join_sections  # noqa: E402
from wearcap.io.formats.motion_npz import read_motion  # noqa: E402

GROWTH_MIB, LINES, AGAIN_S, SLOW = 16.0, 50, 5.0, 100
WORST_HEAD = b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 10\r\n\r\n"


def enemy(target: Callable[..., None], *arguments: Any) -> multiprocessing.Process:
    """A process that gives way to the capture, as one of another machine would."""

    def run() -> None:
        os.nice(10)
        soft, hard = 8192, resource.getrlimit(resource.RLIMIT_NOFILE)[1]
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft if hard < 0 else min(soft, hard), hard))
        target(*arguments)

    process = multiprocessing.get_context("fork").Process(target=run, daemon=True)
    process.start()
    return process


def silent(ports: list[int], count: int) -> None:
    """So many sockets that say nothing; one that is closed is opened again after `AGAIN_S`."""
    poll, held, again = select.epoll(), {}, [(0.0, ports[k % len(ports)]) for k in range(count)]
    while True:
        now_s = time.monotonic()
        while again and again[0][0] <= now_s:
            port = again.pop(0)[1]
            one = socket.socket()
            one.setblocking(False)
            with suppress(BlockingIOError):
                one.connect(("127.0.0.1", port))
            held[one.fileno()] = one, port
            poll.register(one, select.EPOLLIN | select.EPOLLHUP | select.EPOLLRDHUP)
            if len(again) % 50 == 0:
                time.sleep(0.01)
        for number, _ in poll.poll(0.2):
            one, port = held.pop(number)
            poll.unregister(number)
            one.close()
            again.append((time.monotonic() + AGAIN_S, port))


def slow(ports: list[int]) -> None:
    """Sockets that write a request's head, a byte a second."""
    held: dict[int, tuple[socket.socket, int]] = {}
    while True:
        for k in range(SLOW):
            try:
                if k not in held:
                    held[k] = socket.create_connection(("127.0.0.1", ports[k % len(ports)]), 1.0), 0
                one, place = held[k]
                one.send(WORST_HEAD[place : place + 1])
                held[k] = one, (place + 1) % len(WORST_HEAD)
            except OSError:
                held.pop(k, None)
        time.sleep(1.0)


def datagrams(ports: list[int], rate: float, head: bytes) -> None:
    """Damaged messages, and well-formed ones of invented wearers, of senders that change."""
    draw, number = random.Random(0), 0
    while True:
        with socket.socket(type=socket.SOCK_DGRAM) as sender:
            for _ in range(100):
                number += 1
                if number % 2:
                    message = json.loads(head) | {"wearer": f"invented {number % 7}", "time": number / 100}
                    data = json.dumps(message).encode()
                else:
                    data = bytearray(head)
                    for _ in range(4):
                        data[draw.randrange(len(data))] = draw.randrange(256)
                with suppress(OSError):
                    sender.sendto(data, ("127.0.0.1", ports[number // 2 % len(ports)]))
                time.sleep(1 / rate)


def requests(ports: list[int], rate: float) -> None:
    """Requests and handshakes that are wrong, one after another."""
    starts = (
        b"GET / HTTP/1.1\r\nHost: evil.example\r\n\r\n",
        b"\x16\x03\x01\x02",
        WORST_HEAD + b"0123456789",
        b"x" * 20_000,
    )
    number = 0
    while True:
        number += 1
        with suppress(OSError), socket.create_connection(("127.0.0.1", ports[number % len(ports)]), 1.0) as one:
            one.settimeout(0.2)
            one.sendall(starts[number % len(starts)])
            one.recv(1000)
        time.sleep(1 / rate)


class Adapter(threading.Thread):
    """The head of a recording over a WebSocket, at its rate; a closed connection is a lost device."""

    def __init__(self, sender: Sender, port: int, seconds: float):
        super().__init__(daemon=True)
        self.sender, self.port, self.seconds, self.sent, self.error = sender, port, seconds, 0, ""

    def run(self) -> None:
        for _ in range(50):
            with suppress(OSError, WebSocketException), connect(f"ws://127.0.0.1:{self.port}/", open_timeout=2.0) as to:
                return self._send(to)
        self.error = "it never got in"
        return None

    def _send(self, to: Any) -> None:
        begin_s = time.monotonic()
        for k in range(math.ceil(60 * self.seconds)):
            if (left_s := begin_s + k / 60 - time.monotonic()) > 0:
                time.sleep(left_s)
            try:
                to.send(self.sender._message("head", k / 60).decode())
            except WebSocketException as error:
                self.error = str(error)
                return
            self.sent += 1


class Watch(threading.Thread):
    """A watch that posts a sample twice a second on a connection that it keeps, and opens again when it is closed."""

    def __init__(self, port: int):
        super().__init__(daemon=True)
        self.port, self.sent, self.arrived, self.ended = port, 0, 0, threading.Event()

    def run(self) -> None:
        sample: dict[str, Any] = {"deviceID": "watch"} | {
            f"motionQuaternion{axis}": float(axis == "W") for axis in "WXYZ"
        }
        for axis in "XYZ":
            sample |= {f"motionGravity{axis}": -float(axis == "Z"), f"motionUserAcceleration{axis}": 0.0}
        client = http.client.HTTPConnection("127.0.0.1", self.port, timeout=5)
        while not self.ended.wait(0.5):
            self.sent += 1
            body = json.dumps(sample | {"motionTimestamp_sinceReboot": self.sent / 2})
            for _ in range(3):
                try:
                    client.request("POST", "/", body)
                    answer = client.getresponse()
                    answer.read()
                    self.arrived += answer.status == 200
                    break
                except (OSError, http.client.HTTPException):
                    client.close()


def siege(system: str, minutes: float, sockets: int, rate: float, where: str) -> dict[str, Any]:
    """Run one system under siege; the row that is printed."""
    ws, posts, sink, page = (free_port() for _ in range(4))
    udp = {name: free_port(socket.SOCK_DGRAM) for name in ("json", "vmc", "watch", "osctrackers")}
    sender = Sender(system, where, 0, 0.0, rough=False)
    assert sender.setup is not None
    with tempfile.TemporaryDirectory() as folder:
        report, record = Path(folder) / "report.json", Path(folder) / "recorded"
        sources = ",".join([*(f"{name}://127.0.0.1:{port}" for name, port in udp.items()), f"ws://127.0.0.1:{ws}"])
        command = [sys.executable, "-m", "wearcap.cli.main", "live", f"system={system}", "threads=1", "view=true"]
        command += [f"source=[{sources},watch+http://127.0.0.1:{posts}]", f"to=[ws://127.0.0.1:{sink}]", f"port={page}"]
        command += [f"report={report}", f"record={record}", f"hydra.run.dir={folder}"]
        command += [f"height={sender.setup.skeleton.stature:.3f}"]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        lines: list[str] = []
        threading.Thread(target=lambda: lines.extend(process.stdout or []), daemon=True).start()
        while not (listens(ws) and listens(posts) and listens(page)) and process.poll() is None:
            time.sleep(0.5)
        ports, head = [ws, posts, sink, page], sender._message("head", 0.0)
        enemies = [enemy(silent, ports, sockets), enemy(slow, ports), enemy(requests, ports, rate)]
        enemies.append(enemy(datagrams, list(udp.values()), rate, head))
        time.sleep(5.0)
        adapter, watch, watched = Adapter(sender, ws, 60 * minutes), Watch(posts), psutil.Process(process.pid)
        adapter.start()
        watch.start()
        memory, open_files, begin_s = [], 0, time.monotonic()
        while adapter.is_alive() and process.poll() is None:
            adapter.join(2.0)
            with suppress(psutil.Error):
                memory.append((time.monotonic() - begin_s, watched.memory_info().rss / 2**20))
                open_files = max(open_files, watched.num_fds())
        watch.ended.set()
        watch.join()
        time.sleep(1.0)
        process.send_signal(signal.SIGTERM)
        process.wait(120)
        for each in enemies:
            each.kill()
        if not report.is_file():
            raise SystemExit("".join(lines[-20:]))
        found, motion = json.loads(report.read_text()), recorded(record)
    return row_of(system, minutes, sender, adapter, watch, found, motion, memory, open_files, lines)


def row_of(
    system: str,
    minutes: float,
    sender: Sender,
    adapter: Adapter,
    watch: Watch,
    found: dict[str, Any],
    motion: int,
    memory: list[tuple[float, float]],
    open_files: int,
    lines: list[str],
) -> dict[str, Any]:
    """What is printed of a run: of its report, its recorded frames, its memory over time (s, MiB), files and lines."""
    about = found["wearers"]["wearer" if "wearer" in found["wearers"] else "unnamed wearer"]
    early = next((mib for at_s, mib in memory if at_s > min(60.0, 30.0 * minutes)), memory[0][1])
    late = math.ceil(60 * sender.latency_ms / 1000) + 2
    row = {
        "name": f"live_siege_{system}",
        "minutes": minutes,
        "sent": adapter.sent,
        "adapter": adapter.error or "kept",
        "posts": [watch.sent, watch.arrived],
        "frames": about["frames"],
        "recorded": motion,
        "sessions": about["sessions"],
        "gaps": about["gaps"],
        "p95_ms": about["latency_ms"]["p95"],
        "own_latency_ms": round(sender.latency_ms, 1),
        "memory_mib": [round(early, 1), round(memory[-1][1], 1)],
        "files": open_files,
        "lines": len(lines),
        "sinks": found["sinks"],
        "overflowed": found["overflowed"],
        "refused": found["refused"],
    }
    whole = adapter.sent == math.ceil(60 * 60 * minutes) and watch.sent == watch.arrived and about["sessions"] == 1
    whole = whole and min(about["frames"], motion) >= adapter.sent - late
    row["sound"] = bool(whole and memory[-1][1] - early <= GROWTH_MIB and len(lines) < LINES)
    return row


def recorded(folder: Path) -> int:
    """Frames of the wearer's recording."""
    own = folder / "wearer"
    return len(read_motion(own / "motion.npz") if (own / "motion.npz").is_file() else join_sections(own))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("system", nargs="?", default="hmd2", metavar="SYSTEM")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--sockets", type=int, default=2000)
    parser.add_argument("--rate", type=float, default=500.0, help="of each flood (1/s)")
    parser.add_argument("--recording", default="datasets/simulated/sim-test-0-0000")
    options = parser.parse_args()
    row = siege(options.system, options.minutes, options.sockets, options.rate, options.recording)
    print(json.dumps(row), flush=True)
    os._exit(not row["sound"])


if __name__ == "__main__":
    main()
