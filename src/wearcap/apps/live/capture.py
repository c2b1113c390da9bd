"""A live capture: sources deliver packets, every wearer's session makes poses of them, sinks take them."""

import asyncio
import gc
import json
import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import Any

import torch

from wearcap.apps.live.files_sink import FilesSink
from wearcap.apps.live.packets import HEAD, Inbox, Packet
from wearcap.apps.live.recent import Recent
from wearcap.apps.live.setup import Known, Setup, hand_seat, write_setup
from wearcap.apps.live.setup_estimation import SetupEstimation
from wearcap.apps.live.sink import Sink, SinkThread
from wearcap.apps.live.source import Source
from wearcap.apps.live.status import Ask, LiveStatus
from wearcap.apps.live.wearer import LiveWearer, Opener
from wearcap.apps.web.loop import LoopThread
from wearcap.body.skeleton import Skeleton, xsens23
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.recording import Motion, Recording
from wearcap.runtime.system import CaptureInput, System
from wearcap.runtime.wearer import Wearer
from wearcap.sensors.samples import HeadSample, WatchSample, WristSample

MAX_WEARERS = 8
"""Most wearers; packets of further ones are counted as refused."""
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
        known: Known | None = None,
        source: CaptureInput | None = None,
        seed: int = 0,
        record: Path | None = None,
        recordings: Path = Path(),
    ):
        """`source`: recording, scan and objects of the place, for systems that use them; `record`: folder in which to
        record from the start; `recordings`: that in which to record when the page asks for it.

        Raises WearcapError for a system that does not stream.
        """
        self.system, self.sources, self.known = system, list(sources), known or Known()
        self.latency_s = system.latency_s
        kind = system.session_class()
        if kind.takes_objects and source is None:
            source = CaptureInput(Recording("live"))  # the system itself may name a file of objects
        environment = system.objects(source) if kind.takes_objects and source is not None else None
        self.objects = () if environment is None else environment.objects
        """Those of the place, where the system takes objects."""
        self.opener = Opener(
            lambda wearer: kind.of_wearers(system, [wearer], seed, source),
            kind.devices,
            kind.tracks_wrists,
            kind.takes_objects,
            self._estimation,
            any(source.patient for source in self.sources),
            {joint: hand_seat(joint, self._seen_hands) for joint in kind.optional},
        )
        self.inbox = Inbox()
        self.wearers = Recent(MAX_WEARERS, self._new_wearer, self._is_captured)
        self.sinks = [SinkThread(sink) for sink in sinks]
        self._begun: dict[str, Skeleton] = {}
        """Skeletons of the wearers whose motion the sinks take."""
        self._record, self._recordings, self._recording = record, recordings, None
        self._recorders: list[SinkThread] = []
        """All recorders of this capture; while `_recording` names a folder the last of them records in it."""
        self._wishes: list[Callable[[], None]] = []
        self._stopping = threading.Event()
        self._began_s = time.monotonic()
        self._looked_s = math.inf
        """Our time (s) of the last look at what has come."""
        self._capacity = _Capacity()
        self._failure: WearcapError | None = None

    def _estimation(self, before: Setup | None, guided: bool) -> SetupEstimation:
        known, opener = self.known, self.opener
        return SetupEstimation(
            opener.devices,
            tracked=opener.tracks_wrists,
            hands=known.hands,
            height_m=known.height_m,
            setup=before,
            guided=guided or known.guided,
        )

    @property
    def _seen_hands(self) -> str:
        """What hands that are seen now and then are, which no first minute looks at: wrist joints, unless it is stated."""
        return "joint" if self.known.hands == "auto" else self.known.hands

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
            if self._record is not None:
                self._start_recording(self._record)
            thread = LoopThread("sources")
            running = thread.start(self._run_sources())
            running.add_done_callback(lambda _: self.inbox.wake())
            self._began_s = time.monotonic()
            with suppress(KeyboardInterrupt):  # the user's way to end a capture: what has come is kept, and reported
                while not self._stopping.is_set() and time.monotonic() - self._began_s < seconds:
                    done = running.done()
                    self._step()
                    if done and not self.inbox.waiting:
                        break
            thread.stop()
        finally:
            for wearer in self.wearers.values():
                self._send(wearer, wearer.leave())
            self.record(False)
            self._fulfil()
            for sink in opened:
                sink.close()
            for recorder in self._recorders:
                recorder.close(JOIN_S)
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

    def _step(self) -> None:
        """One turn: wishes, packets, poses."""
        self._fulfil()
        packets = self.inbox.wait(WAIT_S)
        self._catch_up()
        self._share(packets)
        for packet in packets:
            wearer = self.wearers.admit(packet.wearer, time.monotonic())
            if wearer is None:
                self.inbox.refuse("capture", f"more than {MAX_WEARERS} wearers")
            elif wearer.session is None and self._live >= self._capacity.most:
                self.inbox.refuse("capture", "a wearer more than this machine captures")
            else:
                wearer.take(packet)
                if wearer.session is not None and self._begun.get(wearer.name) is not wearer.skeleton:
                    self._begin(wearer)
        now_s = time.monotonic()
        for wearer in self.wearers.values():
            self._send(wearer, wearer.poses(now_s))

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

    def _catch_up(self) -> None:
        """Begin all sessions anew where the last look is `CATCH_UP_S` ago; not of a replay, which must lose nothing."""
        now_s, before_s = time.monotonic(), self._looked_s
        self._looked_s = now_s
        if now_s - before_s >= CATCH_UP_S and not self._lossless:
            for wearer in self.wearers.values():
                self._send(wearer, wearer.catch_up(now_s))

    def _is_captured(self, name: str) -> bool:
        return name in self.wearers and self.wearers[name].session is not None

    def _new_wearer(self, name: str) -> LiveWearer:
        wearer = LiveWearer(name, self.opener)
        with self._noted(wearer):
            wearer.setup = self.known.of(name)
        if self.known.guided:
            wearer.guide()
        return wearer

    @contextmanager
    def _noted(self, *wearers: LiveWearer) -> Iterator[None]:
        """What cannot be read or written is noted, and ends no capture."""
        try:
            yield
        except WearcapError as error:
            for wearer in wearers:
                wearer.note(str(error))

    def _begin(self, wearer: LiveWearer) -> None:
        """A wearer's motion begins; what the first minute found is kept."""
        assert wearer.skeleton is not None
        self._begun[wearer.name] = wearer.skeleton
        for sink in self._all_sinks():
            sink.begin(wearer.name, wearer.skeleton, wearer.fps)
        path = self.known.file_of(wearer.name)
        if path is not None and wearer.setup is not None and wearer.first is not None:
            with self._noted(wearer):
                write_setup(wearer.setup, path)

    def _send(self, wearer: LiveWearer, motions: list[Motion]) -> None:
        """Give the sinks a wearer's poses, and say so if these were the last."""
        left = wearer.session is None and wearer.name in self._begun
        for sink in self._all_sinks():
            for motion in motions:
                sink.take(wearer.name, motion)
            if left:
                sink.end(wearer.name)
        if left:
            del self._begun[wearer.name]

    def _all_sinks(self) -> list[SinkThread]:
        return [*self.sinks, *(self._recorders[-1:] if self._recording is not None else ())]

    async def _run_sources(self) -> None:
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

        await asyncio.gather(*(keep(source) for source in self.sources))

    # --- what a page may ask (`status.LiveControls`) ----------------------------------------------------------------

    def status(self) -> LiveStatus:
        wearers = tuple(wearer.status() for wearer in list(self.wearers.values()))
        recording = None if self._recording is None else str(self._recording)
        sinks = tuple(sink.status() for sink in self._all_sinks())
        return LiveStatus(wearers, sinks, recording, time.monotonic() - self._began_s)

    def record(self, on: bool) -> None:
        """Start or stop recording."""
        self._wish(lambda: self._start_recording(None) if on else self._stop_recording())

    def ask(self, action: Ask, wearer: str) -> None:
        """Do something about a wearer's first minute."""

        def fulfil() -> None:
            known = self.wearers.get(wearer)
            if known is not None and action == "guide":
                self._send(known, known.leave())
                known.guide()
            elif known is not None and known.first is not None:
                getattr(known.first, action)()

        self._wish(fulfil)

    def stop(self) -> None:
        """End the capture."""
        self._stopping.set()
        self.inbox.wake()

    def _wish(self, wish: Callable[[], None]) -> None:
        self._wishes.append(wish)
        self.inbox.wake()

    def _fulfil(self) -> None:
        while self._wishes:
            with self._noted(*self.wearers.values()):
                self._wishes.pop(0)()

    def _start_recording(self, folder: Path | None) -> None:
        if self._recording is not None:
            return
        folder = folder or self._recordings / f"recording_{datetime.now():%Y-%m-%d_%H-%M-%S}"
        sink = SinkThread(FilesSink(folder), capacity=100_000)
        sink.start()
        self._recorders.append(sink)
        self._recording = folder
        for wearer in self.wearers.values():
            if wearer.name in self._begun and wearer.skeleton is not None:
                sink.begin(wearer.name, wearer.skeleton, wearer.fps)

    def _stop_recording(self) -> None:
        """The recorder joins its files by itself, which takes seconds of a long recording."""
        if self._recording is not None:
            self._recorders[-1].finish()
        self._recording = None

    def report(self) -> dict[str, Any]:
        """Latencies, rates and counts as plain data."""
        status, system_ms = self.status(), 1000 * self.latency_s
        wearers, unnamed = {}, "wearer" if "wearer" not in self.wearers else "unnamed wearer"
        for each in status.wearers:
            about = asdict(each.counts) | {"notes": list(each.notes)}
            wearers[each.name or unnamed] = about | {
                "latency_ms": each.latency._asdict() | {"of_the_system": system_ms}
            }
        sinks = {}
        for each in (*self.sinks, *self._recorders):
            about = asdict(each.status())
            sinks[about.pop("name")] = about
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
