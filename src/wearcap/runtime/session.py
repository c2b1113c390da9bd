"""The interface of streaming captures: samples go in as devices send them, final poses come out."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from wearcap.errors import WearcapError
from wearcap.recording import Motion
from wearcap.runtime.snapshot import read_state, write_state


class WearerStream(ABC):
    """The streaming capture of one wearer."""

    @property
    @abstractmethod
    def dropped(self) -> int:
        """Number of head poses that were late, duplicated or refused."""

    @property
    @abstractmethod
    def refused(self) -> dict[str, int]:
        """Number of refused samples, or parts of samples, by reason ("head: not a rotation")."""

    @abstractmethod
    def take(self, sample: Any) -> None:
        """Take in one sample (`sensors.samples`)."""

    @abstractmethod
    def poses(self, ended: bool = False) -> Motion | None:
        """Frames that became final since the last call, or None; `ended`: no more samples will come."""


class Session(ABC):
    """A streaming capture of one or several wearers with one system; every wearer has their own clock.

    Implausible samples (`sensors.packets`) are refused and counted, and never affect other wearers. A session can be
    saved at any time and goes on as if nothing had happened.
    """

    classes: ClassVar[Mapping[str, type]]
    """Classes of a saved session's state."""
    stream_class: ClassVar[type]
    """Class of the streams of single wearers."""

    def __init__(self, system: Any, streams: Sequence[Any]):
        """`streams`: one for each wearer. Raises WearcapError without any."""
        if not streams:
            raise WearcapError("a session without wearers", expected="one wearer or more")
        self.system, self.streams = system, list(streams)

    @property
    def dropped(self) -> list[int]:
        """Number of each wearer's head poses that were late, duplicated or refused."""
        return [stream.dropped for stream in self.streams]

    @property
    def refused(self) -> list[dict[str, int]]:
        """Number of each wearer's refused samples, or parts of samples, by reason ("head: not a rotation")."""
        return [stream.refused for stream in self.streams]

    def push(self, samples: Sequence[Sequence[Any]]) -> None:
        """Take in each wearer's new samples (`sensors.samples`), any number of them.

        Raises WearcapError for samples of another number of wearers.
        """
        if len(samples) != len(self.streams):
            expected = f"of {len(self.streams)}, as the session has"
            raise WearcapError(f"samples of {len(samples)} wearers", expected=expected)
        for stream, part in zip(self.streams, samples):
            for sample in part:
                stream.take(sample)

    def poses(self, ended: bool = False) -> list[Motion | None]:
        """Each wearer's frames that became final since the last call; `ended`: no more samples will come.

        After a wearer's clock was set back, the frames before that come first, and the next call returns those after
        it.
        """
        return [stream.poses(ended) for stream in self.streams]

    @classmethod
    @abstractmethod
    def settings(cls, system: Any) -> dict[str, Any]:
        """The settings of a system that a session's state depends on."""

    @classmethod
    def shared(cls, system: Any) -> dict[str, Any]:
        """Parts of the system that a session's state refers to, by name."""
        return {"system": system}

    def state(self) -> dict[str, Any]:
        """Everything that future poses depend on, except the system."""
        return {"streams": self.streams}

    def save(self, path: str | Path) -> None:
        """Write the session (.safetensors)."""
        write_state(path, self.state(), self.settings(self.system), self.classes, **self.shared(self.system))

    @classmethod
    def load(cls, path: str | Path, system: Any) -> "Session":
        """Restore a saved session with the system that it ran with.

        Raises WearcapError for a file that is no session or is damaged, and for a system with other settings.
        """
        getattr(system, "prepare", lambda: None)()
        state = read_state(path, cls.settings(system), cls.classes, **cls.shared(system))
        session = object.__new__(cls)
        session.system = system
        streams = state.get("streams") if isinstance(state, dict) else None
        if (
            not isinstance(streams, list)
            or not streams
            or not all(isinstance(part, cls.stream_class) for part in streams)
        ):
            raise WearcapError("not a saved session", where=path, expected=f"one of {cls.__name__}.save")
        for name, part in state.items():
            setattr(session, name, part)
        return session
