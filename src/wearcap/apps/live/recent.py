"""What is kept by names that come from the network: so many at a time, of which a silent one makes room for another."""

from collections.abc import Callable
from typing import TypeVar

Entry = TypeVar("Entry")
FORGOTTEN_S = 60.0
"""Time without news after which a name makes room for another."""


class Recent(dict[str, Entry]):
    """Entries by name; `make` makes that of a new one."""

    def __init__(self, most: int, make: Callable[[str], Entry], kept: Callable[[str], bool] = lambda name: False):
        """`most`: names at a time; those that are `kept` are always admitted, and make no room."""
        super().__init__()
        self.most, self.make, self.kept = most, make, kept
        self._heard_s: dict[str, float] = {}

    def admit(self, name: str, now_s: float) -> Entry | None:
        """The entry of a name that is heard of at a time (s); None where there are too many."""
        if name not in self:
            if len(self) >= self.most and not self.kept(name):
                others = (each for each in self if not self.kept(each))
                oldest = min(others, key=self._heard_s.__getitem__, default=None)
                if oldest is None or now_s - self._heard_s[oldest] < FORGOTTEN_S:
                    return None
                del self[oldest], self._heard_s[oldest]
            self[name] = self.make(name)
        self._heard_s[name] = now_s
        return self[name]
