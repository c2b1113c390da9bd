"""Errors of simulated sensors against what papers and vendors say."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks.tables.result_pages import Grid, Page, Tree, Trees, commands, grid_of, text
from benchmarks.tables.simulated_sensors import Sensing, sensors
from benchmarks.tables.tabling import write_tree
from wearsim.recordings.hps import HpsConfig, Protocol


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--sessions", type=int, default=3, help="walks in which sensors are drawn (1 short one when quick)"
    )
    parser.add_argument("--draws", type=int, default=5, help="of each sensor in each walk (4 when quick)")
    parser.add_argument(
        "--interactions", type=Path, default=Path("datasets/simulated_interactions"), help="whose hands are looked at"
    )


def tables(options: argparse.Namespace, about: dict[str, str]) -> Path:
    """Print and write the table; returns the path of the JSON file."""
    protocol = Protocol(returns_m=(30.0,), end_m=40.0) if options.quick else Protocol()
    sessions, draws = (1, 4) if options.quick else (options.sessions, options.draws)
    found = sensors(Sensing(HpsConfig(protocol=protocol), sessions, draws, options.interactions))
    Console(width=220).print(_sensors_table(found))
    return write_tree(options.output / "simulation.json", {"about": about, "tables": {"sensors": found}})


LITERATURE = Path(__file__).with_name("sensor_literature.tsv")
"""Quantity, label with unit, digits, what is published, and where; "ours" is an assumption."""
KEY = (
    "heading_deg_per_sqrt_min",
    "off_after_380_m_cm",
    "length_percent",
    "joint_deg",
    "position_cm",
    "outlier_percent",
    "noise_ug_per_sqrt_hz",
    "attitude_deg",
    "clock_drift_ms_per_h",
    "placement_cm",
    "reach_peak_over_mean",
)
"""Quantities of the page's first table."""


def _sensors_table(found: Tree) -> Table:
    table = Table(title="Simulated sensors against literature")
    for number, column in enumerate(("", *PRESETS, "literature", "source")):
        table.add_column(column, justify="right" if number in (1, 2, 3) else "left")
    for line in _sensor_lines(found):
        table.add_row(*line)
    return table


PRESETS = ("ideal", "typical", "poor")


def _literature() -> list[list[str]]:
    return [line.split("\t") for line in LITERATURE.read_text(encoding="utf-8").splitlines()[1:]]


def _sensor_lines(found: Tree, names: Sequence[str] = ()) -> list[list[str]]:
    """A line per measured quantity (of `names`, or all): by preset, what is published, and where."""
    return [
        [label, *(text(found.get(preset, {}).get(name), int(digits)) for preset in PRESETS), published, source]
        for name, label, digits, published, source in _literature()
        if (not names or name in names) and any(name in of for of in found.values())
    ]


def page(trees: Trees, speed: dict[str, list[Tree]]) -> Page:
    """What docs/results/simulation.md says."""
    tree = trees["simulation"]
    measured = tree["tables"].get("sensors", {})
    return Page(
        title="Simulated people and sensors against real ones",
        headline=Grid(
            "Errors of simulated sensors, measured against the truth that they were drawn from, beside published ones.",
            ("", *PRESETS, "literature", "source"),
            _sensor_lines(measured, KEY),
        ),
        held_out="People and sites are those of the test split. The suit's heading was fitted to the IMU rows of the "
        "paper; nothing else was fitted to a result.",
        simulated="All of it. Each sensor is drawn many times on the same walks; ± is the deviation over draws, and "
        "figures without it are root mean squares over draws, or single. Sensors without presets stand below "
        '"typical".',
        limits=(
            'Where the source is "ours" the size is an assumption, because we know no published figure.',
            "Published errors of joints and localisation are from laboratories and benchmarks, not from long walks.",
            "A session's heading is one draw of a random walk: the distances after which the root is off spread "
            "widely.",
            "Nothing here says that errors are correlated with each other as in a real device.",
        ),
        full=[grid_of(_sensors_table(measured), tree.get("origins", {}).get("sensors", tree["about"]))],
        commands=commands(trees),
        measured="",
    )
