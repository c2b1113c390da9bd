"""Watches and phones: SensorLog (CSV or JSON) and Sensor Logger (JSON), over UDP, and over HTTP.

Both report Core Motion's or Android's attitude, gravity, and acceleration without it. Unit, sign and the attitude's
direction are found in the first second of a device's samples, as `io.devices.watch_log` finds them in a file.
Sensor Logger sends a phone's sensors as entries of their own, which are paired by time; a watch's come together.
"""

import asyncio
import math
import threading
from collections import deque
from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import Any, NamedTuple

import numpy as np
import torch

from wearcap.apps.live.packets import Inbox, Packet
from wearcap.apps.live.source import Address, DatagramSource, Fault, counted, require
from wearcap.apps.live.sources.parts import Names, device_of, matrix_of
from wearcap.apps.web.connections import DELIVERING, SPOKEN
from wearcap.apps.web.guard import Guard
from wearcap.apps.web.http_server import Answer, Handler, HttpServer
from wearcap.body.skeleton import WRISTS
from wearcap.boundary.texts import parse_json
from wearcap.errors import WearcapError, require_choice
from wearcap.io.devices.watch_log import G_M_S2, WatchConvention, logging_time, watch_convention
from wearcap.sensors.packets import MAX_ACC_M_S2, NOT_FINITE, OUT_OF_RANGE, time_fault, values_fault
from wearcap.sensors.samples import WatchSample

MAX_ENTRIES = 4096
"""Samples or sensors' entries of one message."""
MAX_COLUMNS, MAX_BODY = 256, 1 << 20
FIRST_S, FIRST_ROWS, MAX_ROWS = 1.0, 10, 512
"""Length of what a convention is found in (s), and its least and largest number of samples."""
PAIR_S = 0.02
"""Largest distance in time between entries of one sample."""
LATE_S = 0.2
"""An entry waits so long for those of other sensors."""
OTHER_UNIT, CHANGED_ROWS = 4.0, 100
"""Gravity that is longer or shorter by this factor, in so many samples in a row, shows that the unit has changed. What
SensorLog's two accelerations leave of gravity may be wrong by a part of this in a fast movement."""
_XYZ, _WXYZ = ("X", "Y", "Z"), ("W", "X", "Y", "Z")

NO_SAMPLE = "no sample of a watch"
NO_HEADER = "no header line yet"
NO_CONVENTION = "gravity and attitude do not agree"
UNPAIRED = "sensors without the others"


class _Row(NamedTuple):
    """One sample as the device gives it."""

    time_s: float
    quat_wxyz: tuple[float, ...]
    gravity: tuple[float, ...]
    free: tuple[float, ...]


@dataclass
class _Entries:
    """Entries of a phone's sensors that are not in a sample yet."""

    sensors: dict[str, deque[tuple[float, tuple[float, ...]]]] = field(default_factory=dict)
    waiting: deque[tuple[float, tuple[float, ...]]] = field(default_factory=lambda: deque(maxlen=64))
    """Accelerations without gravity."""

    def add(self, sensor: str, time_s: float, values: tuple[float, ...]) -> None:
        if sensor == "accelerometer":
            self.waiting.append((time_s, values))
        else:
            self.sensors.setdefault(sensor, deque(maxlen=64)).append((time_s, values))

    def rows(self, now_s: float, refuse: Callable[[str], None]) -> Iterator[_Row]:
        """The samples that are complete at the device's time, and drop those that will not become so."""
        down = "gravity" if "gravity" in self.sensors else "totalacceleration"
        while self.waiting:
            time_s, free = self.waiting[0]
            found = [self.sensors.get(name, ()) for name in ("orientation", down)]
            if now_s - time_s <= LATE_S and any(not entries or entries[-1][0] < time_s for entries in found):
                return
            self.waiting.popleft()
            quat_wxyz, gravity = (_nearest(entries, time_s) for entries in found)
            if quat_wxyz is None or gravity is None:
                refuse(UNPAIRED)
                continue
            if down != "gravity":
                gravity = tuple(whole - own for whole, own in zip(gravity, free))
            yield _Row(time_s, quat_wxyz, gravity, free)


def _nearest(entries: Iterable[tuple[float, tuple[float, ...]]], time_s: float) -> tuple[float, ...] | None:
    """Values of the entry nearest to a time, within `PAIR_S`."""
    at, values = min(entries, key=lambda entry: abs(entry[0] - time_s), default=(math.inf, ()))
    return values if abs(at - time_s) <= PAIR_S else None


@dataclass
class _Watch:
    """State of one device."""

    convention: WatchConvention | None = None
    rows: list[_Row] = field(default_factory=list)
    """Samples that the convention will be found in."""
    changed: int = 0
    """Samples in a row whose gravity has another length than the convention says; before it is found, those whose time
    is far from the others'."""
    entries: _Entries = field(default_factory=_Entries)
    whole: bool = False
    """Whether it sends whole samples, so that entries of single sensors are another device's, the phone's."""

    def understood(self, row: _Row) -> WatchConvention | None:
        """The convention, once it is found; until then the sample is kept for that."""
        if self.convention is not None:
            length = math.hypot(*row.gravity) * abs(self.convention.m_s2)
            self.changed = 0 if G_M_S2 / OTHER_UNIT < length < G_M_S2 * OTHER_UNIT else self.changed + 1
            if self.changed < CHANGED_ROWS:
                require(NO_CONVENTION if self.changed else None)
                return self.convention
            self.convention, self.changed, self.rows = None, 0, []
        step_s = row.time_s - self.rows[-1].time_s if self.rows else 0.01
        if not 0 < step_s <= FIRST_S:  # late, repeated, or of another time
            self.changed += abs(step_s) > FIRST_S
            if self.changed < CHANGED_ROWS:
                return None
        if self.changed >= CHANGED_ROWS or len(self.rows) >= MAX_ROWS:
            self.rows, self.changed = [], 0
        self.rows.append(row)
        if row.time_s - self.rows[0].time_s < FIRST_S or len(self.rows) < FIRST_ROWS:
            return None
        rows, self.rows, self.changed = self.rows, [], 0
        try:
            gravity, quat_wxyz = (np.array([getattr(each, name) for each in rows]) for name in ("gravity", "quat_wxyz"))
            self.convention = watch_convention(gravity, quat_wxyz, "watch")
        except WearcapError as error:
            raise Fault(NO_CONVENTION) from error
        return self.convention


class WatchSource(DatagramSource):
    """Watches and phones whose app sends datagrams. `joint=left_wrist` names the wrist of the one that sends here."""

    scheme, port, hz = "watch", 5555, 100.0
    convention = "SensorLog's CSV or JSON, Sensor Logger's JSON; g or m/s², either sign: found in the first second"

    own_options = ("joint",)

    def __init__(self, address: Address):
        super().__init__(address)
        self.joint = address.options.get("joint")
        if self.joint is not None:
            require_choice(self.joint, WRISTS, f"joint={self.joint}")
        self._watches = Names(lambda _: _Watch())
        self._columns: list[str] = []

    def packets(self, data: bytes, arrived_s: float, refuse: Callable[[str], None]) -> Iterator[Packet | None]:
        json = data.lstrip()[:1] in (b"{", b"[")
        for name, row in self._json_rows(data, arrived_s, refuse) if json else self._csv_rows(data, refuse):
            with _refusing(refuse):
                yield self._packet(name, row, arrived_s)

    def _json_rows(self, data: bytes, arrived_s: float, refuse: Callable[[str], None]) -> Iterator[tuple[str, _Row]]:
        """Samples by device: of Sensor Logger's message, or of SensorLog's objects, one or a list, or one a line."""
        for text in data.splitlines()[:MAX_ENTRIES] if b"}\n{" in data else [data]:
            try:
                content = parse_json(text, "message", "message")
            except (WearcapError, ValueError):
                refuse(NO_SAMPLE)
                continue
            if isinstance(content, dict) and isinstance(content.get("payload"), list):
                with counted(refuse):
                    yield from self._sensor_logger(content, arrived_s, refuse)
                continue
            for entry in content[:MAX_ENTRIES] if isinstance(content, list) else [content]:
                with _refusing(refuse):
                    name = next((entry[key] for key in ("deviceID", "deviceId", "deviceName") if key in entry), "watch")
                    yield name, _sensor_log({key.partition("(")[0]: value for key, value in entry.items()}.get)

    def _sensor_logger(
        self, content: dict[str, Any], arrived_s: float, refuse: Callable[[str], None]
    ) -> Iterator[tuple[str, _Row]]:
        name = content.get("deviceId") or "watch"
        watch, entries = self._watches.entry(name, arrived_s), []
        for entry in content["payload"][:MAX_ENTRIES]:
            with _refusing(refuse):
                sensor = entry["name"].lower().replace(" ", "").replace("_", "")
                if sensor in _VALUES:
                    given = entry.get("values")
                    values = given if isinstance(given, dict) else entry
                    numbers = tuple(_number(values[key]) for key in _VALUES[sensor])
                    entries.append((_number(entry["time"]) / 1e9, sensor, numbers))
        for time_s, sensor, numbers in sorted(entries, key=lambda entry: entry[0]):
            if sensor == "wristmotion":
                watch.whole = True
                yield name, _Row(time_s, numbers[:4], numbers[4:7], numbers[7:])
            elif not watch.whole:
                watch.entries.add(sensor, time_s, numbers)
                for row in watch.entries.rows(time_s, refuse):
                    yield name, row

    def _csv_rows(self, data: bytes, refuse: Callable[[str], None]) -> Iterator[tuple[str, _Row]]:
        text = ""
        with _refusing(refuse):
            text = data.decode("utf-8")
        for line in text.splitlines()[:MAX_ENTRIES]:
            cells = [cell.strip() for cell in line.split(";" if line.count(";") > line.count(",") else ",")]
            if any(cell.startswith("motionQuaternionW") for cell in cells):
                self._columns = [cell.partition("(")[0] for cell in cells[:MAX_COLUMNS] if len(cell) <= 64]
            elif not self._columns:
                return refuse(NO_HEADER)
            elif line.strip():
                with _refusing(refuse):
                    values = dict(zip(self._columns, cells, strict=True))
                    yield values.get("deviceID") or values.get("deviceName") or "watch", _sensor_log(values.get)
        return None

    def _packet(self, name: str, row: _Row, arrived_s: float) -> Packet | None:
        """A device's sample in wearcap's terms."""
        watch = self._watches.entry(name, arrived_s)
        require(time_fault(row.time_s))
        R, felt = matrix_of(row.quat_wxyz), (*row.gravity, *row.free)
        if not all(abs(value) <= MAX_ACC_M_S2 for value in felt):
            raise Fault(OUT_OF_RANGE if all(map(math.isfinite, felt)) else NOT_FINITE)
        convention = watch.understood(row)
        if convention is None:
            return None
        R = R.T.contiguous() if convention.back else R
        acc_world = R @ (convention.m_s2 * torch.tensor(row.free))
        require(values_fault(acc_world, (3,), MAX_ACC_M_S2))
        device = self.joint or device_of(name)
        sample = WatchSample(row.time_s, R, acc_world, device)
        return Packet(self.wearer, device, f"{self.name}/{name}", row.time_s, arrived_s, sample)


class WatchHttpSource(WatchSource):
    """The same over HTTP: each POST is a message. `token=…` in the address must then be in the app's, too."""

    scheme, port = "watch+http", 8000
    own_options = ("joint", "token")

    async def listen(self, inbox: Inbox) -> Callable[[], Awaitable[None]]:
        server = _Posts(self, Guard.of(self.address.host, self.address.options.get("token")), inbox)
        return lambda: asyncio.to_thread(server.stop)


class _Posts(HttpServer):
    """Gives a source what is posted, one message at a time."""

    def __init__(self, source: DatagramSource, guard: Guard, inbox: Inbox):
        self.source, self.inbox, self.lock = source, inbox, threading.Lock()
        super().__init__(source.address.host, source.address.port, _Post, guard)

    def refuse(self, why: str) -> None:
        self.inbox.refuse(self.source.name, why)

    def handle_error(self, request: Any, client_address: Any) -> None:
        self.refuse("broken connection")


class _Post(Handler):
    server: _Posts  # pyright: ignore[reportIncompatibleVariableOverride]

    def do_POST(self) -> None:
        self.answer(self._take)

    def do_GET(self) -> None:
        self.answer(self._refuse)

    do_HEAD = do_PUT = do_DELETE = do_OPTIONS = do_GET

    def _refuse(self) -> None:
        raise Answer(HTTPStatus.METHOD_NOT_ALLOWED, "a sensor app's messages are POSTed here")

    def _take(self) -> None:
        source, body = self.server.source, self.body(MAX_BODY)
        self.place.rise(SPOKEN)
        with self.server.lock:
            if not source.budget.allows(len(body), self.place):
                raise Answer(HTTPStatus.TOO_MANY_REQUESTS)
            if source.understand(body, self.server.inbox, self.place):
                self.place.rise(DELIVERING)
        self.send(b"")

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        self.server.refuse(HTTPStatus(code).phrase.lower())
        super().send_error(code, message, explain)

    def log_error(self, format: str, *args: Any) -> None:
        self.server.refuse("broken connection")


_VALUES: Mapping[str, tuple[str, ...]] = {
    "wristmotion": (
        *(f"quaternion{axis}" for axis in _WXYZ),
        *(f"{part}{axis}" for part in ("gravity", "acceleration") for axis in _XYZ),
    ),
    "orientation": ("qw", "qx", "qy", "qz"),
    "accelerometer": ("x", "y", "z"),
    "gravity": ("x", "y", "z"),
    "totalacceleration": ("x", "y", "z"),
}
"""Sensor Logger's sensors, and the values of each."""


@contextmanager
def _refusing(refuse: Callable[[str], None]) -> Iterator[None]:
    """What is no sample is counted, and the next one looked at."""
    try:
        with counted(refuse):
            yield
    except (WearcapError, ValueError, TypeError, LookupError, OverflowError, AttributeError):
        refuse(NO_SAMPLE)


def _number(value: object) -> float:
    """A number, or a text that is one. Raises ValueError for anything else."""
    if (
        isinstance(value, bool)
        or not isinstance(value, int | float | str)
        or (isinstance(value, str) and len(value) > 64)
    ):
        raise ValueError("no number")
    return float(value)


def _sensor_log(value_of: Callable[[str], Any]) -> _Row:
    """A sample of SensorLog, from its values by name. Raises ValueError where it has none."""

    def numbers(name: str, axes: Sequence[str]) -> tuple[float, ...]:
        return tuple(_number(value_of(f"{name}{axis}")) for axis in axes)

    free = numbers("motionUserAcceleration", _XYZ)
    if value_of("motionGravityX") is not None:
        gravity = numbers("motionGravity", _XYZ)
    else:
        gravity = tuple(whole - own for whole, own in zip(numbers("accelerometerAcceleration", _XYZ), free))
    time = value_of("motionTimestamp_sinceReboot")
    time_s = _number(time) if time not in (None, "") else logging_time(str(value_of("loggingTime"))[:64])
    return _Row(time_s, numbers("motionQuaternion", _WXYZ), gravity, free)
