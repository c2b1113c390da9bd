"""The truth of prepared data sets: figures of each person's motion beside what people's bodies do.

    python benchmarks/tables.py truth --datasets datasets/cmu datasets/accad [--people]

Of each set (number of people) the median over persons, and in brackets the worst of them.
"""

import argparse
import json
import math
from dataclasses import asdict
from pathlib import Path
from statistics import median

from tabling import finite

from wearcap.doctor.truth import FIGURES, Figure, people
from wearcap.files import write_text
from wearcap.metrics.truth import Truth
from wearcap.recording import RecordingStore

TOTAL = ("minutes", "cycles")
"""Figures that are added up over persons."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--datasets", nargs="+", type=Path, required=True, help="folders of prepared data sets")
    parser.add_argument("--people", action="store_true", help="a row for each person, not for each set")


def tables(options: argparse.Namespace, about: dict[str, str]) -> Path:
    """Print the table and write it with every person's figures; returns the path of the JSON file."""
    sets = {root.name: _people(root, 3 if options.quick else None) for root in options.datasets}
    if options.people:
        rows = {
            f"{name} {subject}": [figure.text(getattr(person, figure.name)) for figure in FIGURES]
            for name, persons in sets.items()
            for subject, person in persons.items()
        }
    else:
        rows = {f"{name} ({len(persons)})": _of_set(persons) for name, persons in sets.items() if persons}
    print(markdown(rows))
    found = {name: {subject: asdict(person) for subject, person in persons.items()} for name, persons in sets.items()}
    path = options.output / "truth.json"
    write_text(path, json.dumps(finite({"about": about, "table": rows, "people": found}), indent=1) + "\n")
    return path


def markdown(rows: dict[str, list[str]]) -> str:
    """A table of markdown whose columns are `FIGURES`."""
    head = ["", *(figure.heading for figure in FIGURES)]
    bounds = ["people", *(figure.bounds for figure in FIGURES)]
    lines = [head, ["---"] + ["--:"] * len(FIGURES), bounds, *([name, *cells] for name, cells in rows.items())]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _people(root: Path, most: int | None) -> dict[str, Truth]:
    """Figures of a set's people, of its first `most` recordings where that is given."""
    store = RecordingStore.open(root)
    return people(store, store.names()[:most])


def _of_set(persons: dict[str, Truth]) -> list[str]:
    """The cells of one set: totals, and the median and the worst of each other figure."""
    cells = []
    for figure in FIGURES:
        known = [value for person in persons.values() if math.isfinite(value := getattr(person, figure.name))]
        if figure.name in TOTAL:
            cells.append(figure.text(sum(known)))
        elif not known:
            cells.append(figure.text(math.nan))
        else:
            worst = max(known, key=lambda value: _oddity(figure, value))
            cells.append(f"{figure.text(median(known))} ({figure.text(worst)})")
    return cells


def _oddity(figure: Figure, value: float) -> float:
    """How odd a value is: its distance from the middle of the bounds, or how near it comes to the one that there is."""
    if math.isfinite(figure.low) and math.isfinite(figure.high):
        return abs(value - (figure.low + figure.high) / 2)
    return figure.low - value if math.isfinite(figure.low) else value
