"""A live capture: sources deliver packets, every wearer's session makes poses of them, sinks take them."""

import asyncio
import gc
import json
import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import Any

import torch

from wearcap.apps.live.packets import HEAD, Inbox, Packet
from wearcap.apps.live.setup import Setup, plain_name, read_setup, write_setup
from wearcap.apps.live.setup_estimation import SetupEstimation
from wearcap.apps.live.sink import Sink, SinkThread
from wearcap.apps.live.source import Source
from wearcap.apps.live.status import LiveStatus, SinkStatus
from wearcap.apps.live.wearer import LiveWearer, Opener
from wearcap.body.skeleton import xsens23
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.recording import Motion, Recording
from wearcap.runtime.system import CaptureInput, System
from wearcap.runtime.wearer import Wearer
from wearcap.sensors.samples import HeadSample, WatchSample, WristSample

MAX_WEARERS = 8
"""Most wearers; packets of further ones are counted as refused."""
FORGOTTEN_S = 60.0
"""Time without packets after which a wearer who is not captured makes room for another."""
WAIT_S = 0.02
"""Longest time without a look at who has left and what the page wishes."""
CATCH_UP_S = 5.0
"""Time without a look at what has come, as of a slow engine or a suspended process, after which that is left out: as long as
that without packets after which a wearer has left (`wearer.AWAY_S`). Nobody who watches needs poses that are so late, and
computing them would make the next ones late, too. What a machine takes now and then, it makes up for within seconds."""
BEHIND_S, TOO_LONG_S, CALM_S = 0.25, 1.0, 60.0
"""Age (s) of packets from which the capture is behind, time for which it may be before a wearer is let go, and time after
which one more is tried; that doubles each time."""
WARM_UP_S = 2.0
"""Length of what the network is run on before the first packet."""
JOIN_S = 600.0
"""Longest time for the files of a recording to be joined at its end."""
RESTART_S = 2.0
"""Time after which a source that failed is started again."""


class _Capacity:
    """How many wearers this machine captures at their rate, as the packets show that wait."""

    def __init__(self):
        self.most, self._calm_s = MAX_WEARERS, CALM_S
        self._in_time_s = self._changed_s = time.monotonic()

    def is_exceeded(self, packets: Sequence[Packet], live: int) -> bool:
        """Whether packets wait for `TOO_LONG_S` on end, of so many wearers: there is one too many. After a calm time one more
        is tried."""
        now_s = time.monotonic()
        if not packets or now_s - packets[0].arrived_s < BEHIND_S:
            self._in_time_s = now_s
            if self.most < MAX_WEARERS and now_s - self._changed_s > self._calm_s:
                self.most, self._changed_s = self.most + 1, now_s
            return False
        if live < 2 or now_s - self._in_time_s < TOO_LONG_S:
            return False
        self.most, self._calm_s = live - 1, 2 * self._calm_s
        self._in_time_s = self._changed_s = now_s
        return True


class LiveCapture:
    """Runs until its sources end, `seconds` are over or `stop` is called. Its public methods may be called by any thread."""

    def __init__(
        self,
        system: System,
        sources: Sequence[Source],
        sinks: Sequence[Sink],
        *,
        source: CaptureInput | None = None,
        setup: Setup | None = None,
        height_m: float | None = None,
        hands: str = "grip",
        guided: bool = False,
        setup_file: Path | None = None,
        seed: int = 0,
        recorder: Callable[[Path], Sink] | None = None,
        record: Path | None = None,
        recordings: Path = Path(),
    ):
        """`source`: recording, scan and objects of the place, for systems that use them; `setup`: of every wearer, from the
        beginning; `hands`: what hand poses are (`setup.hand_seat`); `setup_file`: where what the first minute finds is kept; `recorder` makes the sink that writes to a
        folder, from the start where `record` names one, else in `recordings` when the
        page asks for it. Raises WearcapError for a system that does not stream.
        """
        self.system, self.sources = system, list(sources)
        self.latency_s = system.latency_s
        kind = system.session_class()
        if kind.takes_objects and source is None:
            source = CaptureInput(Recording("live"))  # the system itself may name a file of objects
        environment = system.objects(source) if kind.takes_objects and source is not None else None
        self.objects = () if environment is None else environment.objects
        """Those of the place, where the system takes objects."""
        minute = lambda before, guide: SetupEstimation(  # noqa: E731
            kind.devices,
            tracked=kind.tracks_wrists,
            hands=hands,
            height_m=height_m,
            setup=before,
            guided=guide or guided,
        )
        open_session = lambda wearer: kind.of_wearers(system, [wearer], seed, source)  # noqa: E731
        self.opener = Opener(open_session, kind.devices, kind.tracks_wrists, kind.takes_objects, minute)
        self.inbox = Inbox()
        self.wearers: dict[str, LiveWearer] = {}
        self.sinks = [SinkThread(sink) for sink in sinks]
        self._setup, self._setup_file, self._guided, self._height_m = setup, setup_file, guided, height_m
        self._recorder, self._recording = recorder, None
        self._record_from_start = record
        self._recorded: SinkThread | None = None
        self._recorders: list[SinkThread] = []
        """All recorders of this capture, those that are closed among them: the report has them."""
        self._closing: list[threading.Thread] = []
        self._recordings = recordings
        self._wishes: list[Callable[[], None]] = []
        self._stopping = threading.Event()
        self._began_s = time.monotonic()
        self._looked_s = math.inf
        """Our time (s) of the last look at what has come."""
        self._capacity = _Capacity()
        self._failure: WearcapError | None = None
        self._sources_done = threading.Event()

    # --- running ----------------------------------------------------------------------------------------------------

    def run(self, seconds: float = float("inf")) -> dict[str, Any]:
        """Capture, and return the report. Raises WearcapError when a source or sink cannot be opened."""
        self._warm_up()
        gc.collect()
        gc.freeze()  # what is loaded stays: a full collection of it takes a tenth of a second
        opened: list[SinkThread] = []
        try:
            for sink in self.sinks:
                sink.start()
                opened.append(sink)
            if self._record_from_start is not None:
                self._start_recording(self._record_from_start)
            loop = asyncio.new_event_loop()
            thread = threading.Thread(target=self._run_sources, args=(loop,), name="sources", daemon=True)
            self._began_s = time.monotonic()
            thread.start()
            with suppress(KeyboardInterrupt):  # the user's way to end a capture: what has come is kept, and reported
                self._loop(seconds)
            with suppress(RuntimeError):  # the sources have ended by themselves
                loop.call_soon_threadsafe(lambda: [task.cancel() for task in asyncio.all_tasks(loop)])
            thread.join(5.0)
        finally:
            for wearer in self.wearers.values():
                self._send(wearer, wearer.leave())
            self.record(False)
            self._fulfil()
            for sink in opened:
                sink.close()
            for closing in self._closing:
                closing.join()
            gc.unfreeze()
        if self._failure is not None:
            raise self._failure
        return self.report()

    def _warm_up(self) -> None:
        """Load and run the network once, on a wearer who stands still, so that the first poses are not late."""
        getattr(self.system, "prepare", lambda: None)()
        devices, skeleton, pose = self.opener.devices, xsens23(), Rigid(torch.eye(3), torch.tensor([0.0, 0.0, 1.6]))
        session = self.opener.session(Wearer(skeleton, floor_m=0.0))  # which says now what it lacks
        if HEAD not in devices:
            return
        for k in range(int(WARM_UP_S * session.fps)):
            at_s, samples = k / session.fps, []
            for joint in devices[1:]:
                watch = WatchSample(at_s, torch.eye(3), torch.zeros(3), joint)
                samples.append(WristSample(joint, at_s, pose) if self.opener.tracks_wrists else watch)
            session.push([[*samples, HeadSample(at_s, pose)]])
            session.poses()

    def add_sink(self, sink: Sink) -> None:
        """Add a sink before the capture runs: one that needs the capture itself, as the page does."""
        self.sinks.append(SinkThread(sink))

    def _loop(self, seconds: float) -> None:
        while not self._stopping.is_set() and time.monotonic() - self._began_s < seconds:
            done = self._sources_done.is_set()
            self._step()
            if done and not self.inbox.waiting:
                return

    def _step(self) -> None:
        """One turn: wishes, packets, poses."""
        self._fulfil()
        packets = self.inbox.wait(WAIT_S)
        self._catch_up()
        self._share(packets)
        for packet in packets:
            wearer = self.wearers.get(packet.wearer) or self._welcome(packet.wearer)
            if wearer is None:
                self.inbox.refuse("capture", f"more than {MAX_WEARERS} wearers")
                continue
            if wearer.session is None and self._live >= self._capacity.most:
                self.inbox.refuse("capture", "a wearer more than this machine captures")
                continue
            before = wearer.stage
            wearer.take(packet)
            if before != "live" and wearer.stage == "live":
                self._begin(wearer)
        now_s = time.monotonic()
        for wearer in self.wearers.values():
            live = wearer.stage == "live"
            self._send(wearer, wearer.poses(now_s))
            self._say_left(wearer, live)

    @property
    def _lossless(self) -> bool:
        return any(source.lossless for source in self.sources)

    @property
    def _live(self) -> int:
        return sum(wearer.session is not None for wearer in self.wearers.values())

    def _share(self, packets: Sequence[Packet]) -> None:
        """Let go the wearer who came last where there are too many: who came first keeps the rate. A replay loses nobody."""
        if self._capacity.is_exceeded(packets, self._live) and not self._lossless:
            last = [wearer for wearer in self.wearers.values() if wearer.session is not None][-1]
            last.note("This machine is too slow for so many wearers: who came first is captured.")
            self._send(last, last.leave())
            self._each_sink(lambda sink: sink.end(last.name))

    def _catch_up(self) -> None:
        """Begin all sessions anew where the last look is `CATCH_UP_S` ago; not of a replay, which must lose nothing."""
        now_s, before_s = time.monotonic(), self._looked_s
        self._looked_s = now_s
        if now_s - before_s < CATCH_UP_S or self._lossless:
            return
        for wearer in self.wearers.values():
            live = wearer.stage == "live"
            self._send(wearer, wearer.catch_up(now_s))
            self._say_left(wearer, live)

    def _say_left(self, wearer: LiveWearer, was_live: bool) -> None:
        """Tell the sinks that a wearer has left, if so."""
        if was_live and wearer.stage == "away":
            self._each_sink(lambda sink: sink.end(wearer.name))

    def _welcome(self, name: str) -> LiveWearer | None:
        """A new wearer, in the place of one who has been silent where there are too many; None where there is none."""
        if len(self.wearers) >= MAX_WEARERS:
            silent = max(self.wearers.values(), key=lambda one: one.silent_s)
            if silent.session is not None or silent.silent_s < FORGOTTEN_S:
                return None
            del self.wearers[silent.name]
        setup, path = self._setup, self._setup_path(name)
        wearer = self.wearers[name] = LiveWearer(name, self.opener, setup)
        if name and path is not None and path.is_file():
            with self._noted(wearer):
                wearer.setup = read_setup(path)
        if self._height_m is not None and wearer.setup is not None:
            wearer.setup = wearer.setup.with_height(self._height_m)
        if self._guided:
            wearer.guide()
        return wearer

    def _setup_path(self, wearer: str) -> Path | None:
        """Where a wearer's set-up is kept."""
        path = self._setup_file
        return path.with_stem(f"{path.stem}_{plain_name(wearer)}") if path is not None and wearer else path

    def _begin(self, wearer: LiveWearer) -> None:
        assert wearer.skeleton is not None
        for sink in self._all_sinks():
            sink.begin(wearer.name, wearer.skeleton, wearer.fps)
        path = self._setup_path(wearer.name)
        if path is not None and wearer.setup is not None and wearer.first is not None:
            with self._noted(wearer):
                write_setup(wearer.setup, path)

    @contextmanager
    def _noted(self, *wearers: LiveWearer) -> Iterator[None]:
        """What cannot be read or written is noted, and ends no capture."""
        try:
            yield
        except WearcapError as error:
            for wearer in wearers:
                wearer.note(str(error))

    def _send(self, wearer: LiveWearer, motions: list[Motion]) -> None:
        for motion in motions:
            self._each_sink(lambda sink, motion=motion: sink.take(wearer.name, motion))

    def _all_sinks(self) -> list[SinkThread]:
        return [*self.sinks, *([] if self._recorded is None else [self._recorded])]

    def _each_sink(self, call: Callable[[SinkThread], None]) -> None:
        for sink in self._all_sinks():
            call(sink)

    def _run_sources(self, loop: asyncio.AbstractEventLoop) -> None:
        asyncio.set_event_loop(loop)

        async def keep(source: Source) -> None:
            while True:
                try:
                    return await source.run(self.inbox)
                except Exception as error:  # a source must never end the others
                    if not source.listens:  # it never ran: the user should know
                        self._failure = _failure_of(source, error)
                        self._stopping.set()
                        return None
                    self.inbox.refuse(source.name, f"failed ({type(error).__name__}), and is started again")
                await asyncio.sleep(RESTART_S)

        async def every() -> None:
            await asyncio.gather(*(keep(source) for source in self.sources))

        try:
            loop.run_until_complete(every())
        except asyncio.CancelledError:
            pass
        finally:
            self._sources_done.set()
            self.inbox.wake()
            loop.close()

    # --- what a page may ask (`status.LiveControls`) ----------------------------------------------------------------

    def status(self) -> LiveStatus:
        sinks = tuple(
            SinkStatus(each.sink.name, each.sink.sent, each.dropped, each.failed, each.last_error)
            for each in self._all_sinks()
        )
        wearers = tuple(wearer.status() for wearer in list(self.wearers.values()))
        recording = None if self._recording is None else str(self._recording)
        return LiveStatus(wearers, sinks, recording, time.monotonic() - self._began_s)

    def record(self, on: bool) -> None:
        """Start or stop recording."""
        self._wish(lambda: self._start_recording(None) if on else self._stop_recording())

    def guide(self, wearer: str) -> None:
        """Begin the guided first minute of a wearer, anew where there was one."""
        self._wish(lambda: self._guide(wearer))

    def skip(self, wearer: str) -> None:
        """Go on to the next step of the first minute, with defaults for this one."""
        self._first(wearer, "skip")

    def redo(self, wearer: str) -> None:
        """Begin the step of the first minute again."""
        self._first(wearer, "redo")

    def stop(self) -> None:
        """End the capture."""
        self._stopping.set()
        self.inbox.wake()

    def _first(self, wearer: str, action: str) -> None:
        def fulfil() -> None:
            first = self.wearers[wearer].first if wearer in self.wearers else None
            if first is not None:
                getattr(first, action)()

        self._wish(fulfil)

    def _guide(self, name: str) -> None:
        wearer = self.wearers.get(name)
        if wearer is not None:
            self._send(wearer, wearer.leave())
            self._each_sink(lambda sink: sink.end(name))
            wearer.guide()

    def _wish(self, wish: Callable[[], None]) -> None:
        self._wishes.append(wish)
        self.inbox.wake()

    def _fulfil(self) -> None:
        while self._wishes:
            with self._noted(*self.wearers.values()):
                self._wishes.pop(0)()

    # --- recording --------------------------------------------------------------------------------------------------

    def _start_recording(self, folder: Path | None) -> None:
        if self._recorder is None or self._recorded is not None:
            return
        folder = folder or self._recordings / f"recording_{datetime.now():%Y-%m-%d_%H-%M-%S}"
        sink = SinkThread(self._recorder(folder), capacity=100_000)
        sink.start()
        self._recorders.append(sink)
        self._recorded, self._recording = sink, folder
        for wearer in self.wearers.values():
            if wearer.stage == "live" and wearer.skeleton is not None:
                sink.begin(wearer.name, wearer.skeleton, wearer.fps)

    def _stop_recording(self) -> None:
        """Close the files in a thread of its own: joining a long recording takes seconds."""
        if self._recorded is not None:
            closing = threading.Thread(target=self._recorded.close, args=(JOIN_S,), name="closing a recording")
            closing.start()
            self._closing.append(closing)
        self._recorded = self._recording = None

    # --- report -----------------------------------------------------------------------------------------------------

    def report(self) -> dict[str, Any]:
        """Latencies, rates and counts as plain data."""
        status = self.status()
        wearers, unnamed = {}, "wearer" if "wearer" not in self.wearers else "unnamed wearer"
        for each in status.wearers:
            live = self.wearers[each.name]
            wearers[each.name or unnamed] = {
                "frames": each.frames,
                "sessions": live.sessions,
                "latency_ms": {
                    "median": each.latency.median_ms,
                    "p95": each.latency.p95_ms,
                    "p99": each.latency.p99_ms,
                    "of_the_system": 1000 * self.latency_s,
                },
                "dropped": each.dropped,
                "late": each.late,
                "gaps": each.gaps,
                "unknown": live.unknown,
                "clock_restarts": live.clocks.restarts,
                "refused": live.refused,
                "notes": list(each.notes),
            }
        sinks = {
            each.sink.name: {
                "sent": each.sink.sent,
                "dropped": each.dropped,
                "failed": each.failed,
                "last_error": each.last_error,
            }
            for each in (*self.sinks, *self._recorders)
        }
        return {
            "seconds": round(status.seconds, 3),
            "wearers": wearers,
            "sinks": sinks,
            "refused": dict(self.inbox.refused),
            "overflowed": self.inbox.overflowed,
        }


def _failure_of(source: Source, error: Exception) -> WearcapError:
    """Why a source never ran, in words for the user."""
    if isinstance(error, WearcapError):
        return error
    return WearcapError(f"cannot start ({error})", f"source {source.name}", fix="Check its address.")


def report_text(report: dict[str, Any]) -> str:
    """A report as JSON; a quantile without poses is null."""
    return json.dumps(json.loads(json.dumps(report), parse_constant=lambda _: None), indent=1) + "\n"
