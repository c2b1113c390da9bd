"""The live page in headless Chromium: driven through the guided minute, a recording and the end, by a simulated wearer.

    python -m benchmarks.faults.live_page [mocap_every | echo] [--output outputs/live_page] [--height 1.66] [--seed 0] [--slow 1]

Runs `wearcap live` with a page and the shared checkpoint. A simulated wearer's devices send to it over loopback sockets: for
mocap_every a head's poses 60 times a second and two watches' samples 100 times, for echo a head and two controllers. The wearer
does what the page's sentences ask, then walks while the page records. Keeps a screenshot of each step in the output, and prints
one JSON line: how far the height, seats (degrees), headings and the recorded joints are from what was acted, the report's
latency (of this machine, with the browser and the devices on it), and how many of the pages' scripts failed.
`--slow 8`: all clocks, the command's too, go 8 times slower, for a machine that is too busy to draw the page and capture at once.
Needs Chromium (apt-get install chromium). Leaves with 1 where a step or a button does not work.
"""

import argparse
import json
import math
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import torch

from benchmarks.faults.acted_wearer import ACTS, STAND, Actor, Sender, act_of

sys.path[:0] = [str(Path(__file__).resolve().parents[2] / "tests")]

from ports import free_port  # noqa: E402
from wearcap.apps.live.setup import Setup, read_setup  # noqa: E402
from wearcap.body.skeleton import WRISTS  # noqa: E402
from wearcap.geometry import rotation  # noqa: E402
from wearcap.metrics.position import mpjpe_cm, root_error_cm  # noqa: E402
from wearcap.reading import read  # noqa: E402
from wearcap.recording import Motion  # noqa: E402
from wearcap.recording.timing import at_times  # noqa: E402
from wearcap_browser import Chromium, chromium  # noqa: E402

STARTS_S, GUIDES_S, RECORDS_S = 300.0, 120.0, 10.0
SLOWED = """
import sys, time
slow, monotonic, sleep = float(sys.argv.pop(1)), time.monotonic, time.sleep
time.monotonic, time.sleep = lambda: monotonic() / slow, lambda seconds: sleep(seconds * slow)
from wearcap.cli.main import main
main()
"""
"""The command with a clock that goes slower."""
LOOK_S = 0.6
"""Time (s) after which a step is pictured, so that its bar has begun."""


class Command:
    """`wearcap live` in a process of its own."""

    def __init__(self, system: str, ports: tuple[int, ...], folder: Path, slow: float):
        self.folder, self.errors = folder, []
        self.setup, self.report = folder / "setup.json", folder / "report.json"
        if system == "echo":
            sources = [f"vmc://127.0.0.1:{ports[0]}"]
        else:
            sources = [f"json://127.0.0.1:{ports[0]}", *(f"watch://127.0.0.1:{port}" for port in ports[1:])]
        program = ["-m", "wearcap.cli.main"] if slow == 1 else ["-c", SLOWED, str(slow)]
        command = [sys.executable, *program, "live", f"system={system}", f"source=[{','.join(sources)}]"]
        command += ["view=true", "guided=true", f"port={free_port()}", f"setup={self.setup}"]
        command += [f"report={self.report}", f"hydra.run.dir={folder}", f"paths.run={folder}"]
        # One line each: messages that are not for a terminal are wrapped at 80 columns otherwise.
        self.process = subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=os.environ | {"COLUMNS": "500"}
        )
        threading.Thread(target=lambda: self.errors.extend(self.process.stderr or []), daemon=True).start()

    @property
    def url(self) -> str:
        """The page's address; empty while there is none. Raises SystemExit where the command has ended."""
        if self.process.poll() is not None:
            raise SystemExit("".join(self.errors[-20:]) or "wearcap live has ended")
        lines = [line.split()[1] for line in list(self.errors) if line.startswith("open http")]
        return lines[0] if lines else ""

    def end(self) -> None:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(60)
            self.process.kill()


@contextmanager
def running(system: str, actor: Actor, folder: Path, slow: float) -> Iterator[tuple[Command, Sender]]:
    """The command and the devices, which send once it listens."""
    watches = system != "echo"
    ports = tuple(free_port(socket.SOCK_DGRAM) for _ in range(3 if watches else 1))
    command, sender = Command(system, ports, folder, slow), Sender(actor, ports, watches, slow)
    try:
        Chromium.poll(lambda: command.url, STARTS_S)
        yield command, sender
    finally:
        sender.stopped.set()
        command.end()


class Pictures:
    """Numbered screenshots."""

    def __init__(self, browser: Chromium, output: Path):
        self.browser, self.output, self.count = browser, output, 0

    def take(self, name: str) -> None:
        self.count += 1
        # viser's warning of a browser without a graphics card
        self.browser.evaluate("document.querySelectorAll('.mantine-Notification-closeButton').forEach(e => e.click())")
        self.browser.screenshot(self.output / f"{self.count:02d}_{name}.png")


def guide(browser: Chromium, actor: Actor, pictures: Pictures, slow: float) -> list[str]:
    """Do what the page asks until the capture runs; the sentences, in order."""
    asked, begun_s, pictured = [], time.monotonic(), True
    while "● live" not in (text := browser.text()):
        if (now_s := time.monotonic()) - begun_s > GUIDES_S * slow:
            raise SystemExit(f"the guided minute does not end: it asked for {asked}")
        sentence = next((each for each in ACTS if each in text), None)
        if sentence is not None and sentence not in asked[-1:]:
            asked.append(sentence)
            actor.asked, seen_s, pictured = act_of(sentence) or STAND, now_s, False
        if not pictured and now_s - seen_s > LOOK_S * slow:
            pictures.take(asked[-1].lower().replace(" ", "_"))
            pictured = True
        time.sleep(0.1 * slow)
    actor.asked = STAND
    return asked


def record(browser: Chromium, actor: Actor, pictures: Pictures, slow: float) -> None:
    """Record a walk by the page's button, and stop both by its buttons."""
    time.sleep(3.0 * slow)
    pictures.take("live")
    browser.press("Record", lambda: "Recording to" in browser.text())
    actor.asked, begun_s = "walk", time.monotonic()
    while (now_s := (time.monotonic() - begun_s) / slow) < RECORDS_S:
        pictures.take(f"recording_{now_s:.0f}_s")
        time.sleep(1.0 * slow)
    actor.asked = STAND
    browser.press("Stop recording", lambda: "Not recording" in browser.text())
    pictures.take("stopped_recording")
    # The page is gone once the capture has ended.
    browser.click(*browser.labelled("Stop the capture"))


def seat_errors(setup: Setup, sender: Sender) -> dict[str, float]:
    """Degrees by which seats and headings of the devices are off."""
    worn, found = sender.worn, {}
    seats = {seat.joint: seat for seat in setup.seats.values()}
    for joint, T_joint_device in zip(("head", *WRISTS), (worn.T_head_device, *worn.T_wrist_device)):
        off = rotation.geodesic(seats[joint].R_joint_device, T_joint_device.R)
        found[f"{joint}_seat_deg"] = round(math.degrees(off.item()), 1)
    for joint, yaw in zip(WRISTS, worn.yaw_rad if sender.watches else ()):
        off = math.remainder(seats[joint].yaw_rad - yaw, 2 * math.pi)
        found[f"{joint}_heading_deg"] = round(math.degrees(off), 1)
    return found


def joint_errors(captured: Motion, acted: Motion) -> dict[str, float]:
    """Distances (cm) of the recorded joints from the acted ones, in the head's world and from the root."""
    truth = at_times(acted, captured.timestamps)
    found, true = captured.T_world_joint.t, truth.T_world_joint.t
    return {
        "recorded_s": round((captured.timestamps[-1] - captured.timestamps[0]).item(), 1),
        "walked_m": round(true[:, 0].diff(dim=0).norm(dim=-1).sum().item(), 1),
        "mpjpe_cm": round(mpjpe_cm(found, true).item(), 1),
        "mpjpe_from_root_cm": round(mpjpe_cm(found - found[:, :1], true - true[:, :1]).item(), 1),
        "root_cm": round(root_error_cm(captured.t_world_root, truth.t_world_root).item(), 1),
        "lowest_joint_cm": round(100 * (found[..., 2].amin(-1) - true[..., 2].amin(-1)).mean().item(), 1),
    }


def drive(system: str, output: Path, actor: Actor, slow: float) -> dict[str, Any]:
    """Run one system; the row that is printed."""
    shutil.rmtree(output, ignore_errors=True)
    output.mkdir(parents=True)
    folder = output / "run"
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile,
        running(system, actor, folder, slow) as (command, sender),
        chromium(Path(profile), command.url) as browser,
    ):
        pictures = Pictures(browser, output)
        Chromium.poll(lambda: "Starting" in browser.text() or "Not recording" in browser.text())
        pictures.take("starting")
        Chromium.poll(lambda: "Not recording" in browser.text(), STARTS_S)
        sender.start()
        asked = guide(browser, actor, pictures, slow)
        record(browser, actor, pictures, slow)
        ended = command.process.wait(STARTS_S)
        failed = len(browser.exceptions)
    if not command.report.is_file():
        raise SystemExit("".join(command.errors[-20:]) or f"wearcap live has ended with {ended} and no report")
    report, setup = json.loads(command.report.read_text()), read_setup(command.setup)
    (recording,) = folder.glob("recording_*/*/motion.npz")
    captured, about = read(recording.parent).motion, report["wearers"]["wearer"]
    assert captured is not None
    height_m = actor.person.skeleton.stature
    row = {"name": f"live_page_{system}", "asked": asked, "devices": [*setup.seats], "left_with": ended, "slow": slow}
    row |= {"height_m": round(height_m, 3), "height_off_cm": round(100 * (setup.skeleton.stature - height_m), 1)}
    row |= {"floor_m": setup.floor_m, **seat_errors(setup, sender), **joint_errors(captured, actor.motion)}
    row |= {"latency_ms": about["latency_ms"], "gaps": about["gaps"], "late": about["late"], "notes": about["notes"]}
    return row | {"packets": sender.sent, "refused": report["refused"], "scripts_failed": failed}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("system", nargs="?", default="mocap_every", choices=("mocap_every", "echo"))
    parser.add_argument("--output", type=Path, default=Path("outputs/live_page"))
    parser.add_argument("--height", type=float, default=1.66, help="of the wearer (m), within a centimetre")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--slow", type=float, default=1.0, help="how much slower than real time all goes")
    options = parser.parse_args()
    torch.set_num_threads(1)
    row = drive(options.system, options.output, Actor(options.height, options.seed), options.slow)
    print(json.dumps(row), flush=True)
    os._exit(bool(row["left_with"] or row["scripts_failed"]))


if __name__ == "__main__":
    main()
