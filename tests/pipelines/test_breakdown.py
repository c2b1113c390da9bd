"""Where a method errs: by what was done, by part of the body, in which recordings."""

import math

import pytest
from rich.console import Console

from wearcap.evaluation import breakdown
from wearcap.metrics.table import Row, Summary, rich_lines


def row(name: str, seed: int, error: float, frames: int = 10) -> Row:
    """A row whose hands err twice as much as the whole."""
    return Row(name, seed, frames, {"mpjpe_cm": error, "head_pe_cm": 1.0, "hand_pe_cm": 2 * error, "root_cm": 9.0})


DONE = {"a": "walk, stand", "b": "walk", "c": "dance", "d": ""}
ROWS = [row(name, seed, error + seed) for seed in (0, 1) for name, error in zip("abcd", (1.0, 3.0, 20.0, 7.0))]


def shown(table) -> str:
    console = Console(width=120)
    with console.capture() as text:
        console.print(table)
    return text.get()


def test_activities_are_what_was_mostly_done():
    found = breakdown.by_activity(ROWS, DONE)
    assert list(found) == ["dance", breakdown.UNNAMED, "walk"]
    assert found["walk"]["mpjpe_cm"].mean == pytest.approx(2.5)
    assert found["walk"]["mpjpe_cm"].std == pytest.approx(math.sqrt(0.5))
    longer = [row("a", 0, 1.0, frames=30), row("b", 0, 3.0, frames=10)]
    assert breakdown.by_activity(longer, DONE)["walk"]["mpjpe_cm"].mean == pytest.approx(1.5)


def test_worst_median_and_best_are_found_by_the_mean_over_seeds():
    errors = breakdown.main_errors(ROWS)
    assert errors == {"a": 1.5, "b": 3.5, "c": 20.5, "d": 7.5}
    assert breakdown.extremes(errors) == {"worst": "c", "median": "b", "best": "a"}
    assert breakdown.extremes({"x": 2.0, "y": math.nan}) == {"worst": "x", "median": "x", "best": "x"}
    assert breakdown.extremes({"y": math.nan}) == {}


def test_tables_say_what_is_not_followed_and_in_which_unit():
    text = shown(
        breakdown.activity_table("ours", breakdown.by_activity(ROWS, DONE), {"dance": 1, "walk": 2, "unnamed": 1})
    )
    lines = [line for line in text.splitlines() if "(" in line]
    assert lines[0].strip() == "ours (cm)"
    assert [line.split()[1] for line in lines[1:]] == ["dance", "unnamed", "walk"]
    assert "41.00" in lines[1]
    assert "9.00" not in text, "root_cm is of no part"
    text = shown(breakdown.recording_table("ours", ROWS, DONE))
    assert "worst: c, dance" in text
    assert "best: a, walk" in text
    in_mm = {
        "ours": {
            "mpjpe_mm": Summary(50.0, 1.0, 2),
            "foot_pe_mm": Summary(80.0, 1.0, 2),
            "skate_ratio": Summary(4, None, 1),
        }
    }
    text = shown(breakdown.part_table("parts", in_mm))
    assert "parts (mm; skate of the truth's)" in text
    assert "80.00" in text
    assert "±" not in text
    assert "–" in shown(rich_lines("t", {"one": {"m": Summary(1.0, None, 1)}, "two": {}}, ("m",)))
