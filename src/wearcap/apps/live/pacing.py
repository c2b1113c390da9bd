"""Frames that became final together, sent one after the other at their own rate."""

import time

HURRY, RECOVERY = 0.8, 0.9
"""Share of a frame's time between frames: while more of them wait than came at once, and otherwise, so that one piece that
came late does not make all later ones late."""


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
