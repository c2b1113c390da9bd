"""How far simulated people and sensors differ from real ones: gait statistics of straight walking against CMU, knees, hips
and ankles over the gait cycle against those of healthy adults, and sensors' errors against what papers and vendors say.
"""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table
from scipy.stats import ks_2samp

from benchmarks.tables.gait_statistics import Clip, clip_of, curve_deviations, walking_windows
from benchmarks.tables.result_pages import Grid, Page, Tree, Trees, commands, grid_of, text
from benchmarks.tables.simulated_sensors import Sensing, sensors
from benchmarks.tables.tabling import write_tree
from wearcap.recording import Recording, RecordingStore
from wearsim.recordings.hps import HpsConfig, Protocol

WIDTH = 220


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--parts", nargs="*", default=list(PARTS), choices=list(PARTS), help="tables to make")
    parser.add_argument("--simulated", default="datasets/simulated", help="prepared data set of simulated people")
    parser.add_argument("--cmu", default="datasets/cmu", help="prepared data set of CMU")
    parser.add_argument(
        "--sessions", type=int, default=3, help="walks in which sensors are drawn (1 short one when quick)"
    )
    parser.add_argument("--draws", type=int, default=5, help="of each sensor in each walk (4 when quick)")
    parser.add_argument(
        "--interactions", type=Path, default=Path("datasets/simulated_interactions"), help="whose hands are looked at"
    )


def tables(options: argparse.Namespace, about: dict[str, str]) -> Path:
    """Print and write the tables; returns the path of the JSON file."""
    found = {part: PARTS[part](options) for part in options.parts}
    console = Console(width=WIDTH)
    for table in _shown(found):
        console.print(table)
    return write_tree(options.output / "simulation.json", {"about": about, "tables": found})


def _shown(found: Tree) -> list[Table]:
    made = {"walking": _statistics_table, "curves": _curves_table, "sensors": _sensors_table}
    return [made[part](tree) for part, tree in found.items()]


def _walking(options: argparse.Namespace) -> Tree:
    simulated, cmu = (walking_windows(_clips(root, options.quick)) for root in (options.simulated, options.cmu))
    return _compared(simulated, cmu)


def _curves(options: argparse.Namespace) -> Tree:
    stores = {"simulated": options.simulated, "CMU": options.cmu}
    return {
        name: curve_deviations(recording.motion for recording in _recordings(root, options.quick) if recording.motion)
        for name, root in stores.items()
    }


def _sensors(options: argparse.Namespace) -> Tree:
    protocol = Protocol(returns_m=(30.0,), end_m=40.0) if options.quick else Protocol()
    sessions, draws = (1, 4) if options.quick else (options.sessions, options.draws)
    return sensors(Sensing(HpsConfig(protocol=protocol), sessions, draws, options.interactions))


PARTS = {"sensors": _sensors, "walking": _walking, "curves": _curves}
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
        full=[
            grid_of(table, tree.get("origins", {}).get(part, tree["about"]))
            for part in tree["tables"]
            for table in _shown({part: tree["tables"][part]})
        ],
        commands=commands(trees),
        measured="",
    )


def _recordings(root: str, quick: bool) -> Iterator[Recording]:
    store = RecordingStore.open(root)
    names = [name for name in store.names() if store.entries[name].duration_s >= 2]
    names = names[:: max(1, len(names) // 60)] if quick else names
    return (store.load(name) for name in names)


def _clips(root: str, quick: bool) -> list[Clip]:
    return [clip_of(recording) for recording in _recordings(root, quick)]


def _compared(simulated: dict[str, torch.Tensor], cmu: dict[str, torch.Tensor]) -> dict[str, dict[str, float]]:
    """Mean and spread of every statistic on both sides, and the Kolmogorov–Smirnov distance between them."""
    rows = {}
    for name in cmu:
        a, b = simulated[name], cmu[name]
        if min(len(a), len(b)) < 2:
            continue
        rows[name] = {
            "simulated_mean": a.mean().item(),
            "simulated_std": a.std().item(),
            "simulated_windows": len(a),
            "cmu_mean": b.mean().item(),
            "cmu_std": b.std().item(),
            "cmu_windows": len(b),
            "ks_distance": float(ks_2samp(a.numpy(), b.numpy())[0]),
        }
    return rows


def _statistics_table(statistics: dict[str, dict[str, float]]) -> Table:
    first = next(iter(statistics.values()), {"simulated_windows": 0, "cmu_windows": 0})
    table = Table(title="Straight walking, windows of 2 s")
    for name in (
        "statistic",
        f"simulated ({first['simulated_windows']})",
        f"CMU ({first['cmu_windows']})",
        "Kolmogorov–Smirnov",
    ):
        table.add_column(name, justify="left" if name == "statistic" else "right")
    for name, row in statistics.items():
        sides = [f"{row[side + '_mean']:.2f} ± {row[side + '_std']:.2f}" for side in ("simulated", "cmu")]
        table.add_row(name, *sides, f"{row['ks_distance']:.2f}")
    return table


def _curves_table(curves: dict[str, dict[str, dict[str, float]]]) -> Table:
    table = Table(
        title="Mean curves of level walking off those of healthy adults, rms in degrees: median of recordings"
    )
    columns = ("recordings", "knee_rms_deg", "worst_knee_deg", "hip_rms_deg", "ankle_rms_deg")
    for name in ("", "recordings", "knee", "knee, worst", "hip", "ankle"):
        table.add_column(name, justify="right" if name else "left")
    for whose, rows in curves.items():
        for speeds, row in rows.items():
            table.add_row(f"{whose}, {speeds}", *(f"{row[name]:.{int(name != 'recordings')}f}" for name in columns))
    return table
