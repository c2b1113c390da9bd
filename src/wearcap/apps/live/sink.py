"""What a sink of live motion is, and the thread that keeps a slow or broken one from delaying the others."""

import threading
from collections import deque
from collections.abc import Callable
from typing import ClassVar

from wearcap.apps.live.status import SinkStatus
from wearcap.body.skeleton import Skeleton
from wearcap.recording import Motion

MAX_PIECES = 300
"""Pieces of motion that may wait for a sink: some seconds to minutes, by the system's stride."""


class Sink:
    """Somewhere that motion goes. All methods are called from one thread of the sink's own."""

    name: str
    """Name in messages and counters."""
    waiting: int = 0
    """Pieces that wait for the sink, kept by its thread."""
    sent: int = 0
    """Number of frames that have gone where the sink sends them; each sink counts its own."""
    convention: str
    """Axes and units of what is sent, as text for people."""
    serves: ClassVar[bool] = False
    """Whether others connect to it, at an address of this machine."""
    open_to_others: bool = False
    """Whether other machines can."""

    def open(self) -> None:
        """Get ready. Raises WearcapError when that is impossible."""

    def begin(self, wearer: str, skeleton: Skeleton, fps: float) -> None:
        """A wearer's motion begins, or begins anew, with a skeleton."""

    def take(self, wearer: str, motion: Motion) -> None:
        """The next frames of a wearer; a sink may leave wearers out."""
        raise NotImplementedError

    def end(self, wearer: str) -> None:
        """A wearer has left."""

    def close(self) -> None:
        """No more motion comes."""


class SinkThread:
    """Runs one sink. When it is slow the oldest pieces are dropped; when it raises, the piece is lost and counted."""

    def __init__(self, sink: Sink, capacity: int = MAX_PIECES):
        self.sink, self.capacity = sink, capacity
        self.dropped = 0
        """Number of pieces dropped because the sink was slow."""
        self.failed = 0
        """Number of pieces that the sink could not take."""
        self.last_error = ""
        self._calls: deque[tuple[bool, Callable[[], None]]] = deque()
        self._ready = threading.Condition()
        self._closing = False
        self._thread = threading.Thread(target=self._run, name=f"sink {sink.name}", daemon=True)

    def start(self) -> None:
        """Open the sink and start its thread. Raises WearcapError when it cannot be opened."""
        self.sink.open()
        self._thread.start()

    def begin(self, wearer: str, skeleton: Skeleton, fps: float) -> None:
        self._put(False, lambda: self.sink.begin(wearer, skeleton, fps))

    def take(self, wearer: str, motion: Motion) -> None:
        self._put(True, lambda: self.sink.take(wearer, motion))

    def end(self, wearer: str) -> None:
        self._put(False, lambda: self.sink.end(wearer))

    def finish(self) -> None:
        """Let the sink take what waits for it, and close it, in its own time."""
        with self._ready:
            self._closing = True
            self._ready.notify()

    def close(self, seconds: float = 10.0) -> None:
        """Let the sink take what waits for it, for at most so many seconds, and close it; the rest counts as dropped."""
        self.finish()
        self._thread.join(seconds)
        with self._ready:
            self.dropped += sum(droppable for droppable, _ in self._calls)
            self._calls.clear()

    def status(self) -> SinkStatus:
        """What page and report show."""
        return SinkStatus(self.sink.name, self.sink.sent, self.dropped, self.failed, self.last_error)

    def _put(self, droppable: bool, call: Callable[[], None]) -> None:
        with self._ready:
            if len(self._calls) >= self.capacity:
                oldest = next((i for i, (may_drop, _) in enumerate(self._calls) if may_drop), None)
                del self._calls[oldest or 0]  # beginnings and ends alone wait when many come and leave
                self.dropped += oldest is not None
            self._calls.append((droppable, call))
            self._ready.notify()

    def _run(self) -> None:
        while True:
            with self._ready:
                while not (self._calls or self._closing):
                    self._ready.wait()
                call = self._calls.popleft()[1] if self._calls else None
                self.sink.waiting = len(self._calls)
            if call is None:
                break
            self._try(call)
        self._try(self.sink.close)

    def _try(self, call: Callable[[], None]) -> None:
        try:
            call()
        except Exception as error:  # a sink must never stop the capture: its failure is counted and shown
            self.failed += 1
            self.last_error = str(error)[:200]
