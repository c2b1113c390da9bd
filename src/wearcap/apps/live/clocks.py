"""Clocks of live devices: from a device's own time to ours, and from one device's to another's.

A packet takes at least as long as the quickest one did: the smallest differences between arrival and the device's time show
how the two clocks stand, and how they drift, however much single packets are delayed.
"""

import statistics
from collections import deque

from wearcap.apps.live.recent import Recent

BUCKET_S = 2.0
"""Time over which the quickest packet is kept."""
BUCKETS = 60
"""Number of quickest packets from which the drift follows: two minutes."""
MAX_DRIFT = 5e-4
"""Largest drift that is believed (s/s); crystals of watches and phones are within 1e-4."""
DRIFT_AFTER_S = 20.0
"""Time after which drift is estimated; before, it is smaller than the network's jitter."""
RESTART_S = 1.0
"""Deviation from the estimate that means another clock, if `AGREEING` packets in a row have it."""
AGREEING = 5
MAX_CLOCKS = 32
"""Most clocks, and shifts, of one wearer; a sender that invents names gets no more."""
LATE_FOR_S, HELD_BACK_S = 5.0, 10.0
"""Time for which all packets must be late for that; and lateness (s) that means it at once."""


class DeviceClock:
    """One device's clock against ours, from packets as they arrive; memory is bounded."""

    def __init__(self) -> None:
        self.restarts = 0
        """How often the device's clock was set anew."""
        self._far = 0
        """Packets in a row that are off by more than `RESTART_S`."""
        self._far_since_s = 0.0
        self._begin()

    def _begin(self) -> None:
        self._quickest: deque[tuple[float, float]] = deque(maxlen=BUCKETS)
        """Device time and delay (arrival minus device time, s) of the quickest packet of each `BUCKET_S`."""
        self._drift = 0.0
        self._delay_s = 0.0
        """Smallest delay at device time `_at_s`."""
        self._at_s = 0.0

    def see(self, sent_s: float, arrived_s: float) -> bool:
        """A packet with the device's time arrived; whether it shows that the clock was set anew."""
        delay_s = arrived_s - sent_s
        if not self._quickest:
            self._quickest.append((sent_s, delay_s))
            self._delay_s, self._at_s = delay_s, sent_s
            return False
        expected_s = self._delay_at(sent_s)
        # Early packets are impossible with one clock. Late ones mean another one, too, if they are later than an application
        # would hold them back, or all of some seconds are late: of those that are sent at once the newest is not.
        off_s = delay_s - expected_s
        self._far = self._far + 1 if abs(off_s) > RESTART_S else 0
        if self._far == 1:
            self._far_since_s = arrived_s
        if self._far:
            anew = not 0 < off_s < HELD_BACK_S or arrived_s - self._far_since_s >= LATE_FOR_S
            if anew := self._far >= AGREEING and anew:
                self.restarts += 1
                self._far = 0
                self._begin()
                self.see(sent_s, arrived_s)
            return anew
        if sent_s >= self._quickest[-1][0] + BUCKET_S:
            self._quickest.append((sent_s, delay_s))
            self._estimate()
        elif delay_s < self._quickest[-1][1]:
            self._quickest[-1] = (self._quickest[-1][0], delay_s)
        if delay_s < self._delay_at(sent_s):
            self._delay_s, self._at_s = delay_s, sent_s
        return False

    def _delay_at(self, sent_s: float) -> float:
        return self._delay_s + self._drift * (sent_s - self._at_s)

    def _estimate(self) -> None:
        """Drift and smallest delay from the quickest packets that are complete: a line below all of them."""
        done = list(self._quickest)[:-1] or list(self._quickest)
        first_s, last_s = done[0][0], done[-1][0]
        if last_s - first_s >= DRIFT_AFTER_S:
            apart = len(done) // 2
            slopes = [(b[1] - a[1]) / (b[0] - a[0]) for a, b in zip(done, done[apart:])]
            self._drift = min(max(statistics.median(slopes), -MAX_DRIFT), MAX_DRIFT)
        self._at_s = last_s
        self._delay_s = min(delay_s - self._drift * (sent_s - last_s) for sent_s, delay_s in done)

    def ours(self, device_s: float) -> float:
        """Our time (s) at a time of the device, as if its packets took no time."""
        return device_s + self._delay_at(device_s)

    def theirs(self, our_s: float) -> float:
        """The device's time (s) at ours."""
        return self._at_s + (our_s - self._at_s - self._delay_s) / (1 + self._drift)


class Clocks:
    """The clocks of one wearer's devices; the head's is the one that motion is timed by."""

    def __init__(self) -> None:
        self.leader: str | None = None
        """Name of the clock that motion counts on; None: the first one seen decides."""
        self._clocks = Recent(MAX_CLOCKS, lambda _: DeviceClock(), lambda name: name == self.leader)
        self._shifts: dict[str, tuple[str, float]] = {}
        """By device, the clock that it counted on, and seconds."""

    def __contains__(self, clock: str) -> bool:
        return clock in self._clocks

    def see(self, clock: str, sent_s: float, arrived_s: float) -> list[str]:
        """A packet that counts on a clock arrived; returns the devices whose shift no longer holds.

        A shift is void once the device's clock or the leading one is set anew: its delays are then others.
        """
        known = self._clocks.admit(clock, arrived_s)
        if known is None or not known.see(sent_s, arrived_s):
            return []
        void = [device for device, (own, _) in self._shifts.items() if clock in (own, self.leader)]
        for device in void:
            del self._shifts[device]
        return void

    def shift(self, device: str, clock: str, seconds: float) -> None:
        """Add to the times of a device that counts on a clock, beyond what delays show and what was added before.

        Devices that share a clock may come by different ways: each has its own shift.
        """
        own, before_s = self._shifts.get(device, (clock, 0.0))
        if device in self._shifts or len(self._shifts) < MAX_CLOCKS:
            self._shifts[device] = clock, seconds + (before_s if own == clock else 0.0)

    def on_leader(self, clock: str, time_s: float, device: str = "") -> float:
        """A device's time of one clock on the leading one; but for its shift unchanged on the same clock, and while one of
        them is unknown."""
        own, shift_s = self._shifts.get(device, (clock, 0.0))
        time_s = time_s + shift_s if own == clock else time_s
        if clock == self.leader or self.leader not in self._clocks or clock not in self._clocks:
            return time_s
        return self._clocks[self.leader].theirs(self._clocks[clock].ours(time_s))

    @property
    def late_s(self) -> float:
        """Time (s) by which the latest device's samples come after the leading device's of the same time."""
        return max(0.0, *(-seconds for _, seconds in self._shifts.values())) if self._shifts else 0.0

    def ours(self, time_s: float) -> float:
        """Our time at a time of the leading clock."""
        clock = self._clocks.get(self.leader or "")
        return time_s if clock is None else clock.ours(time_s)

    @property
    def restarts(self) -> int:
        """How often clocks were set anew."""
        return sum(clock.restarts for clock in self._clocks.values())
