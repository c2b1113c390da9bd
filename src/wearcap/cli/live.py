"""`wearcap live`: devices in, motion out, while people move."""

import json
import logging
import os
import re
import signal
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, TextIO

import torch
from omegaconf import DictConfig, ListConfig
from rich import print as show
from rich.markup import escape

from wearcap.apps.live.capture import LiveCapture, report_text
from wearcap.apps.live.page import LivePage
from wearcap.apps.live.setup import Known, read_setup
from wearcap.apps.live.sink import Sink
from wearcap.apps.live.sinks import sink_of
from wearcap.apps.live.source import Source
from wearcap.apps.live.sources import sources_of
from wearcap.apps.web.guard import LOOPBACK
from wearcap.body.skeleton import xsens23
from wearcap.cli.conf import compose, hydra_main, load_pipeline
from wearcap.cli.stated import stated
from wearcap.errors import WearcapError, nearest, require_choice
from wearcap.files import write_text
from wearcap.io.devices.hand_seats import SEATS
from wearcap.reading import read
from wearcap.recording.store import MANIFEST, dataset_folder
from wearcap.runtime.system import CaptureInput
from wearcap.tracking.stature import with_stature

MAX_MESSAGES = 20
"""Different messages of libraries that are shown."""
HANDS = ("auto", *SEATS, "joint")
"""What tracked hands are; the first seconds show it where nothing is stated."""


def run(config: DictConfig) -> dict[str, Any]:
    """Capture until interrupted, or until a replay has ended; returns the report."""
    if not (_listed(config.to) or config.view or config.record):
        fix = "Give to=ADDRESS, view=true (a page in the browser) or record=FOLDER."
        raise WearcapError("nothing leaves: no sink, no page, no record", fix=fix)
    threads = config.threads or max(1, (os.cpu_count() or 2) // 2)
    if threads < 1:
        raise WearcapError(f"threads={threads}", expected="1 or more")
    torch.set_num_threads(threads)
    system = load_pipeline(config.checkpoint, config.pipeline, config.device, shared=True)
    place = None
    if config.recording is not None:
        how = {**config, "hands": "auto"} if config.hands == "joint" else config
        recording, folder = read(config.recording, stated(how), config.check), dataset_folder(config.recording)
        if recording.note and not (folder / MANIFEST).is_file():
            _show(f"read: {recording.note}")
        if float(config.speed) > 1:  # too fast for the first minute, which looks at the wearer in real time
            recording, stature = with_stature(recording, xsens23(), config.height)
            recording = recording if stature.known else replace(recording, skeleton=xsens23())
            _show(f"height: {stature}" if stature.known else f"{stature}: give height=… (m)")
        place = CaptureInput.in_dataset(recording, folder, config.scene, config.metres_per_unit)
    require_choice(config.hands, HANDS, f"hands={config.hands}")
    speed, given = float(config.speed), _listed(config.source)
    sources, of_replay = sources_of(given, config.host, system, place, speed)
    setup_file = None if config.setup is None else Path(config.setup)
    setup = read_setup(setup_file) if setup_file is not None and setup_file.is_file() else None
    if (config.height is None or speed > 1) and not config.guided:
        setup = setup or of_replay
    # A recording has the wrists themselves.
    hands = "joint" if "replay" in given else config.hands
    sinks: list[Sink] = [sink_of(each, config.host, pace=speed <= 1) for each in _listed(config.to)]
    capture = LiveCapture(
        system,
        sources,
        sinks,
        known=Known(setup, config.height, hands, config.guided, setup_file),
        source=place,
        seed=config.seed,
        record=None if config.record is None else Path(config.record),
        recordings=Path(config.paths.run),
    )
    page = None
    if config.view:
        page = LivePage(capture, config.host, config.port, capture.objects)
        capture.add_sink(page)
    for name in ("", "websockets"):  # a quantisation's and a server's messages are no news to a wearer
        logging.getLogger(name).setLevel(logging.WARNING)
    _tell(config, sources, sinks, page)
    with _stopped_by_signals(capture), _repeats_counted():
        report = capture.run(float("inf") if config.seconds is None else float(config.seconds))
    write_text(config.report, report_text(report))
    _summarize(report)
    _show(f"report: {config.report}", sys.stdout)
    for name, sink in report["sinks"].items():
        if name.startswith("files ") and (lost := sink["failed"] + sink["dropped"]):
            what = f"{lost} parts of the recording are lost ({sink['last_error'] or 'the disk was too slow'})"
            raise WearcapError(what, name.removeprefix("files "), fix="Free some space, or record elsewhere.")
    return report


class _Repeats(logging.Filter):
    """Lets a message through once, in one line, and counts it."""

    def __init__(self):
        super().__init__()
        self.counts: Counter[str] = Counter()

    def filter(self, record: logging.LogRecord) -> bool:
        if (shown := getattr(record, "shown", None)) is not None:  # by another handler's filter
            return shown
        error = record.exc_info[1] if isinstance(record.exc_info, tuple) else None
        text = " ".join((record.getMessage().splitlines() or [""])[0].split()) + (f": {error}" if error else "")
        text = re.sub(r"\d+", "N", text)[:200]
        self.counts[text] += 1
        record.msg, record.args, record.exc_info, record.exc_text = text, (), None, None
        shown = self.counts[text] == 1 and len(self.counts) <= MAX_MESSAGES
        record.__dict__["shown"] = shown
        return shown


@contextmanager
def _repeats_counted() -> Iterator[None]:
    """Errors of servers and libraries that repeat are one line with a count."""
    repeats, handlers = _Repeats(), [*logging.getLogger().handlers, logging.lastResort]
    for handler in handlers:
        if handler is not None:
            handler.addFilter(repeats)
    try:
        yield
    finally:
        for handler in handlers:
            if handler is not None:
                handler.removeFilter(repeats)
        for text, count in repeats.counts.most_common(MAX_MESSAGES):
            if count > 1:
                _show(f"{count} times: {text}")


@contextmanager
def _stopped_by_signals(capture: LiveCapture) -> Iterator[None]:
    """SIGINT and SIGTERM end the capture, also where a shell that started it in the background lets the first be ignored."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, lambda *_: capture.stop()) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before):
            signal.signal(number, handler)


def _tell(config: DictConfig, sources: list[Source], sinks: list[Sink], page: LivePage | None) -> None:
    """Say what listens where, loudly where other machines can reach it."""
    for source in sources:
        _show(f"from {source.url}: {source.convention}; {source.hz:g} Hz")
    for sink in sinks:
        _show(f"to {getattr(sink, 'url', sink.name)}: {sink.convention}")
    taking = [source.name for source in sources if not source.loopback]
    giving = [sink.name for sink in sinks if sink.open_to_others]
    giving += ["the page"] if page is not None and config.host not in LOOPBACK else []
    parts = [f"{', '.join(taking)} takes packets from anyone who reaches this address"] if taking else []
    parts += [f"{', '.join(giving)} shows the body to whoever has its token"] if giving else []
    if parts:
        show(f"[bold red]OPEN TO OTHER MACHINES: {escape('; '.join(parts))}.", file=sys.stderr)
    if page is not None:
        _show(f"open {page.url} (Ctrl+C ends)")


def _show(line: str, file: TextIO | None = None) -> None:
    """Print a line as it is: names from the network are no markup, and addresses are not broken."""
    print(line, file=file or sys.stderr)


def _summarize(report: dict[str, Any]) -> None:
    notes: dict[str, list[str]] = {}
    for name, wearer in report["wearers"].items():
        latency = wearer["latency_ms"]
        text = ", ".join(f"{key} {latency[key]:.0f}" for key in ("median", "p95", "p99"))
        counts = ", ".join(f"{key} {wearer[key]}" for key in ("dropped", "late", "gaps"))
        own = f"(the system's own: {latency['of_the_system']:.0f})"
        _show(f"{name}: {wearer['frames']} frames, latency {text} ms {own}, {counts}", sys.stdout)
        for note in wearer["notes"]:
            notes.setdefault(note, []).append(name)
    for note, names in notes.items():
        _show(f"  {note}" + (f" ({', '.join(names)})" if len(report["wearers"]) > 1 else ""), sys.stdout)
    for name, sink in report["sinks"].items():
        if sink["dropped"] or sink["failed"]:
            why = f": {sink['last_error']}" if sink["last_error"] else ""
            _show(f"{name}: {sink['dropped']} pieces dropped, {sink['failed']} lost{why}", sys.stdout)
    for reason, count in report["refused"].items():
        _show(f"refused {count} × {reason}", sys.stdout)


def _listed(value: Any) -> list[str]:
    return [str(each) for each in value] if isinstance(value, list | ListConfig) else [str(value)]


def with_system(arguments: list[str]) -> list[str]:
    """Arguments with `system=NAME` as the choice of its pipeline, and with addresses quoted, which Hydra cannot read plain.

    Raises WearcapError for an unknown system.
    """
    systems = dict(compose("live").systems)
    chosen = []
    for argument in arguments:
        key, _, name = argument.partition("=")
        if key in ("source", "to"):
            addresses = (each.strip().strip("'\"") for each in name.strip("[]").split(","))
            chosen.append(f"{key}=[{','.join(json.dumps(each) for each in addresses if each)}]")
        elif key != "system":
            chosen.append(argument)
        elif name in systems:
            chosen.append(f"pipeline={systems[name]}")
        else:
            raise WearcapError(f"no live system {name!r}", expected=", ".join(systems), fix=nearest(name, systems))
    return chosen


def main(arguments: list[str]) -> None:
    hydra_main("live", run, with_system(arguments))
