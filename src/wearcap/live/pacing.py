"""Frames that became final together, sent one after the other at their own rate."""

import time
from collections.abc import Callable

HURRY = 0.9
"""Share of a frame's time between frames while more of them wait than came at once."""


class Pacing:
    """Waits between frames; `pace` false: does not, as for a replay as fast as it goes."""

    def __init__(self, pace: bool, sleep: Callable[[float], None] = time.sleep):
        self.pace, self._sleep = pace, sleep
        self._due_s = 0.0

    def wait(self, step_s: float, waiting: bool) -> None:
        """Return when the next frame is due, `step_s` after the last one; `waiting`: further pieces have come already."""
        if not self.pace:
            return
        now_s = time.monotonic()
        self._due_s = max(now_s, self._due_s + step_s * (HURRY if waiting else 1.0))
        if self._due_s > now_s:
            self._sleep(self._due_s - now_s)
