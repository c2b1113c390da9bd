"""A system's tables as in its paper, with ours, baselines and ablations.

    python benchmarks/tables.py SYSTEM [--quick] [--publish [--leave ROW …]] [--help]
    python benchmarks/tables.py SYSTEM --page | --all

Prints them and writes OUTPUT/SYSTEM.json (OUTPUT is outputs/tables), which --publish puts into docs/results as well.
--page and --all compute nothing: from the JSON files in docs/results the one writes docs/results/SYSTEM.md and README's row,
the other prints every table (Markdown). Systems:

    hmd2          HMD2 with points and pictures: its paper's tables on held-out people and places
    hps           HPS on simulated sessions: its paper's three tables, drift, outages of localisation
    ireplica      iReplica on simulated interactions: its paper's tables, robustness
    echo          ECHO: bodies, objects and contacts; baselines, ablations, sparse observations
    mocap_every   MocapEvery: bodies, floors on hillsides, hands in the picture; its paper's Tables 2 to 7
    egoview       our image encoder: hands in the head camera's pictures
    voxels        codes of the points around the body: what they bring back
    objects       the object encoder's feature: category, extents, instance of objects unknown to it
    truth         whether data sets move as people do: knees, soles, sides, proportions, by set or by person
    sets          what each set of motion brings on validation people of the others: one left out at a time
    simulation    errors of simulated sensors, beside published ones

Each system is a module of this folder with `add_arguments(parser)`, `tables(options, about)` and, where
it has a page, `page(trees, speed)`.
"""

import argparse
import importlib
import shlex
import sys
from pathlib import Path

from benchmarks.tables import result_pages as pages
from wearcap.errors import WearcapError
from wearcap.files import write_text

SYSTEMS = (
    "echo",
    "egoview",
    "hmd2",
    "hps",
    "ireplica",
    "mocap_every",
    "objects",
    "sets",
    "simulation",
    "truth",
    "voxels",
)


def main(arguments: list[str]) -> None:
    if not arguments or arguments[0] not in SYSTEMS:
        wanted = "" if not arguments or arguments[0].startswith("-") else f"error: no tables of {arguments[0]!r}\n\n"
        print(f"{wanted}{__doc__}", file=sys.stderr if wanted else sys.stdout)
        sys.exit(2 if wanted else 0)
    if "--page" in arguments:
        print(f"written: {write_page(arguments[0])}")
        return
    if "--all" in arguments:
        print(pages.everything(arguments[0], page_of(arguments[0]), pages.read_speed()), end="")
        return
    system = importlib.import_module(f"{__package__}.{arguments[0]}")
    parser = argparse.ArgumentParser(f"tables.py {arguments[0]}", description=system.__doc__)
    parser.add_argument("--quick", action="store_true", help="minutes instead of hours: a look, not a result")
    parser.add_argument("--output", type=Path, default=Path("outputs/tables"), help="folder of the table")
    parser.add_argument("--publish", action="store_true", help="put the JSON into docs/results, too, and make its page")
    leave = "rows that stay as they were published, such as rivals whose trainings are not here: the page says so"
    parser.add_argument("--leave", nargs="+", default=[], metavar="ROW", help=leave)
    parser.add_argument("--page", action="store_true", help="make the page of what is in docs/results, nothing else")
    parser.add_argument("--all", action="store_true", help="print every table in docs/results, nothing else")
    system.add_arguments(parser)
    options = parser.parse_args(arguments[1:])
    command = shlex.join(["python", "benchmarks/tables.py", *(word for word in arguments if word != "--publish")])
    try:
        path = system.tables(options, pages.about(command))
    except WearcapError as error:
        sys.exit(f"error: {error}")
    print(f"written: {path}")
    if options.publish:
        print(f"written: {pages.publish(path, left=options.leave)}")
        if hasattr(system, "page"):
            print(f"written: {write_page(arguments[0])}")


def page_of(system: str, folder: Path = pages.RESULTS) -> pages.Page:
    """What the page of a system holds; leaves with a message where it has no page, or nothing is published."""
    make, trees = (
        getattr(importlib.import_module(f"{__package__}.{system}"), "page", None),
        pages.results(system, SYSTEMS, folder),
    )
    if make is None or not trees:
        sys.exit(f"error: no page of {system!r}. Expected {folder / system}.json, from tables.py {system} --publish.")
    return make(trees, pages.read_speed(folder / pages.SPEED))


def write_page(system: str) -> Path:
    """docs/results/SYSTEM.md, and README's row where it has one; returns the page's path."""
    page = page_of(system)
    write_text(pages.RESULTS / f"{system}.md", pages.render(system, page, pages.read_speed()))
    if page.measured:
        readme = pages.ROOT / "README.md"
        write_text(readme, pages.with_readme(readme.read_text(encoding="utf-8"), system, page))
    return pages.RESULTS / f"{system}.md"
