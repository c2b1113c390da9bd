"""How far simulated people and sensors differ from real ones: gait statistics of straight walking and a discriminator
against CMU, and sensors' errors against what papers and vendors say.

The discriminator is a small network that sees two seconds of head and wrist paths and predicts which they are from; it is
judged on people it has not seen. 50 % means that it cannot tell.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import torch
from discriminator import held_out_accuracy
from gait_statistics import Clip, clip_of, walking_windows
from result_pages import Grid, Page, Tree, Trees, grid_of, text
from rich.console import Console
from rich.table import Table
from scipy.stats import ks_2samp
from simulated_sensors import Sensing, sensors
from tabling import finite

from wearcap.files import write_text
from wearcap.recording import RecordingStore
from wearcap.simulation.recordings.hps import HpsConfig, Protocol

WIDTH = 220


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--parts", nargs="*", default=list(PARTS), choices=list(PARTS), help="tables to make")
    parser.add_argument("--simulated", default="datasets/simulated", help="prepared data set of simulated people")
    parser.add_argument("--cmu", default="datasets/cmu", help="prepared data set of CMU")
    parser.add_argument("--seeds", type=int, default=5, help="trainings of the discriminator (2 when quick)")
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
    path = options.output / "simulation.json"
    write_text(path, json.dumps(finite({"about": about, "tables": found}), indent=1) + "\n")
    return path


def _shown(found: Tree) -> list[Table]:
    made = {"walking": _statistics_table, "discriminator": _accuracy_table, "sensors": _sensors_table}
    return [made[part](tree) for part, tree in found.items()]


def _walking(options: argparse.Namespace) -> Tree:
    simulated, cmu = (walking_windows(_clips(root, options.quick)) for root in (options.simulated, options.cmu))
    return _compared(simulated, cmu)


def _discriminator(options: argparse.Namespace) -> Tree:
    simulated, cmu = (_clips(root, options.quick) for root in (options.simulated, options.cmu))
    seeds, steps = (2, 150) if options.quick else (options.seeds, 600)
    accuracy = {
        which: held_out_accuracy(simulated, cmu, which == "walking", range(seeds), steps)
        for which in ("walking", "all activities")
    }
    accuracy["control: CMU against CMU"] = held_out_accuracy(*_halves(cmu), False, range(seeds), steps)
    return accuracy


def _sensors(options: argparse.Namespace) -> Tree:
    protocol = Protocol(returns_m=(30.0,), end_m=40.0) if options.quick else Protocol()
    sessions, draws = (1, 4) if options.quick else (options.sessions, options.draws)
    return sensors(Sensing(HpsConfig(protocol=protocol), sessions, draws, options.interactions))


PARTS = {"sensors": _sensors, "walking": _walking, "discriminator": _discriminator}
LITERATURE = (
    ("heading_deg_per_sqrt_min", "suit: heading drift (°/√min)", 2, "such that the root is as far off as published",
     "HPS, Tables 1 and 2: of inertial suits the heading drifts"),
    ("off_after_70_m_cm", "suit: root off after 70 m (cm)", 0, "54 and 52", "HPS, Tables 1 and 2, row IMU"),
    ("off_after_200_m_cm", "suit: root off after 200 m (cm)", 0, "69 and 61", "the same"),
    ("off_after_380_m_cm", "suit: root off after 380 m (cm)", 0, "108 and 100", "the same"),
    ("length_percent", "suit: walked length (%)", 2, "well measured; feet alone: below 4 in 95 % of walks",
     "Guzov 2025 (dissertation), §5.3.1; Gupta, Skog and Händel 2015"),
    ("bone_percent", "suit: length of bones (%)", 1, "scaled from stature and few lengths, no figure",
     "Roetenberg, Luinge and Slycke 2009; size is ours"),
    ("stature_cm", "suit: stature (cm)", 1, "–", "ours"),
    ("segment_deg", "suit: orientation of segments without heading (°)", 1, "sensor alone: 0.5 static, 2 moving",
     "Xsens, MTi and MTx manual MT0100P; the rest is mounting and soft tissue"),
    ("joint_deg", "suit: joint angles, root mean square (°)", 1, "below 5 in flexion; without magnetometers hips 4 to 6, knees 8",
     "Schepers, Giuberti and Bellusci 2018 (Xsens MVN); McGrath and Stirling 2022"),
    ("height_cm", "suit: height of the root (cm)", 1, "–", "ours"),
    ("height_drift_cm", "suit: change of that height (cm)", 1, "–", "ours"),
    ("contact_late_ms", "suit: flags of foot contact, late by (ms)", 0, "–", "ours"),
    ("contact_wrong_percent", "suit: flags of foot contact, wrong (%)", 1, "–", "ours"),
    ("position_cm", "localisation: median error (cm)", 1, "1 to 5 in rooms", "Sarlin et al. 2021, 7-Scenes, row hloc"),
    ("rotation_deg", "localisation: median error (°)", 1, "0.8 to 1.5", "the same"),
    ("outlier_percent", "localisation: off by more than 30 cm (%)", 1, "18 to 19 by more than 1 m, the scene changed",
     "Sarlin et al. 2020, InLoc, SuperPoint and SuperGlue"),
    ("lost_percent", "localisation: frames without a pose (%)", 1, "“fails for a long period”", "HPS, on Table 2; size is ours"),
    ("longest_outage_s", "localisation: longest outage (s)", 0, "–", "ours"),
    ("tilt_deg", "map: lean against gravity (°)", 2, "–", "ours"),
    ("scale_percent", "map: scale (%)", 2, "–", "ours"),
    ("bend_cm", "map: bend, each axis (cm)", 1, "–", "ours"),
    ("noise_ug_per_sqrt_hz", "watch: noise of acceleration (µg/√Hz)", 0, "160, the sensor alone", "Bosch BMI270, data sheet"),
    ("gyro_deg_s_per_sqrt_hz", "watch: noise of the rate (°/s/√Hz)", 3, "0.007, the sensor alone", "the same"),
    ("bias_mg", "watch: bias of acceleration (mg)", 1, "20 before calibration", "the same"),
    ("attitude_deg", "watch: attitude (°)", 1, "1.5 static, 2.5 moving", "Hillcrest BNO080, data sheet, gaming rotation vector"),
    ("heading_after_10_min_deg", "watch: heading after 10 minutes (°)", 1, "5, without magnetometer", "the same (0.5° a minute)"),
    ("strap_deg", "watch: lean by its strap (°)", 1, "–", "ours"),
    ("jitter_mm", "head: jitter, each axis (mm)", 2, "–", "ours"),
    ("jitter_deg", "head: jitter, each axis (°)", 2, "–", "ours"),
    ("head_cm", "head: position, root mean square (cm)", 1, "4.7 and 5.1 with one camera", "MocapEvery, Table 5"),
    ("head_deg", "head: orientation, root mean square (°)", 1, "2.1 and 2.7 with one camera", "the same"),
    ("drift_percent", "head: drift of the travelled distance (%)", 3, "none where loops are closed; phones: 2 cm a second, not closed",
     "Project Aria, closed-loop trajectories; Kim et al. 2022"),
    ("clock_drift_ms_per_h", "camera: clock against the suit's (ms an hour)", 0, "87", "Guzov 2025 (dissertation), §4.3.4"),
    ("clock_offset_s", "camera: clock's offset at the start (s)", 1, "–", "ours"),
    ("claps_heard_percent", "claps heard in the sound track (%)", 0, "“detected in both modalities”", "Guzov 2025 (dissertation), §4.3.4"),
    ("claps_heard_false_per_min", "other sounds taken for claps (a minute)", 1, "–", "ours"),
    ("claps_heard_off_ms", "claps heard, off by (ms)", 1, "–", "ours"),
    ("claps_felt_percent", "claps felt by both wrists (%)", 0, "“detected in both modalities”", "Guzov 2025 (dissertation), §4.3.4"),
    ("placement_cm", "environment: objects, along the floor (cm)", 1, "–", "ours"),
    ("placement_deg", "environment: objects, about the vertical (°)", 1, "–", "ours"),
    ("hinge_cm", "environment: hinges (cm)", 1, "–", "ours"),
    ("holds_per_min", "hands: holds a minute", 1, "12", "Guzov 2025 (dissertation), §5.4.1: over 2300 in 680,000 frames, read as 60 Hz"),
    ("hold_s", "hands: median length of a hold (s)", 1, "–", "ours"),
    ("held_percent", "hands: time in which one holds (%)", 0, "–", "ours"),
    ("both_hands_percent", "hands: holds with both (%)", 0, "–", "ours"),
    ("reach_s", "hands: length of a reach (s)", 2, "–", "ours"),
    ("reach_peak_over_mean", "hands: peak over mean speed of a reach", 2, "1.88, minimum jerk", "Flash and Hogan 1985"),
)  # fmt: skip
"""Quantity, label with unit, digits, what is published, and where; "ours" is an assumption."""
KEY = (
    "heading_deg_per_sqrt_min",
    "off_after_380_m_cm",
    "length_percent",
    "bone_percent",
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
    for line in _sensor_lines(found, [name for name, *_ in LITERATURE]):
        table.add_row(*line)
    return table


PRESETS = ("ideal", "typical", "poor")


def _sensor_lines(found: Tree, names: Sequence[str]) -> list[list[str]]:
    """A line per measured quantity: by preset, what is published, and where."""
    return [
        [label, *(text(found.get(preset, {}).get(name), digits) for preset in PRESETS), published, source]
        for name, label, digits, published, source in LITERATURE
        if name in names and any(name in of for of in found.values())
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
        held_out="People and sites are those of the test split. The suit's heading was fitted to the IMU rows of the paper; "
        "nothing else was fitted to a result.",
        simulated="All of it. Each sensor is drawn many times on the same walks; ± is the deviation over draws, and figures "
        'without it are root mean squares over draws, or single. Sensors without presets stand below "typical".',
        limits=(
            'Where the source is "ours" the size is an assumption, because we know no published figure.',
            "Published errors of joints and localisation are from laboratories and benchmarks, not from long walks.",
            "A session's heading is one draw of a random walk: the distances after which the root is off spread widely.",
            "Nothing here says that errors are correlated with each other as in a real device.",
        ),
        full=[
            grid_of(table, tree.get("origins", {}).get(part, tree["about"]))
            for part in tree["tables"]
            for table in _shown({part: tree["tables"][part]})
        ],
        measured="",
    )


def _clips(root: str, quick: bool) -> list[Clip]:
    store = RecordingStore.open(root)
    names = [name for name in store.names() if store.entries[name].duration_s >= 2]
    names = names[:: max(1, len(names) // 60)] if quick else names
    return [clip_of(store.load(name)) for name in names]


def _halves(clips: list[Clip]) -> tuple[list[Clip], list[Clip]]:
    """Every other person: what a discriminator reaches where there is nothing to find."""
    people = sorted({clip.person for clip in clips})
    first = set(people[::2])
    return [c for c in clips if c.person in first], [c for c in clips if c.person not in first]


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


def _accuracy_table(accuracy: dict[str, dict]) -> Table:
    table = Table(title="Discriminator: accuracy on held-out people (50 % is chance)")
    for name in ("windows", "accuracy", "seeds", "held-out windows"):
        table.add_column(name, justify="left" if name == "windows" else "right")
    for which, found in accuracy.items():
        spread = f"{100 * found['mean']:.1f} ± {100 * found['std']:.1f} %"
        table.add_row(which, spread, str(len(found["accuracies"])), str(found["held_out_windows"]))
    return table
