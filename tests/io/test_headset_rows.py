"""Rows of headset logs: times of any kind, repeated and unsorted rows, and devices that are lost for a while."""

from pathlib import Path

import numpy as np
import pytest

from headset_tables import TIME, all_seven, compare, csv, names_of, seven, write
from wearcap.errors import WearcapError
from wearcap.io.devices.headset_log import read_raw_poses

# --- times ---------------------------------------------------------------------------------------------------------

WHEN = np.datetime64("2024-05-03T23:59:57.000000")
"""Midnight passes after 3 s."""
EPOCH = (WHEN - np.datetime64("1970-01-01")) / np.timedelta64(1, "s")


def stamps(shape) -> list[str]:
    moments = WHEN + np.round((TIME - TIME[0]) * 1e6).astype("timedelta64[us]")
    return [shape(str(moment)) for moment in moments]


@pytest.mark.parametrize(
    ("shape", "start"),
    [
        (lambda text: text, EPOCH),
        (lambda text: text.replace("T", " "), EPOCH),
        (lambda text: text + "0+02:00", EPOCH - 7200),
        (lambda text: text.replace(".000000", "") + "Z", EPOCH),
        (lambda text: text[11:23], 86397.0),
        (lambda text: text[11:23].replace(".", ":"), 86397.0),
        (lambda text: text[11:23].replace(".", ","), 86397.0),
        (
            lambda text: (
                f"5/3/2024 {'11' if text[11] == '2' else '12'}{text[13:23]} {'PM' if text[11] == '2' else 'AM'}"
            ),
            86397.0,
        ),
    ],
)
def test_clock_times_and_dates_run_past_midnight(tmp_path, shape, start):
    path = csv(
        tmp_path / "a.csv",
        "timestamp;" + names_of("{d}_{q}_{a}").replace(",", ";"),
        stamps(shape),
        all_seven(),
        between=";",
    )
    compare(path, start, late=1.1e-3)


@pytest.mark.parametrize(
    ("name", "ticks", "start"),
    [
        ("ticks", 621355968000000000 + round(EPOCH * 1e7), EPOCH),
        ("time", 621355968000000000 + round(EPOCH * 1e7), EPOCH),
        ("FileTime", 116444736000000000 + round(EPOCH * 1e7), EPOCH),
        ("ticks", 5_000_000_000, 500.0),
    ],
)
def test_ticks_of_100_ns(tmp_path, name, ticks, start):
    times = [str(ticks + round((moment - TIME[0]) * 1e7)) for moment in TIME]
    compare(csv(tmp_path / "a.csv", f"{name},{names_of('{d}_{q}_{a}')}", times, all_seven()), start)


@pytest.mark.parametrize("factor", [1.0, 1e3, 1e6, 1e9])
def test_units_of_an_epoch(tmp_path, factor):
    times = [
        str(round((EPOCH + moment - TIME[0]) * factor, 6 if factor == 1 else 0)).removesuffix(".0") for moment in TIME
    ]
    compare(csv(tmp_path / "a.csv", f"unix_time,{names_of('{d}_{q}_{a}')}", times, all_seven()), EPOCH, late=1.1e-3)


@pytest.mark.parametrize("tick", [1.0, 0.1])
def test_a_coarse_clock_keeps_the_rate(tmp_path, tick):
    """Times cut to whole ticks: all poses stay, in even steps."""
    times = np.floor(TIME / tick + 1e-6) * tick
    path = csv(tmp_path / "a.csv", f"time,{names_of('{d}_{q}_{a}')}", times, all_seven())
    _, _, notes = compare(path, late=0.04)
    assert any("coarse clock" in note for note in notes)


def test_repeated_and_unsorted_rows(tmp_path):
    """BOXRR's three rows of equal times at the start are one; rows in any order are sorted; both are noted with their number."""
    path = csv(tmp_path / "a.csv", f"time,{names_of('{d}_{q}_{a}')}", TIME, all_seven())
    head, *rows = path.read_text().splitlines()
    moved = rows[0].replace(",0.", ",0.0", 1)
    write(path, "\n".join([head, rows[0], moved, moved, *rows[1:]]))
    assert "head: 2 rows that repeat a time are left out" in compare(path)[2]
    swapped = [rows[k] for k in (1, 0, *range(2, 100), 101, 100, *range(102, len(rows)))]
    write(path, "\n".join([head, *swapped]))
    assert "head: 2 rows are earlier than the ones before them: all are sorted by time" in compare(path)[2]


def test_two_recordings_in_one_table(tmp_path):
    there = np.concatenate([all_seven(), all_seven() + np.tile([1.0, 0, 0, 0, 0, 0, 0], 3)])
    path = csv(tmp_path / "a.csv", f"time,{names_of('{d}_{q}_{a}')}", np.concatenate([TIME, TIME + 1e-3]), there)
    with pytest.raises(WearcapError, match=f"line {len(TIME) + 2}: times go back"):
        read_raw_poses(path)


# --- tracking ------------------------------------------------------------------------------------------------------

NOTHING = ["nan,nan,nan,nan,nan,nan,nan", ",,,,,,", "0,0,0,0,0,0,0", "0,0,0,0,0,0,1"]


def with_lost(path: Path, device: int, lost, text: str) -> Path:
    """The table with fields of a device replaced in some rows."""
    csv(path, f"time,{names_of('{d}_{q}_{a}')}", TIME, all_seven())
    rows = path.read_text().splitlines()
    for k in lost:
        fields = rows[k + 1].split(",")
        fields[1 + 7 * device : 8 + 7 * device] = text.split(",")
        rows[k + 1] = ",".join(fields)
    return write(path, "\n".join(rows))


@pytest.mark.parametrize("text", NOTHING)
def test_short_gaps_of_the_head_are_interpolated(tmp_path, text):
    path = with_lost(tmp_path / "a.csv", 0, range(50, 60), text)
    notes = compare(path, within=0.03, turned=3.0)[2]
    assert "head is not tracked in 10 of 240 rows" in notes
    assert "10 of them, in gaps of at most 1 s, were interpolated" in notes


def test_long_gaps_of_the_head_stay(tmp_path):
    poses, _, _, _ = read_raw_poses(with_lost(tmp_path / "a.csv", 0, range(50, 90), NOTHING[0]))
    assert np.array_equal(poses["head"].seconds.round(6), np.delete(TIME, range(50, 90)).round(6))


def test_a_hand_that_freezes_is_lost(tmp_path):
    """The last pose repeated while the head moves; a pause of everything is no loss."""
    last = ",".join(f"{value:.7f}" for value in seven("left")[99])
    poses, _, _, notes = read_raw_poses(with_lost(tmp_path / "a.csv", 1, range(100, 140), last))
    assert len(poses["left_wrist"].seconds) == len(TIME) - 40
    assert "left_wrist repeats its last pose in 40 rows, where it counts as lost" in notes
    still = np.repeat(all_seven()[:1], len(TIME), 0)
    poses, _, _, _ = read_raw_poses(csv(tmp_path / "b.csv", f"time,{names_of('{d}_{q}_{a}')}", TIME, still))
    assert len(poses["left_wrist"].seconds) == len(TIME)


@pytest.mark.parametrize(
    ("lost", "kept", "message"),
    [
        (range(60), slice(60, None), "the first 2.0 s are left out: right_wrist is not tracked in them"),
        (range(180, 240), slice(0, 180), "the last 2.0 s are left out: right_wrist is not tracked in them"),
        (range(180), None, "right_wrist is left out: it is tracked over 2.0 of 8.0 s only"),
        (range(240), None, "right_wrist is left out: it is tracked over 0.0 of 8.0 s only"),
    ],
)
def test_a_hand_that_is_tracked_late(tmp_path, lost, kept, message):
    poses, _, _, notes = read_raw_poses(with_lost(tmp_path / "a.csv", 2, lost, NOTHING[2]))
    assert message in notes
    assert ("right_wrist" in poses) == (kept is not None)
    assert np.array_equal(poses["head"].seconds.round(6), TIME[kept or slice(None)].round(6))
    assert len(poses["left_wrist"].seconds) == len(poses["head"].seconds)


def test_flags_of_tracking(tmp_path):
    flags = ["False" if k < 20 else "True" for k in range(len(TIME))]
    names = names_of("{d}_{q}_{a}").replace("left_pos_x", "left_isTracked,left_pos_x")
    path = csv(tmp_path / "a.csv", f"time,{names}", TIME, seven("head"), flags, seven("left"), seven("right"))
    poses, _, _, notes = read_raw_poses(path)
    assert "left_wrist is not tracked in 20 of 240 rows" in notes
    assert poses["left_wrist"].seconds[0] == pytest.approx(poses["head"].seconds[0])
