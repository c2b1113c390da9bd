"""Clock of the viewer's page: plays, stops, jumps, loops."""

from dataclasses import dataclass

SPEEDS = ("0.1×", "0.25×", "0.5×", "1×", "2×", "4×")


@dataclass
class Timeline:
    """A time that runs between start and stop (s) when playing, at `speed` times real time."""

    start: float
    stop: float
    time: float
    playing: bool = False
    speed: float = 1.0

    def advance(self, elapsed_s: float) -> bool:
        """Advance by wall time; returns whether the shown time changed. It loops at the end."""
        if not self.playing or self.stop <= self.start:
            return False
        self.time += elapsed_s * self.speed
        if self.time > self.stop:
            self.time = self.start
        return True

    def seek(self, time: float) -> None:
        self.time = min(max(time, self.start), self.stop)

    def step(self, seconds: float) -> None:
        self.seek(self.time + seconds)
