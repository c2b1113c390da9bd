"""A system's tables as in its paper, with ours, baselines and ablations.

    python benchmarks/tables.py SYSTEM [--quick] [--help]

Prints them and writes OUTPUT/SYSTEM.json (OUTPUT is outputs/tables). Systems:

    hmd2          HMD2 with points and pictures: its paper's tables on held-out people and places
    hmd2_head     HMD2 on the head path alone: MPJPE and its parts, realism, beside trivial baselines
    hps           HPS on simulated sessions: its paper's three tables, drift, outages of localisation
    ireplica      iReplica on simulated interactions: its paper's tables, robustness
    echo          ECHO: bodies, objects and contacts; baselines, ablations, sparse observations
    mocap_every   MocapEvery: bodies, floors on hillsides, hands in the picture; its paper's Tables 2 to 7
    egoview       our image encoder: hands in the head camera's pictures
    voxels        codes of the points around the body: what they bring back
    objects       the object encoder's feature: category, extents, instance of objects unknown to it
    simulation    how far simulated people differ from CMU's: gait statistics, and a discriminator

Each system is a module tables_SYSTEM.py in this folder with `add_arguments(parser)` and
`tables(options, about)`.
"""

import argparse
import datetime
import importlib
import platform
import sys
from pathlib import Path

from wearcap.errors import WearcapError

FOLDER = Path(__file__).resolve().parent


def systems() -> list[str]:
    """Names of the systems that have tables here."""
    return sorted(path.stem.removeprefix("tables_") for path in FOLDER.glob("tables_*.py"))


def about(arguments: list[str]) -> dict[str, str]:
    """What a figure needs beside it: command, date, machine."""
    return {
        "command": " ".join(["python benchmarks/tables.py", *arguments]),
        "date": datetime.date.today().isoformat(),
        "machine": f"{platform.machine()} {platform.system()}, Python {platform.python_version()}",
    }


def main(arguments: list[str]) -> None:
    if not arguments or arguments[0] not in systems():
        wanted = "" if not arguments or arguments[0].startswith("-") else f"error: no tables of {arguments[0]!r}\n\n"
        print(f"{wanted}{__doc__}", file=sys.stderr if wanted else sys.stdout)
        sys.exit(2 if wanted else 0)
    system = importlib.import_module(f"tables_{arguments[0]}")
    parser = argparse.ArgumentParser(f"tables.py {arguments[0]}", description=system.__doc__)
    parser.add_argument("--quick", action="store_true", help="minutes instead of hours: a look, not a result")
    parser.add_argument("--output", type=Path, default=Path("outputs/tables"), help="folder of the table")
    system.add_arguments(parser)
    options = parser.parse_args(arguments[1:])
    try:
        path = system.tables(options, about(arguments))
    except WearcapError as error:
        sys.exit(f"error: {error}")
    print(f"written: {path}")


if __name__ == "__main__":
    sys.path.insert(0, str(FOLDER))
    main(sys.argv[1:])
