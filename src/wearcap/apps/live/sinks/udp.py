"""What sends one wearer's motion as OSC over UDP, frame by frame at its own rate."""

import socket
from abc import abstractmethod
from collections.abc import Iterable, Iterator
from contextlib import suppress
from typing import ClassVar

from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
from pythonosc.osc_message_builder import OscMessageBuilder

from wearcap.apps.live.pacing import Pacing
from wearcap.apps.live.sink import Sink
from wearcap.apps.live.source import Address, Addressed
from wearcap.body.skeleton import Skeleton
from wearcap.errors import WearcapError
from wearcap.recording import Motion

SMALL_S = 4096.0
"""Times that begin beyond this count from the first frame: the protocol's single precision does not tell frames apart there."""

Message = tuple[str | int | float, ...]
"""An OSC message: its address, and its arguments."""


class UdpSink(Sink, Addressed):
    """Sends one wearer's motion: of the one that the address names (`?wearer=NAME`), else of the first that comes."""

    joints: ClassVar[tuple[str, ...]]
    """Joints that the skeleton must have."""
    own_options: ClassVar[tuple[str, ...]] = ()
    """Options of its addresses beside `wearer`."""

    def __init__(self, address: Address, pace: bool = True):
        """Raises WearcapError for options that the sink does not have."""
        address.require_options(*self.own_options)
        self.address, self.name = address, f"{address.scheme}://{address.host}:{address.port}"
        self.wearer = address.options.get("wearer")
        self._pacing = Pacing(pace)
        self._socket: socket.socket | None = None
        self._step_s = 1 / 60
        self._origin_s: float | None = None
        """Device time (s) that times are sent from."""

    @abstractmethod
    def datagrams(self, motion: Motion, origin_s: float) -> Iterator[bytes]:
        """A datagram for each frame; times, where there are any, count from `origin_s`."""

    def open(self) -> None:
        where = f"{self.address.host}:{self.address.port}"
        try:
            family, kind, *_, target = socket.getaddrinfo(self.address.host, self.address.port, type=socket.SOCK_DGRAM)[
                0
            ]
            self._socket = socket.socket(family, kind)
        except (OSError, UnicodeError) as error:  # the latter of a host's name
            expected = f"{self.address.scheme}://HOST:PORT"
            raise WearcapError(f"cannot send to this address ({error})", where, expected) from error
        self._socket.setblocking(False)
        self._target = target

    def begin(self, wearer: str, skeleton: Skeleton, fps: float) -> None:
        if missing := next((joint for joint in self.joints if joint not in skeleton), None):
            raise WearcapError(f"a skeleton without {missing!r}", self.name, "xsens23")
        self.wearer = wearer if self.wearer is None else self.wearer
        if wearer == self.wearer:
            self._step_s, self._origin_s = 1 / fps, None

    def take(self, wearer: str, motion: Motion) -> None:
        if wearer != self.wearer:
            return
        if self._origin_s is None:
            first_s = motion.timestamps[0].item()
            self._origin_s = 0.0 if abs(first_s) < SMALL_S else first_s
        for data in self.datagrams(motion, self._origin_s):
            self._pacing.wait(self._step_s, self.waiting > 1)
            self._send(data)

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()

    def _send(self, data: bytes) -> None:
        assert self._socket is not None
        with suppress(BlockingIOError, ConnectionRefusedError):  # nobody listens yet, or the machine is busy
            self._socket.sendto(data, self._target)
            self.sent += 1


def osc_bundle(messages: Iterable[Message]) -> bytes:
    """Messages as one OSC bundle, to be applied at once."""
    built = OscBundleBuilder(IMMEDIATELY)  # pyright: ignore[reportArgumentType]
    for address, *values in messages:
        message = OscMessageBuilder(str(address))
        for value in values:
            message.add_arg(value, {str: "s", int: "i", float: "f"}[type(value)])
        built.add_content(message.build())
    return built.build().dgram
