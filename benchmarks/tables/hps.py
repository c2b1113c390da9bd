"""HPS on simulated sessions of more than 400 m: Tables 4.1 to 4.3 of the paper, drift, outages, time per stage.

Sessions, scans and the rig's clouds are kept in OUTPUT/hps/cache.
"""

import argparse
import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

from joblib import Parallel, delayed
from rich.console import Console
from rich.table import Table

from benchmarks.tables import result_pages as pages
from benchmarks.tables.hps_runs import DISTURBED, PRINTED, ROWS, TRUTH, SeedRun, run_seed
from benchmarks.tables.hps_sessions import SessionSettings
from benchmarks.tables.tabling import cell, new_table, summarize, write_tree
from wearsim.recordings.hps import HpsConfig, Protocol
from wearsim.recordings.localization_noise import LocalizationNoise
from wearsim.sensors.suit import SUITS, SuitNoise

PAPER = {
    "stand": {
        "IMU": (6.85, 54.49, 69.02, 108.44), "IMU + Cam": (9.24, 742.32, 136.81, 32.17),
        "IMU + Cam (filtered)": (10.48, 6.93, 5.93, 6.15), "HPS w/o scene": (7.21, 6.48, 5.80, 5.69),
        "HPS": (5.20, 4.60, 4.26, 4.53),
    },
    "move": {
        "IMU": (6.77, 51.57, 61.11, 100.44), "IMU + Cam": (2189.75, 569.71, 719.44, 261.72),
        "IMU + Cam (filtered)": (10.05, 21.75, 7.34, 12.59), "HPS w/o scene": (9.19, 20.68, 6.67, 11.96),
        "HPS": (6.44, 15.96, 4.76, 10.07),
    },
}  # fmt: skip
"""Thesis Tables 4.1 and 4.2 (cm)."""
PAPER_FEET = {
    "IMU": (188.38, 0.92),
    "IMU + Cam": (39.8, 52.09),
    "IMU + Cam (filtered)": (0.95, 1.75),
    "HPS w/o scene": (0.32, 2.00),
    "HPS": (0.056, 0.90),
}
"""Thesis Table 4.3: distance to surface (cm), foot sliding (cm per frame)."""
TITLES = {"stand": "Table 4.1: standing in an A-pose", "move": "Table 4.2: walking, standing, leaning"}
WIDTH = 150
"""Columns of the tables where the output is no terminal, or a narrow one."""
ORDERED = ("IMU", "IMU + Cam (filtered)", "HPS w/o scene")
"""Each must be worse than the next, and the last worse than HPS."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seeds", type=int, default=5, help="simulated sessions (1 when quick)")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--split", default="test", help="whose people and sites: train, val or test")
    parser.add_argument("--spacing", type=float, default=0.02, help="between points of the scan (m)")
    parser.add_argument(
        "--returns",
        type=float,
        nargs="+",
        default=list(Protocol.returns_m),
        help="distances (m) after which the wearer is back at the capture spot",
    )
    parser.add_argument("--end", type=float, default=Protocol.end_m, help="length of the session (m)")
    parser.add_argument("--sensors", choices=list(SUITS), default="typical", help="errors of suit and localisation")
    parser.add_argument(
        "--printed", type=int, default=0, help="sessions that the paper's own energy and solver capture, too"
    )
    parser.add_argument("--jobs", type=int, default=2, help="seeds at a time; a single one uses as many cores")


def tables(options: argparse.Namespace, about: dict[str, str]) -> Path:
    """Print and write all tables; returns the path of the JSON file."""
    count = 1 if options.quick else options.seeds
    name = "hps" if options.sensors == "typical" else f"hps_{options.sensors}"
    protocol = Protocol(returns_m=tuple(options.returns), end_m=options.end)
    suit, localization = SuitNoise.preset(options.sensors), LocalizationNoise.preset(options.sensors)
    config = HpsConfig(protocol=protocol, suit=suit, localization=localization)
    settings = SessionSettings(options.split, config, options.spacing)
    jobs = min(options.jobs, count)
    first = options.first_seed
    cache, solver_jobs = options.output / name / "cache", options.jobs // jobs
    rows = [ROWS | PRINTED if k < options.printed else ROWS for k in range(count)]
    seeds = [SeedRun(settings, first + k, cache, solver_jobs, rows[k]) for k in range(count)]
    runs = [run for run in Parallel(n_jobs=jobs)(delayed(run_seed)(seed) for seed in seeds) if run]
    places = ["at start", *(f"{distance:.0f} m" for distance in options.returns)]
    tree: dict[str, Any] = {"about": about, "sensors": options.sensors, "places": places, **summarized(runs)}
    show = Console(width=max(Console().width, WIDTH), highlight=False).print
    for table in _all_tables(tree):
        show(table)
    show(_order_line(tree["order_beyond_start"]))
    tree["seeds"] = runs
    path = options.output / f"{name}.json"
    return write_tree(path, tree)


def _all_tables(tree: dict[str, Any]) -> list[Table]:
    chamfer = [_chamfer_table(name, tree["places"], tree["chamfer_cm"][name]) for name in ("stand", "move")]
    return [
        *chamfer,
        _feet_table(tree),
        _drift_table(tree),
        _whole_table(tree),
        _outage_table(tree),
        *([_seconds_table(tree)] if tree["stage_seconds"] else []),
    ]


HEADLINE = (
    ("hps", "IMU", "IMU alone"),
    ("hps", "IMU + Cam (filtered)", "IMU and camera, filtered"),
    ("hps", "HPS as printed", "HPS as printed, typical sensors"),
    ("hps_ideal", "HPS", "HPS, authors' code, ideal sensors"),
    ("hps", "HPS", "HPS, authors' code, typical sensors"),
    ("hps_poor", "HPS", "HPS, authors' code, poor sensors"),
    ("hps_ideal", "ours", "**ours**, ideal sensors"),
    ("hps", "ours", "**ours**, typical sensors"),
    ("hps_poor", "ours", "**ours**, poor sensors"),
)
"""Rows of the page's first table: file, row, and what the page calls it."""


def page(trees: pages.Trees, speed: dict[str, list[pages.Tree]]) -> pages.Page:
    """What docs/results/hps.md says."""
    typical = trees["hps"]
    whole = {row: [tree["whole"][row]["mpjpe_cm"] for tree in trees.values()] for row in ("IMU", "HPS", "ours")}
    end = typical["places"][-1]
    columns = ("joints", "95 % below", f"standing, {end}", f"moving, {end}", "feet to scan", "sliding a frame")
    return pages.Page(
        title="[HPS](../hps.md): figures",
        headline=pages.Grid(
            f"Joints over whole sessions, where they stand in the world, and the Chamfer distance to depth cameras' clouds after {end}; means over "
            "sessions, ± their deviation (cm); jitter as a multiple of the truth's.",
            ("", *columns, "jitter"),
            [
                [label, *_headline(trees[name], row)]
                for name, row, label in HEADLINE
                if name in trees and row in trees[name]["whole"]
            ]
            + [_paper_headline()],
        ),
        held_out="People and sites are those of the test split; weights of the terms were chosen on sessions of the "
        "validation split. Ours is `pipeline=hps` with its own settings.",
        simulated="All of it: sessions, sites, scans, suits, localisation, claps in the sound track, and the rig of "
        "three depth cameras at the capture spot. The sizes of the sensors' errors (`--sensors ideal`, `typical`, "
        "`poor`) are measured beside the literature's in [simulation](simulation.md). Localisation is drawn from "
        "statistics; finding real photographs in a map is a test of its own (`make test-real`). The paper's row "
        "is from its own recordings: no comparison, but for the order of its rows.",
        limits=_limits(typical),
        full=[grid for tree in trees.values() for grid in _grids(tree)],
        commands=pages.commands(trees),
        measured=f"joints {pages.ranged(whole['ours'])} cm off over {end} and more, {_presets(trees)} (the authors' code "
        f"{pages.ranged(whole['HPS'])}; suit alone: {pages.ranged(whole['IMU'], 0)})",
        speed=_speed(typical, speed),
        clocks=CLOCKS,
    )


def _speed(tree: pages.Tree, speed: dict[str, list[pages.Tree]]) -> str:
    """README's cell."""
    seconds = sum(stage["mean"] for stage in tree["stage_seconds"].get("ours", {}).values())
    if not seconds:
        return ""
    figures = pages.figures_of(speed, "hps_end_to_end_realtime")
    values = pages.ranged({"mean": figure["value"]} for figure in figures)
    whole = f", {values} × with localisation" if figures else ""
    given = f"{tree['frames']['mean'] / 30 / seconds:.0f} × real time, localised cameras given"
    return f"{given}{whole} ({pages.machines([tree['about'], *figures])})"


CLOCKS = {
    "hps_end_to_end_realtime": "All of it, from suit and video to motion, localisation included, map given, beside localising each frame "
    "anew",
    "hps_frames_per_second": "The optimisation alone, map, body and start given, beside real time",
    "hps_solver_vs_best_adam": "The optimisation of 60 s to an energy that Adam reaches at its best, beside that",
    "localization_frames_per_second": "Localisation of a video, decoding and map given, beside pairwise matching",
    "splat_mpoints_per_second": "Points of a scan drawn into a point map, beside NumPy",
    "hps_online_recovery": "No clock: the error of a stream's root from the third second on after 30 s without localisation, beside "
    "that before them",
}
"""Benchmarks: what is measured, what is given, and what it is held against."""


def _presets(trees: pages.Trees) -> str:
    names = [name for name in SUITS if name in {tree["sensors"] for tree in trees.values()}]
    return f"with {names[0]} sensors" if len(names) == 1 else f"with {names[0]} to {names[-1]} sensors"


def _grids(tree: pages.Tree) -> list[pages.Grid]:
    """All tables of a preset."""
    sessions = tree["whole"]["ours"]["mpjpe_cm"]["seeds"]
    spread = f"{sessions} sessions" if sessions > 1 else "one session"
    grids = [pages.grid_of(table, tree["about"], spread) for table in _all_tables(tree)]
    return [replace(grid, title=f"{tree['sensors']} sensors: {grid.title}") for grid in grids]


def _headline(tree: pages.Tree, row: str) -> list[str]:
    whole, feet = tree["whole"][row], tree["feet"][row]
    places = (tree["chamfer_cm"][name][row][-1] for name in ("stand", "move"))
    cells = [pages.text(whole["mpjpe_cm"], 1), pages.mean(whole["p95_cm"]), *(pages.text(place, 1) for place in places)]
    return [
        *cells,
        *(pages.mean(feet[name], 2) for name in ("absolute_distance_cm", "sliding_cm")),
        pages.mean(whole["jitter_ratio"]),
    ]


def _paper_headline() -> list[str]:
    feet = [f"{value:g}" for value in PAPER_FEET["HPS"]]
    after = [f"{PAPER[name]['HPS'][-1]:.1f}" for name in ("stand", "move")]
    return ["the paper's HPS, on its own recordings", pages.NONE, pages.NONE, *after, *feet, pages.NONE]


def _limits(tree: pages.Tree) -> tuple[str, ...]:
    """The weak sides, with their figures."""
    lost = [
        f"for {where.removeprefix('within ')} the root is {pages.mean(part['root_cm'])} cm off meanwhile, "
        f"{pages.mean(part['root_ratio'])} times as far as without (the authors' code "
        f"{pages.mean(tree['outages']['HPS'][where]['root_cm'], 0)} cm)"
        for where, part in tree["outages"]["ours"].items()
        if where.startswith("within")
    ]
    order = [sum(held) for held in tree["order_beyond_start"]["HPS"].values()]
    count = len(tree["order_beyond_start"]["HPS"]["stand"])
    least = " and ".join(pages.mean(tree["chamfer_cm"][name][TRUTH][-1]) for name in TITLES)
    return (
        f"When localisation is lost in mid-walk {'; '.join(lost)}.",
        "A session's heading is one draw of a random walk: the IMU row spreads widely over few sessions.",
        f"The clouds of depth cameras are noisy: the truth itself is {least} cm from them, standing and moving.",
        f"The published rows are in the paper's order beyond the start in {order[0]} of {count} sessions standing, in "
        f"{order[1]} moving.",
        "The authors' code holds the root's position and takes the suit's steps in place of the paper's E_T (eq. 4.9): "
        "rows of that name have its energy and our solver; the row as printed has eq. 4.1 to 4.12 and Adam over windows "
        "(`--printed 1`).",
        "No recording of a real suit has been measured: there is none that one may share.",
    )


def summarized(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Means and spreads over seeds of all that the tables show."""
    rows = tuple(row for row in (*PRINTED, *ROWS, TRUTH) if any(row in run["scores"] for run in runs))
    captured = rows[:-1]
    return {
        "chamfer_cm": _chamfer(runs, rows, "literal", "mean_cm"),
        "chamfer_surface_cm": _chamfer(runs, rows, "surface", "mean_cm"),
        "cloud_to_body_cm": _chamfer(runs, rows, "literal", "cloud_to_body_cm"),
        "feet": _over_seeds(runs, rows, "feet"),
        "feet_true_contact": _over_seeds(runs, rows, "feet_true_contact"),
        "whole": _over_seeds(runs, rows, "joints"),
        "slope_cm_per_100m": {
            row: summarize([run["scores"][row]["drift"]["slope_cm_per_100m"] for run in _with(runs, row)])
            for row in captured
        },
        "standing_slope_cm_per_100m": {
            row: summarize([_standing_slope(run, row) for run in _with(runs, row)]) for row in captured
        },
        "order_beyond_start": {
            best: {name: [_ordered(run, name, best) for run in runs] for name in TITLES} for best in ("HPS", "ours")
        },
        "outages": {row: _outages(runs, row) for row in DISTURBED},
        "stage_seconds": {
            row: {
                stage: summarize([run["stage_seconds"][row][stage] for run in _with(runs, row)])
                for stage in _with(runs, row)[0]["stage_seconds"][row]
            }
            for row in captured
        },
        "frames": summarize([float(run["frames"]) for run in runs]),
    }


def _with(runs: list[dict[str, Any]], row: str) -> list[dict[str, Any]]:
    """Runs that scored a row."""
    return [run for run in runs if row in run["scores"]]


def _of_visits(run: dict[str, Any], row: str, name: str, form: str, key: str) -> list[float]:
    """A row's scores at the visits of a kind, in order."""
    parts = zip(run["visits"], run["scores"][row][form])
    return [part[key] for visit, part in parts if visit["name"] == name]


def _chamfer(runs: list[dict[str, Any]], rows: tuple[str, ...], form: str, key: str) -> dict[str, Any]:
    """Summaries by kind of visit, row and place."""
    return {
        name: {
            row: [
                summarize(list(values))
                for values in zip(*(_of_visits(run, row, name, form, key) for run in _with(runs, row)))
            ]
            for row in rows
        }
        for name in TITLES
    }


def _standing_slope(run: dict[str, Any], row: str) -> float:
    """Of the documented Chamfer distance over the visits' distances: least squares, cm per 100 m."""
    distance = [visit["distance_m"] for visit in run["visits"] if visit["name"] == "stand"]
    error = _of_visits(run, row, "stand", "literal", "mean_cm")
    x, y = sum(distance) / len(distance), sum(error) / len(error)
    spread = sum((d - x) ** 2 for d in distance)
    return 100 * sum((d - x) * (e - y) for d, e in zip(distance, error)) / spread if spread else math.nan


def _ordered(run: dict[str, Any], name: str, best: str) -> bool:
    """Whether IMU > filtered > w/o scene > `best`, by the mean over the visits after the start."""
    later = [_of_visits(run, row, name, "literal", "mean_cm")[1:] for row in (*ORDERED, best)]
    means = [sum(values) / len(values) for values in later]
    return all(before > after for before, after in pairwise(means))


def _over_seeds(runs: list[dict[str, Any]], rows: tuple[str, ...], part: str) -> dict[str, Any]:
    return {
        row: {
            name: summarize([run["scores"][row][part][name] for run in _with(runs, row)])
            for name in _with(runs, row)[0]["scores"][row][part]
        }
        for row in rows
    }


def _outages(runs: list[dict[str, Any]], row: str) -> dict[str, Any]:
    parts = [run["outages"]["rows"][row] for run in runs]
    return {
        where: {name: summarize([part[where][name] for part in parts]) for name in parts[0][where]}
        for where in parts[0]
        if all(where in part for part in parts)
    }


def _chamfer_table(name: str, places: list[str], entries: dict[str, Any]) -> Table:
    title = f"{TITLES[name]}: bidirectional Chamfer (cm), in brackets the paper's"
    table = new_table(title, ["", *places])
    for row, summaries in entries.items():
        known = PAPER[name].get(row, ())
        beside = [f"  [{value:.2f}]" for value in known] if len(known) == len(summaries) else []
        beside += [""] * (len(summaries) - len(beside))
        table.add_row(row, *(cell(summary) + value for summary, value in zip(summaries, beside)))
    return table


def _feet_table(tree: dict[str, Any]) -> Table:
    table = new_table(
        "Table 4.3: feet in contact (cm; sliding per frame), in brackets the paper's",
        ["", "to surface, signed", "absolute", "sliding", "absolute, true contact", "sliding, true contact"],
    )
    for row, feet in tree["feet"].items():
        known, true = PAPER_FEET.get(row), tree["feet_true_contact"][row]
        beside = [f"  [{value:g}]" for value in known] if known else ["", ""]
        table.add_row(
            row,
            cell(feet["distance_cm"], 3) + beside[0],
            cell(feet["absolute_distance_cm"], 3),
            cell(feet["sliding_cm"], 3) + beside[1],
            cell(true["absolute_distance_cm"], 3),
            cell(true["sliding_cm"], 3),
        )
    return table


def _drift_table(tree: dict[str, Any]) -> Table:
    table = new_table("Growth with distance (cm per 100 m)", ["", "root error, bins of 20 m", "standing Chamfer"])
    for row in ROWS:
        table.add_row(row, cell(tree["slope_cm_per_100m"][row], 3), cell(tree["standing_slope_cm_per_100m"][row], 3))
    return table


def _whole_table(tree: dict[str, Any]) -> Table:
    columns = ["mpjpe_cm", "root_cm", "p95_cm", "jitter_m_s3", "jitter_ratio", "foot_skate_cm_s"]
    table = new_table("Whole recording, joints in the world", ["", *columns])
    for row, scores in tree["whole"].items():
        table.add_row(row, *(cell(scores[column]) for column in columns))
    return table


def _outage_table(tree: dict[str, Any]) -> Table:
    table = new_table(
        "Outages of localisation, planted in mid-walk: error (cm) and its ratio to that of the same frames without",
        ["", "frames", "root", "ratio", "joints", "ratio"],
    )
    for row, parts in tree["outages"].items():
        for where, scores in parts.items():
            table.add_row(
                row, where, *(cell(scores[name]) for name in ("root_cm", "root_ratio", "joint_cm", "joint_ratio"))
            )
    return table


def _seconds_table(tree: dict[str, Any]) -> Table:
    stages = list(dict.fromkeys(stage for row in ROWS for stage in tree["stage_seconds"][row]))
    table = new_table(
        f"Seconds per stage, of {tree['frames']['mean']:.0f} frames on average", ["", *stages, "frames/s"]
    )
    for row, seconds in tree["stage_seconds"].items():
        total = sum(summary["mean"] for summary in seconds.values())
        table.add_row(
            row,
            *(cell(seconds[stage], 1) if stage in seconds else "" for stage in stages),
            f"{tree['frames']['mean'] / max(total, 1e-9):.0f}",
        )
    return table


def _order_line(order: dict[str, dict[str, list[bool]]]) -> str:
    parts = [
        f"{' > '.join((*ORDERED, best))}, {name}: {sum(held)} of {len(held)} seeds"
        for best, kinds in order.items()
        for name, held in kinds.items()
    ]
    return "Order beyond the start (mean over visits):\n  " + "\n  ".join(parts)
