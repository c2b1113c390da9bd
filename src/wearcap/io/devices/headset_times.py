"""Times of headsets' logs: numbers of any unit, clock times, dates, and the ticks of .NET and Windows; in s, rising."""

import datetime
import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from wearcap.boundary.opening import understood
from wearcap.errors import WearcapError
from wearcap.io.formats.trajectory import UNITS, time_unit_of

_UNIT_WORDS = {"s": "s", "sec": "s", "seconds": "s", "ms": "ms", "us": "us", "µs": "us", "ns": "ns"}
_TICK_S = 1e-7
_TICKS = {
    ".NET ticks": (6.2e17, 6.7e17, 621355968000000000),
    "Windows' file times": (1.2e17, 1.5e17, 116444736000000000),
}
"""Ticks of 100 ns since the years 1 and 1601 that are times between 1965 and 2075, and those until 1970."""
_CLOCK = re.compile(
    r"(?:(?:(\d{4})[-/.](\d\d?)[-/.](\d\d?)|\d\d?[-/.]\d\d?[-/.]\d{2,4})[T _]+)?"
    r"(?:(\d\d?):)?(\d\d?):(\d\d)(?:[.,](\d+)|:(\d{3}))?\s*(AM|PM)?\s*(Z|[+-]\d\d:?\d\d)?",
    re.IGNORECASE,
)
_HALF_DAY_S = 11 * 3600.0
_REPEATS = 0.1
"""Share of rows that repeat the time before, from which a clock is coarser than the rows."""


def moment(value: Any, label: str, path: Path) -> tuple[float, bool]:
    """A field of time as a number, NaN where it is empty, and whether it is a text: seconds of the day or since 1970."""
    text = value.strip() if isinstance(value, str) else value
    if text is None or text == "":
        return math.nan, False
    with understood(f"{label}: {str(value)[:30]!r} is no time", path, "numbers, clock times or dates"):
        if isinstance(text, str) and (found := _CLOCK.fullmatch(text)) and (found[4] or found[7] or found[8]):
            return _seconds(found), True
        if isinstance(text, bool):
            raise ValueError
        return float(text.replace(",", ".") if isinstance(text, str) else text), False


def _seconds(found: re.Match[str]) -> float:
    """Seconds of a clock time since midnight, or since 1970 where it has a date that begins with the year."""
    year, month, day, hours, minutes, seconds, fraction, thousandths, half, zone = found.groups()
    hour = int(hours or 0)
    if half:
        hour = hour % 12 + 12 * (half.upper() == "PM")
    total = 3600.0 * hour + 60 * int(minutes) + int(seconds) + float(f"0.{fraction or thousandths or 0}")
    if year:
        total += 86400.0 * (datetime.date(int(year), int(month), int(day)).toordinal() - 719163)
    if zone and zone.upper() != "Z":
        total -= (1 if zone[0] == "+" else -1) * (3600 * int(zone[1:3]) + 60 * int(zone[-2:]))
    return total


def in_seconds(times: np.ndarray, name: str, texts: bool, time_unit: str | None, path: Path) -> tuple[np.ndarray, str]:
    """Times (n,) in s, and how they stand in the file; texts are in s already, and those of a day run on past midnight.

    Raises WearcapError for a rate that is no recording's.
    """
    if texts:
        return times + 86400.0 * np.cumsum(np.diff(times, prepend=times[:1]) < -_HALF_DAY_S), "as clock times"
    if time_unit is None:
        for kind, (least, most, epoch) in _TICKS.items():
            if least < np.nanmedian(times) < most:
                return (times - epoch) * _TICK_S, f"in {kind}"
        if "ticks" in name.lower():
            return times * _TICK_S, "in ticks of 100 ns"
    unit = time_unit or time_unit_of(np.unique(times), _unit_of(name), path)
    return times * UNITS[unit], f"in {unit}"


def _unit_of(name: str) -> str | None:
    """Unit that a column's name gives, in brackets or as its last word."""
    found = re.search(r"[\[(]\s*(\w+)\s*[\])]", name)
    words = re.findall(r"[a-zµ]+|[A-Z][a-z]*", name)
    return (
        _UNIT_WORDS.get(found[1].lower()) if found else _UNIT_WORDS.get(words[-1].lower()) if len(words) > 1 else None
    )


def grain(seconds: np.ndarray) -> int:
    """Decimals of a second that a clock has, 0 to 6."""
    since = seconds - seconds.min()
    return next((k for k in range(6) if np.abs(since * 10**k - np.round(since * 10**k)).max() < 0.02), 6)


def rising(
    seconds: np.ndarray, values: np.ndarray, rows: np.ndarray, about: str, path: Path
) -> tuple[np.ndarray, np.ndarray, str]:
    """Times (m,) that rise, the rows (m,) that they are of, and a note of what was mended.

    Rows are sorted, which must make the way of `values` (n, 3) shorter: two recordings in one table do not get so. A
    clock that is coarser than the rows is spread evenly over them; else rows of equal times are dropped, but the first.
    """
    notes, order = [], np.argsort(seconds, kind="stable")
    order = order[np.isfinite(seconds[order])]
    if timeless := len(seconds) - len(order):
        notes.append(f"{timeless} rows without a time were left out")
    falls = int((np.diff(seconds[np.sort(order)]) < 0).sum())
    if falls:
        seen = order[np.isfinite(values[order]).all(1)]
        ways = [np.abs(np.diff(values[rows_of], axis=0)).sum() for rows_of in (np.sort(seen), seen)]
        if ways[1] > ways[0] + 1e-9:
            back = rows[int(np.argmax(np.diff(seconds) < 0)) + 1]
            what = f"{about} {back}: times go back, and sorted rows jump to and fro"
            raise WearcapError(what, path, "one recording in a file", "Cut it there.")
        notes.append(f"{falls} rows lay before their predecessors and were sorted")
    times = seconds[order]
    first = np.flatnonzero(np.diff(times, prepend=-np.inf) > 0)
    repeats = len(times) - len(first)
    moved = np.abs(np.diff(values[order], axis=0)).max(1) > 0
    if len(first) > 2 and (moved & (np.diff(times) == 0)).sum() > _REPEATS * len(times):
        notes.append(f"{repeats} rows repeat a time of a coarse clock, over which they were spread")
        first, row = first[1:], np.arange(len(times))
        step = (times[first[-1]] - times[first[0]]) / (first[-1] - first[0])
        outside = np.minimum(row - first[0], 0) + np.maximum(row - first[-1], 0)
        return np.interp(row, first, times[first]) + outside * step, order, "; ".join(notes)
    if repeats:
        notes.append(f"{repeats} rows repeat a time and were dropped")
    return times[first], order[first], "; ".join(notes)
