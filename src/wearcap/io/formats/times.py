"""Times of all tables: numbers of any unit, clock times, dates, and the ticks of .NET and Windows; in s, and rows in their order."""

import datetime
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from wearcap.boundary.opening import understood
from wearcap.errors import WearcapError
from wearcap.io.formats.poses import row_name

UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Seconds per unit of time."""
STEP_S = (0.9e-3, 2.0)
"""Least and largest median time between poses: 1.1 kHz to one in two seconds."""
MAX_GAP_S, MAX_SPAN_S = 600.0, 12 * 3600.0
MAX_SPARSITY = 10.0
"""Largest ratio of a file's span to what its rows cover at their median step."""
_EPOCH_S = 9e8, 4.2e9
"""Seconds since 1970 of the years 1998 to 2103."""
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
_TO_AND_FRO = 1.5
"""How much longer the way of sorted rows may be than that of the rows as they stand."""
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
    unit = time_unit or time_unit_of(np.unique(times), unit_named(name), path)
    return times * UNITS[unit], f"in {unit}"


def unit_named(column: str) -> str | None:
    """Unit of time that a column's name gives, in brackets or as its last word."""
    bracketed = re.search(r"[\[(]\s*(\w+)\s*[\])]", column)
    words = re.findall(r"[A-Z]?[a-zµ]+|[A-Z]+", column)
    return _UNIT_WORDS.get(bracketed[1].lower() if bracketed else words[-1].lower() if len(words) > 1 else "")


def time_unit_of(times: np.ndarray, named: str | None, where: str | Path) -> str:
    """Unit of times by their median step; the named one, then seconds since 1970, decide between two that are possible.

    Raises WearcapError when no unit gives a plausible rate.
    """
    steps = np.diff(times)
    rising = steps[steps > 0]
    if not len(rising):
        possible = list(UNITS)
    else:
        step = float(np.median(rising))
        possible = [unit for unit, s in UNITS.items() if STEP_S[0] <= step * s <= STEP_S[1]]
        if not possible:
            what = f"{step:.4g} between successive times, which is no recording's in seconds, ms, µs or ns"
            raise WearcapError(what, where, "0.5 to 1100 poses in a second", "Give time_unit=s, ms, us or ns.")
    if named in possible:
        return str(named)
    since_1970 = [unit for unit in possible if _EPOCH_S[0] <= float(times[0]) * UNITS[unit] <= _EPOCH_S[1]]
    return (since_1970 or possible)[0]


def check_span(seconds: np.ndarray, path: Path, name: Callable[[int], str]) -> None:
    """Raise WearcapError for times that no recording has: nothing made of them is much larger than the file."""
    steps = np.diff(seconds)
    if not len(steps):
        return
    widest, span = int(steps.argmax()), float(seconds[-1] - seconds[0])
    covered = float(np.median(steps)) * len(seconds)
    cut = "A time is damaged, or two recordings stand in one file: cut it there."
    if steps[widest] > MAX_GAP_S:
        what = f"a gap of {_plain_span(steps[widest])} before {name(widest + 1)}"
        raise WearcapError(what, path, f"gaps below {MAX_GAP_S / 60:.0f} minutes", cut)
    if span > MAX_SPAN_S:
        what = f"poses over {_plain_span(span)}"
        raise WearcapError(what, path, f"a recording of less than {MAX_SPAN_S / 3600:.0f} hours", cut)
    if span > MAX_SPARSITY * covered + 10.0:
        what = (
            f"poses in {100 * covered / span:.0f} % of {_plain_span(span)}, the longest gap before {name(widest + 1)}"
        )
        raise WearcapError(what, path, f"poses in {100 / MAX_SPARSITY:.0f} % of the time at least", cut)


def _plain_span(seconds: float) -> str:
    return f"{seconds / 3600:.3g} hours" if seconds >= 3600 else f"{seconds:.4g} s"


def grain(seconds: np.ndarray) -> int:
    """Decimals of a second that a clock has, 0 to 6."""
    since = seconds - seconds.min()
    return next((k for k in range(6) if np.abs(since * 10**k - np.round(since * 10**k)).max() < 0.02), 6)


def in_order(
    seconds: np.ndarray,
    values: np.ndarray,
    whole: np.ndarray,
    lacking: str,
    path: str | Path,
    name: Callable[[int], str] = row_name,
) -> tuple[np.ndarray, list[str]]:
    """Rows of a table in the order of time (also several of one time), and notes on those that were left out or sorted.

    Left out are rows without a time and those that are not `whole`, which lack what `lacking` says. Sorting should make
    the way of the `values` (n, k) shorter. Raises WearcapError, with the `name` of a row, where it makes them go to and fro.
    """
    rows = np.flatnonzero(whole & np.isfinite(seconds))
    order = rows[np.argsort(seconds[rows], kind="stable")]
    late = np.flatnonzero(np.diff(seconds[rows]) < 0)
    counts = {f"without {lacking} are left out": len(seconds) - len(rows)}
    if len(late):
        known = np.isfinite(values).all(1)
        ways = [np.linalg.norm(np.diff(values[at[known[at]]], axis=0), axis=1).sum() for at in (rows, order)]
        if ways[1] > _TO_AND_FRO * ways[0] + 1e-6:
            back_s = seconds[rows[late[0]]] - seconds[rows[late[0] + 1]]
            what = f"{name(int(rows[late[0] + 1]))}: times go back by {back_s:.1f} s, and sorted rows go to and fro"
            raise WearcapError(what, path, "one recording", "Two recordings stand in one file: cut it there.")
        counts["are earlier than the ones before them: all are sorted by time"] = len(late)
    return order, [f"{count} rows {what}" for what, count in counts.items() if count]


def without_repeats(seconds: np.ndarray, values: np.ndarray, order: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Of rows in the order of time the first of each time, and a note on the others."""
    again = np.append(False, np.diff(seconds[order]) == 0)[: len(order)]
    if not again.any():
        return order, []
    changed = again & np.append(False, (np.diff(np.nan_to_num(values[order]), axis=0) != 0).any(1))
    others = f", {changed.sum()} of them with other values" if changed.any() else ""
    return order[~again], [f"{again.sum()} rows that repeat a time are left out{others}"]


def evenly_spread(seconds: np.ndarray, values: np.ndarray, order: np.ndarray) -> tuple[np.ndarray, list[str]] | None:
    """Times of rows that move within the ticks of a coarse clock, spread evenly over them, and a note; None for a fine one."""
    times = seconds[order]
    first = np.flatnonzero(np.diff(times, prepend=-np.inf) > 0)
    moved = np.abs(np.diff(values[order], axis=0)).max(1) > 0
    if len(first) < 3 or (moved & (np.diff(times) == 0)).sum() <= _REPEATS * len(times):
        return None
    note = f"{len(times) - len(first)} rows repeat a time of a coarse clock, over which they were spread"
    first, row = first[1:], np.arange(len(times))
    step = (times[first[-1]] - times[first[0]]) / (first[-1] - first[0])
    outside = np.minimum(row - first[0], 0) + np.maximum(row - first[-1], 0)
    return np.interp(row, first, times[first]) + outside * step, [note]
