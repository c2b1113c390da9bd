"""Measure what this code claims about its speed and exactness: one JSON line per figure.

    python benchmarks/run.py [NAME ...]      all benchmarks, or the named ones
    python benchmarks/run.py --list          their names and what they measure
    python benchmarks/run.py NAME --write docs/results/speed.jsonl     also into the file that the results' pages show

A benchmark is a module of `benchmarks/` with `measure() -> list[dict]`, whose dicts `figures.figure` makes. `value` is ours and
`baseline` what it is compared with, measured side by side in the same run; the module's docstring defines what `ratio`
divides by what and on which side of `goal` it should lie.
"""

import argparse
import ast
import importlib
import json
from pathlib import Path
from typing import NamedTuple

from benchmarks.tables.result_pages import about, write_speed

FOLDER = Path(__file__).resolve().parents[1]


class Benchmark(NamedTuple):
    """A module that measures."""

    module: str
    summary: str
    """The first line of its docstring."""

    def measure(self) -> list[dict]:
        return importlib.import_module(self.module).measure()


def discover(folder: Path = FOLDER) -> dict[str, Benchmark]:
    """Benchmarks by name, without importing them."""
    found = {}
    for path in sorted(folder.rglob("*.py"), key=lambda path: path.stem):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        if any(isinstance(node, ast.FunctionDef) and node.name == "measure" for node in tree.body):
            module = ".".join(path.relative_to(folder.parent).with_suffix("").parts)
            found[path.stem] = Benchmark(module, (ast.get_docstring(tree) or "").split("\n")[0])
    return found


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(description="Run benchmarks; one JSON line per figure.")
    parser.add_argument("names", nargs="*", metavar="NAME", help="benchmarks to run (default: all)")
    parser.add_argument(
        "--write", type=Path, help="file of JSON lines in which these figures replace their earlier ones"
    )
    parser.add_argument("--list", action="store_true", help="name the benchmarks and leave")
    options = parser.parse_args(arguments)
    known = discover()
    if options.list:
        for name, benchmark in known.items():
            print(f"{name:24} {benchmark.summary}")
        return
    if unknown := [name for name in options.names if name not in known]:
        parser.error(f"no benchmark {', '.join(unknown)}. Expected some of {', '.join(known)}.")
    for name in options.names or known:
        figures = known[name].measure()
        for figure in figures:
            print(json.dumps(figure), flush=True)
        if options.write is not None:
            write_speed(options.write, name, figures, about(f"python benchmarks/run.py {name}"))
