"""The interface of streaming captures: packets go in as devices send them, final poses come out."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from wearcap.recording import Motion


class Session(ABC):
    """A streaming capture of one or several wearers of one system; every wearer has their own clock.

    Implausible packets (`sensors.packets`) are refused and counted, and never affect other wearers.
    """

    @property
    @abstractmethod
    def refused(self) -> list[dict[str, int]]:
        """Number of each wearer's refused packets, or parts of packets, by reason ("head: not a rotation")."""

    @abstractmethod
    def push(self, packets: Sequence[Sequence[Any]]) -> None:
        """Take in each wearer's new packets, any number of them.

        Raises WearcapError for packets of another number of wearers.
        """

    @abstractmethod
    def poses(self, ended: bool = False) -> list[Motion | None]:
        """Each wearer's frames that became final since the last call; `ended`: no more packets will come.

        After a wearer's clock was set back, the frames before the reset come first, and those after it with the next
        call.
        """

    @abstractmethod
    def save(self, path: str | Path) -> None:
        """Write everything that future poses depend on, except the system (.safetensors)."""

    @classmethod
    @abstractmethod
    def load(cls, path: str | Path, system: Any) -> "Session":
        """Restore a saved session with the system that it ran with.

        Raises WearcapError for a file that is no session or is damaged, and for a system with other settings.
        """
