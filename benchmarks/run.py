"""Measure what this code claims about its speed and exactness: one JSON line per figure.

    python benchmarks/run.py [NAME ...]      all benchmarks, or the named ones
    python benchmarks/run.py --list          their names and what they measure
    python benchmarks/run.py NAME --write docs/results/speed.jsonl     also into the file that the results' pages show

A benchmark is a module in this folder with `measure() -> list[dict]`; each dict is one figure with the keys
name, value, unit, baseline, ratio, goal. `value` is ours and `baseline` what it is compared with, measured side by
side in the same run; the module's docstring defines what `ratio` divides by what and on which side of `goal` it
should lie.
"""

import argparse
import ast
import importlib
import json
import sys
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
KEYS = ("name", "value", "unit", "baseline", "ratio", "goal")


def discover(folder: Path = FOLDER) -> dict[str, str]:
    """Benchmarks by name with the first line of their docstring, without importing them."""
    found = {}
    for path in sorted(folder.glob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        if any(isinstance(node, ast.FunctionDef) and node.name == "measure" for node in tree.body):
            found[path.stem] = (ast.get_docstring(tree) or "").split("\n")[0]
    return found


def run(name: str) -> list[dict]:
    """Run one benchmark; its figures have exactly the keys of `KEYS`."""
    figures = importlib.import_module(name).measure()
    for figure in figures:
        if tuple(figure) != KEYS:
            raise SystemExit(f"error: benchmark {name} gave keys {', '.join(figure)}. Expected {', '.join(KEYS)}.")
    return figures


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(description="Run benchmarks; one JSON line per figure.")
    parser.add_argument("names", nargs="*", metavar="NAME", help="benchmarks to run (default: all)")
    parser.add_argument(
        "--write", type=Path, help="file of JSON lines in which these figures replace their earlier ones"
    )
    parser.add_argument("--list", action="store_true", help="name the benchmarks and leave")
    options = parser.parse_args(arguments)
    if options.write is not None:
        from result_pages import about, write_speed
    known = discover()
    if options.list:
        for name, summary in known.items():
            print(f"{name:24} {summary}")
        return
    unknown = [name for name in options.names if name not in known]
    if unknown:
        parser.error(f"no benchmark {', '.join(unknown)}. Expected some of {', '.join(known)}.")
    for name in options.names or known:
        figures = run(name)
        for figure in figures:
            print(json.dumps(figure), flush=True)
        if options.write is not None:
            write_speed(options.write, name, figures, about(f"python benchmarks/run.py {name}"))


if __name__ == "__main__":
    sys.path.insert(0, str(FOLDER))
    main(sys.argv[1:])
