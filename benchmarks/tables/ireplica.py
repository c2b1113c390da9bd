"""iReplica on simulated recordings of held-out people and objects: Tables 5.1 to 5.5 of the paper, and robustness.

HPS with noisy localisation registers the wearer; every row below captures the same motion. Recordings of the split are
dealt out to `--seeds` groups: means are over groups, ± their deviation. Without checkpoints, the networks are those in
checkpoints/. Of a data set datasets/simulated_interactions_NAME, as with NAME's sensors, the file is ireplica_NAME.json;
the page takes ideal, typical and poor.
"""

import argparse
import math
import sys
from pathlib import Path
from typing import Any

import torch
from joblib import Parallel, delayed
from rich.console import Console
from rich.table import Table

from benchmarks.tables import result_pages as pages
from benchmarks.tables.ireplica_runs import DISTURBANCES, GAPS_S, Networks, RecordingRun, run_recording
from benchmarks.tables.tabling import cell, new_table, summarize, write_tree
from wearcap.errors import WearcapError
from wearcap.metrics.detection import mean_detection_scores
from wearcap.recording import RecordingStore
from wearcap.scene.objects import CONTACT_CLASSES

PAPER_END = {
    "HPS": (60.81, 46.89),
    "as published": (6.88, 7.13),
    "as published, contacts of a simulated detector": (38.58, 28.41),
    "as published, w/o contact corr.": (11.68, 10.28),
}
"""Thesis Table 5.1, column All: cm and degrees; for detections those of HOD (VISOR's: 39.59 and 27.27)."""
PAPER_HAND = {
    "HPS": 33.61,
    "HPS w/ GT": 10.44,
    "as published": 2.93,
    "as published, contacts of a simulated detector": 31.26,
    "as published, w/o contact corr.": 11.37,
}
"""Thesis Table 5.2, column All (cm); for detections those of HOD (VISOR's: 31.17)."""
PAPER_DETECTION = {
    "the paper's, on H-contact": (0.807, 0.786, 0.880, 0.905),
    "the paper's POSA": (0.033, 0.115, 0.716, 0.297),
    "the paper's HOD": (0.044, 0.251, 0.818, 0.364),
    "the paper's VISOR": (0.217, 0.313, 0.098, 0.732),
}
"""Thesis Table 5.3: AP, precision, recall, accuracy at 0.5."""
PAPER_GAPS = (13.61, 8.49, 7.13, 8.86, 8.86)
"""Thesis Table 5.4 (cm)."""
PAPER_CHAMFER = {"HPS": (9.771, 22.651), "as published": (8.981, 8.471)}
"""Thesis Table 5.5: body and object (cm)."""
KINDS = {
    "door": ("door", "window", "cabinet_door"),
    "drawer": ("drawer",),
    "sofa": ("sofa", "armchair"),
    "table": ("table", "coffee_table"),
    "chair": ("chair",),
    "box": ("box",),
}
"""Columns of the tables, and the categories that they gather."""
WIDTH = 170
DATASET = "simulated_interactions"
PRESETS = ("ideal", "typical", "poor")
"""Sensors of data sets DATASET_PRESET, whose rows the page shows beside the others."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--dataset",
        type=Path,
        default=Path("datasets") / DATASET,
        help="made by `wearcap prepare simulated_interactions preset=standard`",
    )
    parser.add_argument("--split", default="test", help="whose people and objects: train, val or test")
    parser.add_argument("--seeds", type=int, default=5, help="groups of recordings (2 when quick)")
    parser.add_argument("--ours", nargs="+", default=["contact_sequence"], help="checkpoint(s) of our contact network")
    parser.add_argument(
        "--published",
        nargs="+",
        default=[f"contact_transformer_{name}" for name in CONTACT_CLASSES],
        help="checkpoints of the published networks, one per class",
    )
    parser.add_argument("--rows", nargs="+", default=[], metavar="ROW", help="these rows alone, 'ours' among them")
    parser.add_argument("--no-robustness", action="store_true", help="leave out the runs with worse sensors")
    parser.add_argument("--jobs", type=int, default=2, help="recordings at a time")


def tables(options: argparse.Namespace, about: dict[str, str]) -> Path:
    """Print and write the tables; returns the file."""
    preset = options.dataset.name.removeprefix(f"{DATASET}_")
    sensors = f" suit={preset} camera_errors={preset}" if preset in PRESETS else ""
    if not (options.dataset / "manifest.json").is_file():
        raise WearcapError(
            "no such data set",
            where=options.dataset,
            fix=f"Run: wearcap prepare simulated_interactions preset=standard{sensors} output={options.dataset}",
        )
    names = RecordingStore.open(options.dataset).names(options.split)
    seeds = min(2 if options.quick else options.seeds, len(names))
    names = names[:seeds] if options.quick else names
    networks = Networks(tuple(options.ours), tuple(options.published))
    # worse sensors once per group: HPS is run again for each
    runs = [
        RecordingRun(
            options.dataset,
            name,
            networks,
            index < seeds and not (options.no_robustness or options.quick),
            tuple(dict.fromkeys(["ours", *options.rows])) if options.rows else (),
        )
        for index, name in enumerate(names)
    ]
    found = Parallel(n_jobs=options.jobs)(delayed(_run_printed)(run) for run in runs)
    groups: list[list[Any]] = [list(found[k::seeds]) for k in range(seeds)]
    tree = {"about": about | {"dataset": str(options.dataset), "split": options.split, "recordings": names}} | _tree(
        groups
    )
    _show(tree)
    path = options.output / (f"ireplica_{preset}.json" if sensors else "ireplica.json")
    return write_tree(path, tree)


HEADLINE = {
    "HPS": "HPS, objects static",
    "nearest object by distance": "nearest object by distance, no network",
    "as published": "as published",
    "as published, our contacts": "the paper's tracker and path, our contacts",
    "ours": "**ours**",
    "ours, contacts of a simulated detector": "ours, contacts of a simulated detector",
    "ours, published networks": "ours, contacts by the published networks",
}
"""Rows of the page's first table, and what the page calls them."""
CONTACTS = {
    "nearest object by distance": "nearest object by distance",
    "as published": "published",
    "ours": "ours",
    "ours, contacts of a simulated detector": "detections",
}
"""Contact detectors by row."""
CLOCKS = {
    "ireplica_realtime_factor": "All but the localisation, suit and localised cameras given, beside real time",
    "contact_seconds_per_minute": "A minute's contacts from its poses, features included, beside real time",
    "contact_sequence_vs_window": "The same, beside a window per frame",
    "trajectory_bending_vs_adam": "Bending a path to camera positions, to an equal energy, beside Adam",
}
"""Benchmarks: what is measured, what is given, and what it is held against."""


def page(trees: pages.Trees, speed: dict[str, list[pages.Tree]]) -> pages.Page:
    """What docs/results/ireplica.md says."""
    tree = trees["ireplica"]
    rows, about = tree["rows"], tree["about"]
    groups = rows["ours"]["all"]["end_cm"]["seeds"]
    shown = [_ends(tree), _hands(tree), _detections(tree), _gaps(tree), _chamfer(tree)]
    shown += [_robustness(tree)] if tree["robustness"] else []
    spread = f"{groups} groups of {len(about['recordings'])} recordings"
    theirs, both = (pages.mean(rows[name]["all"]["end_cm"]) for name in ("as published", "as published, our contacts"))
    factor = pages.figures_of(speed, "ireplica_realtime_factor")
    beside = {name: trees[f"ireplica_{name}"] for name in PRESETS if f"ireplica_{name}" in trees}
    return pages.Page(
        title="[iReplica](../ireplica.md): figures",
        headline=pages.Grid(
            "Where objects were left, and hands and objects against their own true places during contact: "
            f"{tree['handlings']} handlings, means over {spread}, ± the deviation over groups; AP of the contacts "
            "that drive the row.",
            (
                "",
                "object's end (cm)",
                "end (°)",
                "hand to object (cm)",
                "hand off (cm)",
                "object off (cm)",
                "contacts' AP",
            ),
            _headline_rows(tree, beside),
        ),
        held_out="People, flats and objects are those of the test split; networks were trained on the training "
        "split, and all settings were chosen on the validation split.",
        simulated="All of it: people, flats, objects, suits and localisation (`typical`), and environments as people "
        "measure them, with objects and hinges away from their true places; sizes beside the literature's in "
        "[simulation](simulation.md). Camera and suit share one clock, but in rows that say so. Contacts of a detector are those of a "
        "simulated one, which errs as often as Hand Object Detector does by its own record: no picture was looked at. Every row captures the same motion.",
        limits=_limits(tree),
        full=[pages.grid_of(table, about, spread) for table in shown]
        + [
            pages.grid_of(each, other["about"], spread)
            for name, other in beside.items()
            for each in _beside(name, other)
        ],
        commands=pages.commands(trees),
        measured=f"objects end {pages.mean(rows['ours']['all']['end_cm'])} cm off{_from_ideal_to_poor(beside)}, in environments measured by hand (the "
        f"paper's tracker with our contacts {both}; as published {theirs})",
        speed=f"{pages.times(factor)} real time, localised cameras given ({pages.machines(factor)})" if factor else "",
        clocks=CLOCKS,
        pictures=tuple(
            (f"ireplica_{name}.png", f"{what}: truth above and captured below, hands in contact green")
            for name, what in (
                ("door", "A door that an earlier mistake left at another angle, and that rests in the hand"),
                ("sofa", "A sofa, pushed with both hands"),
                ("table", "A table"),
            )
        ),
    )


def _from_ideal_to_poor(beside: pages.Trees) -> str:
    """Where objects end by what sensors measured."""
    ends = [pages.mean(beside[name]["rows"]["ours"]["all"]["end_cm"]) for name in ("ideal", "poor") if name in beside]
    return f" ({' to '.join(ends)} by sensors from ideal to poor)" if len(ends) == 2 else ""


def _beside(name: str, tree: pages.Tree) -> list[Table]:
    """The tables of a data set with one preset's sensors; the rows of typical ones are the page's other tables."""
    shown = [] if name == "typical" else [_ends(tree), _hands(tree)]
    shown += [_robustness(tree)] if tree["robustness"] else []
    for table in shown:
        table.title = f"{name} sensors, {table.title}"
    return shown


def _headline_rows(tree: pages.Tree, beside: pages.Trees) -> list[list[str]]:
    """Rows of the page's first table: of typical sensors, ours with others, and the paper's."""
    rows = [[label, *_headline(tree, row)] for row, label in HEADLINE.items() if row in tree["rows"]]
    others = {name: other for name, other in beside.items() if name != "typical"}
    rows += [[f"**ours**, {name} sensors", *_headline(other, "ours")] for name, other in others.items()]
    paper = [f"{value:.1f}" for value in (*PAPER_END["as published"], PAPER_HAND["as published"])]
    known = PAPER_DETECTION["the paper's, on H-contact"][0]
    return [*rows, ["the paper's, on its own recordings", *paper, pages.NONE, pages.NONE, f"{known:.3f}"]]


def _headline(tree: pages.Tree, row: str) -> list[str]:
    found, detector = tree["rows"][row]["all"], tree["detection"].get(CONTACTS.get(row))
    precision = detector["detection"]["average_precision"] if detector else None
    names = ("end_cm", "end_deg", "hand_object_cm", "hand_cm", "object_cm")
    return [*(pages.text(found[name], 1) for name in names), pages.text(precision, 3)]


def _limits(tree: pages.Tree) -> tuple[str, ...]:
    """The weak sides, with their figures."""
    rows = tree["rows"]
    kinds = rows["ours"]["kinds"]
    worst = max(KINDS, key=lambda kind: kinds[kind]["end_cm"]["mean"] or 0.0)
    ends = {row: pages.mean(found["all"]["end_cm"]) for row, found in rows.items()}
    return (
        f"The worst kind of object is the {worst}: its ends are {pages.mean(kinds[worst]['end_cm'])} cm off.",
        f"Two steps win nothing here: ends are {ends['ours']} cm off, without the contact correction "
        f"{ends['ours, w/o contact corr.']}, without the fit about hinges {ends['ours, no fit about hinges']}.",
        f"Contacts decide: with true ones ends are {ends['ours, true contacts']} cm off, with those of the simulated detector "
        f"{ends['ours, contacts of a simulated detector']}.",
        "One missed contact counts in every later handling of a piece of furniture, which is out of the hand's reach then. Doors, "
        "windows and drawers are found again where they are touched; without that, ends are "
        f"{ends['ours, objects not found again']} cm off.",
        "The trackers alone are compared by the row “the paper's tracker and path, our contacts”.",
        "The test split was scored twice: with the new contact networks, and again after thresholds had been chosen anew on the "
        "validation split.",
    )


def _run_printed(run: RecordingRun) -> dict[str, Any]:
    found = run_recording(run)
    rows = found["rows"]["ours"]["handlings"]
    ends = sum(row["end_cm"] for row in rows) / max(len(rows), 1)
    print(f"{run.name}: {len(rows)} handlings, ours ends {ends:.1f} cm off", file=sys.stderr, flush=True)
    return found


def _tree(groups: list[list[dict[str, Any]]]) -> dict[str, Any]:
    """All figures, over groups."""
    runs = [run for group in groups for run in group]
    rows, detectors = (
        [name for name in runs[0][part] if all(name in run[part] for run in runs)] for part in ("rows", "detection")
    )
    gaps = {str(gap): [[run["gaps"][str(gap)] for run in group] for group in groups] for gap in GAPS_S}
    disturbed = [[run["robustness"] for run in group if "robustness" in run] for group in groups]
    return {
        "handlings": sum(len(run["rows"]["ours"]["handlings"]) for group in groups for run in group),
        "rows": {row: _row([[run["rows"][row] for run in group] for group in groups]) for row in rows},
        "gaps": {gap: _measure(parts, "end_cm", None) for gap, parts in gaps.items()},
        "detection": {
            name: _detection([[run["detection"][name] for run in group] for group in groups]) for name in detectors
        },
        "robustness": {
            name: _row([[run[name] for run in group] for group in disturbed])
            | _detection([[run[name]["detection"] for run in group] for group in disturbed])
            for name in DISTURBANCES
        }
        if any(disturbed)
        else {},
    }


def _row(groups: list[list[dict[str, Any]]]) -> dict[str, Any]:
    """One row's measures: over all handlings, by kind of object, and of whole recordings."""
    kinds = {
        kind: {name: _measure(groups, name, categories) for name in ("end_cm", "end_deg", "hand_object_cm")}
        for kind, categories in KINDS.items()
    }
    whole = ("mpjpe_cm", "body_chamfer_cm", "object_chamfer_cm", "false_moves_cm")
    measures = ("end_cm", "end_deg", "hand_object_cm", "hand_cm", "object_cm", "object_deg", "moved_cm")
    return {
        "all": {name: _measure(groups, name, None) for name in measures},
        "median": {name: _measure(groups, name, None, middle=True) for name in ("end_cm", "end_deg")},
        "kinds": kinds,
        "whole": {name: summarize([_mean([run[name] for run in group]) for group in groups]) for name in whole},
    }


def _measure(
    groups: list[list[dict[str, Any]]], name: str, categories: tuple[str, ...] | None, middle: bool = False
) -> dict[str, Any]:
    """Mean (or median) over the handlings of each group, summarised over groups."""
    values = [
        [row[name] for run in group for row in run["handlings"] if categories is None or row["category"] in categories]
        for group in groups
    ]
    return summarize([_median(group) if middle else _mean(group) for group in values])


def _mean(values: list[float]) -> float:
    known = [value for value in values if math.isfinite(value)]
    return sum(known) / len(known) if known else math.nan


def _median(values: list[float]) -> float:
    return float(torch.tensor(values).median()) if values else math.nan


def _detection(groups: list[list[dict[str, Any]]]) -> dict[str, Any]:
    """Scores over each group's frames, mean over hands and classes, and per class (thesis Table 5.3)."""
    by_class: dict[str, list[tuple[float, ...]]] = {name: [] for name in CONTACT_CLASSES}
    for group in groups:
        for name in CONTACT_CLASSES:
            prob = torch.tensor([p for run in group for p in run[name]["prob"]]).unflatten(0, (-1, 2))
            true = torch.tensor([t for run in group for t in run[name]["true"]]).unflatten(0, (-1, 2))
            by_class[name].append(tuple(mean_detection_scores(prob, true > 0)))
    columns = ("average_precision", "precision", "recall", "accuracy", "calibration_error")
    both = [[_mean([a, b]) for a, b in zip(*rows)] for rows in zip(*by_class.values())]
    return {
        "detection": {name: summarize([row[k] for row in both]) for k, name in enumerate(columns)},
        "by_class": {
            kind: {name: summarize([row[k] for row in rows]) for k, name in enumerate(columns)}
            for kind, rows in by_class.items()
        },
    }


def _show(tree: dict[str, Any]) -> None:
    console = Console()
    if not console.is_terminal or console.width < WIDTH:
        console = Console(width=WIDTH)
    parts = (_ends(tree), _hands(tree), _detections(tree), _gaps(tree), _chamfer(tree))
    for part in (*parts, *([_robustness(tree)] if tree["robustness"] else [])):
        console.print(part)
    console.print(f"{tree['handlings']} handlings in {len(tree['about']['recordings'])} recordings")


def _ends(tree: dict[str, Any]) -> Table:
    shown = new_table(
        "Table 5.1: objects where they were left, cm / degrees; in brackets the paper's, on its recordings",
        ["", *KINDS, "all", "median"],
    )
    for row, found in tree["rows"].items():
        known = PAPER_END.get(row)
        beside = f"  [{known[0]:.1f} / {known[1]:.1f}]" if known else ""
        cells = [_two(found["kinds"][kind]) for kind in KINDS]
        shown.add_row(row, *cells, _two(found["all"], spread=True) + beside, _two(found["median"]))
    return shown


def _two(found: dict[str, Any], spread: bool = False) -> str:
    parts = (found["end_cm"], found["end_deg"])
    return " / ".join(cell(part if spread else part | {"std": None}, 1) for part in parts)


def _hands(tree: dict[str, Any]) -> Table:
    columns = {
        "hand_object_cm": "hand to object",
        "hand_cm": "hand, to its true place",
        "object_cm": "object, to its true place",
        "object_deg": "degrees",
    }
    shown = new_table(
        "Table 5.2: during true contact (cm); in brackets the paper's",
        ["", *columns.values(), "body (MPJPE)", "untouched moved"],
    )
    for row, found in tree["rows"].items():
        known = PAPER_HAND.get(row)
        cells = [cell(found["all"][name], 1) for name in columns]
        cells[0] += f"  [{known:.1f}]" if known else ""
        shown.add_row(row, *cells, cell(found["whole"]["mpjpe_cm"], 1), cell(found["whole"]["false_moves_cm"], 1))
    return shown


def _detections(tree: dict[str, Any]) -> Table:
    columns = ("average_precision", "precision", "recall", "accuracy", "calibration_error")
    shown = new_table("Table 5.3: contact, mean over hands and classes; per class in the rows below", ["", *columns])
    for name, found in tree["detection"].items():
        shown.add_row(name, *(cell(found["detection"][column], 3) for column in columns))
        for kind, scores in found["by_class"].items():
            shown.add_row(f"  {kind}", *(cell(scores[column], 3) for column in columns))
    for name, known in PAPER_DETECTION.items():
        shown.add_row(name, *(f"{value:.3f}" for value in known), "")
    return shown


def _gaps(tree: dict[str, Any]) -> Table:
    shown = new_table("Table 5.4: gaps filled (s) and where objects end (cm)", ["", *tree["gaps"]])
    shown.add_row("ours", *(cell(found, 1) for found in tree["gaps"].values()))
    shown.add_row("the paper's", *(f"{value:.2f}" for value in PAPER_GAPS))
    return shown


def _chamfer(tree: dict[str, Any]) -> Table:
    shown = new_table(
        "Table 5.5: Chamfer to the true surfaces during interactions (cm); in brackets the paper's, to depth cameras' clouds",
        ["", "body", "object"],
    )
    for row, found in tree["rows"].items():
        cells = [cell(found["whole"][name], 1) for name in ("body_chamfer_cm", "object_chamfer_cm")]
        beside = [f"  [{value:.1f}]" for value in PAPER_CHAMFER.get(row, ())] or ["", ""]
        shown.add_row(row, *(value + known for value, known in zip(cells, beside)))
    return shown


def _robustness(tree: dict[str, Any]) -> Table:
    shown = new_table(
        "Worse sensors: ours, one recording per group", ["", "AP", "end cm / degrees", "hand cm", "object cm"]
    )
    for name, found in tree["robustness"].items():
        shown.add_row(
            name,
            cell(found["detection"]["average_precision"], 3),
            _two(found["all"], spread=True),
            cell(found["all"]["hand_cm"], 1),
            cell(found["all"]["object_cm"], 1),
        )
    return shown
