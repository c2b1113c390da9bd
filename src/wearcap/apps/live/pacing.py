"""Frames that became final together, sent or shown one after the other at their own rate."""

import threading
import time
from collections import deque

from wearcap.recording import Motion

HURRY, RECOVERY = 0.8, 0.9
"""Share of a frame's time between frames: while more of them wait than came at once, and otherwise, so that one piece that
came late does not make all later ones late."""
MAX_PIECES = 200
"""Most pieces that wait; the oldest are dropped."""
MARGIN_S = 0.05
"""Delay (s) beyond that of whole pieces, for pieces that come unevenly."""
MAX_TARGET_S = 1.0
BEHIND_S = 0.5
"""Time (s) beyond the usual delay after which what was not shown is dropped."""
SLOWEST, FASTEST = 0.8, 1.25
"""Speeds, in real time, at which the delay is brought back to the usual one."""
PAST_S = 0.5
"""Time (s) of motion that is kept behind the one shown."""


class Pacing:
    """When frames of one wearer are due; `pace` false: at once, as for a replay as fast as it goes."""

    def __init__(self, pace: bool):
        self.pace = pace
        self._due_s = 0.0

    def due(self, step_s: float, waiting: bool) -> float:
        """Our time (s, `time.monotonic`) at which the next frame is due, some `step_s` after the last one; `waiting`: further
        pieces have come already."""
        now_s = time.monotonic()
        if not self.pace:
            return now_s
        self._due_s = max(now_s, self._due_s + step_s * (HURRY if waiting else RECOVERY))
        return self._due_s

    def wait(self, step_s: float, waiting: bool) -> None:
        """Return when the next frame is due."""
        if (left_s := self.due(step_s, waiting) - time.monotonic()) > 0:
            time.sleep(left_s)

    def behind(self, frames: int, step_s: float) -> bool:
        """Whether more frames are still to be sent than so many, which come at once."""
        return self._due_s - time.monotonic() > frames * step_s


class Playout:
    """The frames of one wearer on their way to a screen.

    They come in pieces of several frames, from any thread, and are shown evenly, later by about three quarters of a piece.
    """

    def __init__(self):
        self._pieces: deque[Motion] = deque(maxlen=MAX_PIECES)
        self._spans: deque[float] = deque(maxlen=5)
        self._shown_s: float | None = None
        self._last_s = 0.0
        self._lock = threading.Lock()

    def put(self, motion: Motion) -> None:
        """Take the next frames; those of a clock that was set anew begin anew."""
        if not len(motion):
            return
        with self._lock:
            newest = self._newest_s
            if newest is not None and not 0 < motion.timestamps[-1].item() - newest < 10.0:
                self._clear()
            elif newest is not None:
                self._spans.append(motion.timestamps[-1].item() - newest)
            self._pieces.append(motion)

    def clear(self) -> None:
        """Forget all frames."""
        with self._lock:
            self._clear()

    def step(self, now_s: float) -> tuple[Motion, float] | None:
        """The piece to show at a time (s) of the screen, and the time in it; None without any."""
        with self._lock:
            newest = self._newest_s
            if newest is None:
                return None
            target = min(0.75 * max(self._spans, default=0.0) + MARGIN_S, MAX_TARGET_S)
            if self._shown_s is None:
                self._shown_s = newest - target
            else:
                speed = 1 + 0.5 * (newest - self._shown_s - target)
                self._shown_s += max(now_s - self._last_s, 0.0) * min(max(speed, SLOWEST), FASTEST)
            if newest - self._shown_s > target + BEHIND_S:
                self._shown_s = newest - target
            self._shown_s = min(max(self._shown_s, self._pieces[0].timestamps[0].item()), newest)
            self._last_s = now_s
            while len(self._pieces) > 1 and self._pieces[0].timestamps[-1].item() < self._shown_s - PAST_S:
                self._pieces.popleft()
            shown_s = self._shown_s
            for piece in self._pieces:
                if piece.timestamps[-1].item() >= shown_s:
                    return piece, shown_s
            return self._pieces[-1], shown_s

    @property
    def behind_s(self) -> float:
        """Time (s) by which the screen is behind the newest frame."""
        with self._lock:
            newest = self._newest_s
            return 0.0 if newest is None or self._shown_s is None else newest - self._shown_s

    @property
    def _newest_s(self) -> float | None:
        return self._pieces[-1].timestamps[-1].item() if self._pieces else None

    def _clear(self) -> None:
        self._pieces.clear()
        self._spans.clear()
        self._shown_s = None
