"""The truth of prepared data sets: figures of each person's motion beside what people's bodies do.

    python benchmarks/tables.py truth --datasets datasets/cmu datasets/accad [--people]

Of each set (number of people) the median over persons, and in brackets the worst of them.
"""

import argparse
from math import isfinite
from pathlib import Path
from statistics import median

from benchmarks.tables.tabling import write_tree
from wearcap.checks.truth import FIGURES, Figure, people
from wearcap.recording import RecordingStore

People = dict[str, dict[str, float]]
"""Figures by person and name."""
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
            f"{name} {subject}": [figure.text(person) for figure in FIGURES]
            for name, persons in sets.items()
            for subject, person in persons.items()
        }
    else:
        rows = {f"{name} ({len(persons)})": _of_set(persons) for name, persons in sets.items() if persons}
    print(markdown(rows))
    path = options.output / "truth.json"
    return write_tree(path, {"about": about, "table": rows, "people": sets})


def markdown(rows: dict[str, list[str]]) -> str:
    """A table of markdown whose columns are `FIGURES`."""
    head = ["", *(figure.heading for figure in FIGURES)]
    bounds = ["people", *(f"{f.low:g} to {f.high:g}" * isfinite(f.low) for f in FIGURES)]
    lines = [head, ["---"] + ["--:"] * len(FIGURES), bounds, *([name, *cells] for name, cells in rows.items())]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _people(root: Path, most: int | None) -> People:
    """Figures of a set's people, of its first `most` recordings where that is given."""
    store = RecordingStore.open(root)
    return people(store, store.names()[:most])


def _of_set(persons: People) -> list[str]:
    """The cells of one set: totals, and the median and the worst of each other figure."""
    cells = []
    for figure in FIGURES:
        known = [person[figure.name] for person in persons.values() if figure.name in person]
        shown = [sum(known)] if figure.name in TOTAL else []
        if known and not shown:
            shown = [median(known), max(known, key=lambda value: _oddity(figure, value))]
        texts = [figure.text({figure.name: value}) for value in shown]
        cells.append(f"{texts[0]} ({texts[1]})" if len(texts) > 1 else "".join(texts) or "–")
    return cells


def _oddity(figure: Figure, value: float) -> float:
    """How far a value is from 0, or from the middle of bounds that leave 0 out."""
    return abs(value) if figure.low <= 0 <= figure.high else abs(value - (figure.low + figure.high) / 2)
