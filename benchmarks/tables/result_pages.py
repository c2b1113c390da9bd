"""Pages of results: docs/results/SYSTEM.md, made of nothing but the JSON files beside it.

`tables.py SYSTEM --publish` puts a table's JSON there, `tables.py SYSTEM --page` makes the page of it, and the cells of
README's table; `tables.py SYSTEM --all` prints every table of the JSON. A system's module has `page(trees, speed)`, which
says what both hold; prose has figures taken from the JSON.
"""

import datetime
import json
import math
import os
import platform
import re
import shlex
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Group
from rich.table import Table

from benchmarks.tables.tabling import UPSIDE_DOWN, cell
from wearcap.errors import WearcapError
from wearcap.files import write_text
from wearcap.metrics.table import Summary, decimals

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "docs" / "results"
SPEED = "speed.jsonl"
"""What `run.py --write` measured, one figure a line."""
MOST_ROWS, MOST_COLUMNS, MOST_WORDS = 10, 8, 1200
"""Of a page: rows and columns of its table, and words in all, as `wc -w` counts them."""
STRAIGHTENED = "2026-11-28"
"""Date from which the truth's knees straighten: CMU's and HDM05's hips are repaired, simulated people walk as people do."""
BENT = "bent knees"
"""What a table says that was measured before."""
LEFT = "left"
"""Key of a table's `about` that names rows of an earlier run, which this one left as they were, and its command."""
_RANKED = "The worst, the median and the best of {}, truth above and captured below; dots mark contact"
NONE = "–"
OURS = "ours"
"""Row of our checkpoint."""

Tree = dict[str, Any]
Trees = Mapping[str, Tree]
"""The JSON trees of a system by file name (without suffix)."""


@dataclass(frozen=True)
class Grid:
    """A table of text, and where its figures are from."""

    title: str
    columns: tuple[str, ...]
    rows: list[list[str]]
    origin: str = ""


@dataclass(frozen=True)
class Page:
    """What a system's page holds."""

    title: str
    headline: Grid
    held_out: str
    simulated: str
    limits: tuple[str, ...]
    full: list[Grid]
    """Every table of the JSON, for `--all`."""
    commands: tuple[str, ...]
    """Lines that make the tables."""
    measured: str = ""
    """README's cell "measured here"; empty: it stays as it is, of the card of today's checkpoint."""
    speed: str = ""
    """README's cell "speed"; empty: it stays as it is."""
    clocks: Mapping[str, str] = field(default_factory=dict)
    """What a benchmark (by name) measures, what is given, and what its ratio is to."""
    pictures: tuple[tuple[str, str], ...] = ()
    """Files of docs/, and what they show."""


def ranked(system: str) -> tuple[tuple[str, str], ...]:
    """Pictures of `contact_sheets.py`, and their captions."""
    whose = {
        "cmu": "CMU's test recordings, without 127_32",
        "hdm05": "the recordings of another laboratory's person (HDM05)",
    }
    return tuple((f"{system}_{data}.png", _RANKED.format(what)) for data, what in whose.items())


def text(summary: Mapping[str, Any] | None, digits: int = 2) -> str:
    """A cell: mean ± deviation, unless that rounds to zero; a dash where there is none."""
    return cell(dict(summary), digits).removesuffix(f" ± {0:.{digits}f}") if summary else NONE


def mean(summary: Mapping[str, Any] | None, digits: int = 1) -> str:
    """The mean alone, for prose."""
    return text({**summary, "std": None}, digits) if summary else NONE


def ranged(summaries: Iterable[Mapping[str, Any]], digits: int = 1) -> str:
    """The range of means, as over presets of the sensors; a single one stands alone, and of none there is nothing."""
    means = [summary["mean"] for summary in summaries if summary["mean"] is not None]
    shown = [f"{value:.{digits}f}" for value in sorted(means)]
    return " to ".join(dict.fromkeys([*shown[:1], *shown[-1:]]))


def summaries(scores: Mapping[str, Mapping[str, Any]]) -> dict[str, Summary]:
    """Summaries as they were before they became JSON."""
    return {
        name: Summary(**{**each, "mean": math.nan if each["mean"] is None else each["mean"]})
        for name, each in scores.items()
    }


def grid_of(table: Table | Group, about: Mapping[str, Any], spread: str = "") -> Grid:
    """A terminal's table, or several beside whose first column the lines are the same."""
    parts = [part for part in (table.renderables if isinstance(table, Group) else [table]) if isinstance(part, Table)]
    whole = [column for k, part in enumerate(parts) for column in part.columns[min(k, 1) :]]
    columns = [[str(each).replace("nan", NONE) for each in column.cells] for column in whole]
    heads = tuple(str(column.header) for column in whole)
    return Grid(str(parts[0].title), heads, [list(row) for row in zip(*columns)], origin(about, spread))


TRAINING = {
    "parameters_m": ("parameters (M)", 2),
    "frames_seen_m": ("frames of its last training (M)", 2),
    "core_minutes": ("core minutes", 0),
    "rate_swept": ("rate swept", 4),
    "trainings": ("trainings", 0),
}
"""Columns of what a row's training took."""


def score_grids(tree: Tree, labels: Mapping[str, tuple[str, int]], spread: str = "seeds") -> list[Grid]:
    """The tables of a tree {"tables": {title: {row: {metric: summary}}}}: columns are the metrics that have a label
    (and digits), then all others but those of the truth, which has a row."""
    grids, labels = [], {**labels, **TRAINING}
    for title, rows in tree["tables"].items():
        rows = {**rows}
        for name, earlier in kept(tree, title).items():
            rows |= {f"{name}: {row}": scores for row, scores in earlier.items() if row != "truth"}
        present = list(dict.fromkeys(m for row in rows.values() for m in row if not m.startswith("truth_")))
        metrics = [name for name in labels if name in present] + [name for name in present if name not in labels]
        cells = [
            [name, *(text(row.get(m), _digits(name, row.get(m), labels.get(m, ("", 2))[1])) for m in metrics)]
            for name, row in rows.items()
        ]
        count = max(
            (
                each["seeds"]
                for name, row in rows.items()
                if not name.startswith(("paper", "truth"))
                for each in row.values()
            ),
            default=0,
        )
        about = tree.get("origins", {}).get(title, tree["about"])
        heads = ("", *(labels.get(metric, (metric, 2))[0] for metric in metrics))
        grids.append(Grid(title, heads, cells, origin(about, f"{count} {spread}" if count > 1 else "")))
    return grids


def _digits(row: str, summary: Mapping[str, Any] | None, usual: int) -> int:
    """Decimals of a cell: of the truth's as many as show it, however small it is."""
    value = None if summary is None else summary["mean"]
    return max(usual, decimals(value, usual)) if row == "truth" and value else usual


def kept(tree: Tree, title: str) -> dict[str, Tree]:
    """Earlier versions of a table that new runs leave as they are ("before more motion, Table 2: …"), by their names; of
    the title its beginning is enough."""
    found = {}
    for other, rows in tree.get("tables", {}).items():
        name, comma, rest = other.partition(", ")
        if comma and rest.startswith(title.split(":")[0]):
            found[name] = rows
    return found


def rows_of(trees: Trees, title: str) -> dict[str, dict[str, Any]]:
    """Rows of the first table whose title begins so; none where no tree has it."""
    for tree in trees.values():
        for name, rows in tree.get("tables", {}).items():
            if name.startswith(title):
                return rows
    return {}


def picked(
    trees: Trees, rows: Iterable[tuple[str, str, str]], columns: Collection[tuple[str, str, int]]
) -> list[list[str]]:
    """Lines of a headline table. rows: a table's title, a row of it, what the page calls it; columns: a heading, a
    metric, digits. Rows that are not in the tables are left out."""
    found = [(label, rows_of(trees, title).get(name)) for title, name, label in rows]
    return [
        [label, *(text(row.get(metric), digits) for _, metric, digits in columns)]
        for label, row in found
        if row is not None
    ]


def figures_of(speed: Mapping[str, list[Tree]], name: str) -> list[Tree]:
    """The figures of this benchmark's own name in its first unit: one of each machine."""
    named = [figure for figure in speed.get(name, []) if figure["name"] == name]
    return [figure for figure in named if figure["unit"] == named[0]["unit"]]


def times(figures: Iterable[Tree]) -> str:
    """How many times what it is compared with, over machines: "6 to 7 ×"."""
    return f"{ranged(({'mean': figure['ratio']} for figure in figures), 0)} ×"


def machine_of(about: Mapping[str, Any]) -> str:
    """A machine's processor, in short: "Intel Xeon"."""
    return about["machine"].split(",")[0].replace("(R)", "").removesuffix(" Processor")


def machines(figures: Iterable[Tree]) -> str:
    """The processors of figures."""
    return ", ".join(sorted({machine_of(figure) for figure in figures}))


def about(command: str) -> dict[str, str]:
    """What a figure needs beside it: command, date, machine."""
    known = Path("/proc/cpuinfo")
    models = re.findall(r"model name\s*: (.+)", known.read_text(encoding="utf-8")) if known.is_file() else []
    processor = models[0] if models else platform.machine()
    machine = f"{processor}, {os.cpu_count()} cores, {platform.system()}, Python {platform.python_version()}"
    return {"command": command, "date": datetime.date.today().isoformat(), "machine": machine}


def origin(about: Mapping[str, Any], spread: str = "") -> str:
    """A table's command, date and machine, and over what it spreads."""
    parts = [f"`{about['command']}`", about["date"], about["machine"], *([spread] if spread else [])]
    parts += [BENT] if about["date"] < STRAIGHTENED else []
    words = ", ".join(map(str, parts)) + "."
    if left := about.get(LEFT):
        words += (
            f" Of an earlier run: {', '.join(left['rows'])} (`{left['command']}`, {left['date']}, {left['machine']})."
        )
    return words


def commands(trees: Trees) -> tuple[str, ...]:
    """Lines that make the tables of the trees, with their last date and machine: those of the tables that later runs do
    not replace, without what chooses rows or leaves them as they were published."""
    known: dict[str, Tree] = {}
    for tree in trees.values():
        kept_ones = {f"{name}, {title}" for title in tree.get("tables", {}) for name in kept(tree, title)}
        for title, each in tree.get("origins", {"": tree["about"]}).items():
            if not any(title.startswith(one.split(":")[0]) for one in kept_ones):
                line = _plain(each["command"])
                known[line] = max(known.get(line, each), each, key=lambda about: about["date"])
    return tuple(f"{line}  # {each['date']}, {machine_of(each)}" for line, each in known.items())


def _plain(command: str) -> str:
    """A command without the options `--rows` and `--leave`, and their values."""
    words, option = [], ""
    for word in shlex.split(command):
        option = word if word.startswith("--") else option
        words += [] if option in ("--rows", "--leave") else [word]
    return shlex.join(words)


def markdown(grid: Grid) -> str:
    """A table without the columns in which no row has anything."""
    columns = range(len(grid.columns))
    kept = [k for k in columns if k == 0 or any(k < len(row) and row[k] not in ("", NONE) for row in grid.rows)]
    rule = ["---", *["---:"] * (len(grid.columns) - 1)]
    lines = [[line[k] if k < len(line) else "" for k in kept] for line in (grid.columns, rule, *grid.rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def results(system: str, systems: Iterable[str], folder: Path = RESULTS) -> Trees:
    """The published trees of a system by name: SYSTEM.json and SYSTEM_….json that is no other system's."""
    found = {}
    for path in sorted(folder.glob(f"{system}*.json")):
        owners = [name for name in systems if path.stem == name or path.stem.startswith(f"{name}_")]
        if max(owners, key=len, default=None) == system:
            found[path.stem] = json.loads(path.read_text(encoding="utf-8"))
    return found


def read_speed(path: Path = RESULTS / SPEED) -> dict[str, list[Tree]]:
    """Figures of speed in a file, by benchmark; none where there is no file."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    found: dict[str, list[Tree]] = {}
    for figure in map(json.loads, lines):
        found.setdefault(figure["benchmark"], []).append(figure)
    return found


def write_speed(path: Path, benchmark: str, figures: list[Tree], about: Mapping[str, str]) -> None:
    """A benchmark's figures take the place of its earlier ones on this machine; all others stay."""
    known = read_speed(path)
    others = [figure for figure in known.get(benchmark, []) if figure["machine"] != about["machine"]]
    known[benchmark] = [*({"benchmark": benchmark, **figure, **about} for figure in figures), *others]
    lines = [json.dumps(figure) for name in sorted(known) for figure in known[name]]
    write_text(path, "\n".join(lines) + "\n")


def with_left(old: Tree, new: Tree, left: Collection[str]) -> Tree:
    """The new tree with those rows of the old one's tables that are in `left` and that it lacks, in front; what the old
    command was stands in the table's `about`."""
    tables, abouts = dict(new.get("tables", {})), {}
    for title, rows in tables.items():
        before = next((name for name in old.get("tables", {}) if _number(name) == _number(title)), None)
        stay = {} if before is None else _missing(old["tables"][before], rows, left)
        if before is not None and stay:
            tables[title] = [*stay.values(), *rows] if isinstance(rows, list) else {**stay, **rows}
            known = old.get("origins", {}).get(before, old["about"])
            known = known[LEFT] if set(stay) <= set(known.get(LEFT, {}).get("rows", ())) else known
            facts = {key: known[key] for key in ("command", "date", "machine")}
            abouts[title] = {**new["about"], LEFT: {"rows": list(stay), **facts}}
    more = {}
    if isinstance(new.get("percentiles"), dict):
        more["percentiles"] = _missing(old.get("percentiles", {}), new["percentiles"], left) | new["percentiles"]
    if isinstance(new.get("scenarios"), dict):
        known = old.get("scenarios", {})
        more["scenarios"] = {
            title: _missing(known.get(title, {}), rows, left) | rows for title, rows in new["scenarios"].items()
        }
    return {**new, **({"tables": tables, "abouts": abouts} if tables else {}), **more}


def _missing(old: Any, new: Any, left: Collection[str]) -> dict[str, Any]:
    """Rows of an old table, by name, that are in `left` and not in the new one."""
    named, known = ({row["method"]: row for row in rows} if isinstance(rows, list) else rows for rows in (old, new))
    return {name: row for name, row in named.items() if name in left and name not in known}


def merged(old: Tree, new: Tree) -> Tree:
    """A tree as published: of trees with `tables`, tables of other numbers stay, each with the `about` of its own
    command; what was measured of each seed alone is left out."""
    new, abouts = {key: value for key, value in new.items() if key not in ("seeds", "abouts")}, new.get("abouts", {})
    if "tables" not in new:
        return new
    again = {_number(title) for title in new["tables"]}
    origins = {**old.get("origins", {}), **dict.fromkeys(new["tables"], new["about"]), **abouts}
    kept = {title: rows for title, rows in old.get("tables", {}).items() if _number(title) not in again}
    tables = {**kept, **new["tables"]}
    return {**new, "tables": tables, "origins": {title: origins[title] for title in tables}}


def _number(title: str) -> str:
    """What a table keeps when it is made again: "Table 1" of "Table 1: objects, test"."""
    return title.split(":")[0]


def publish(path: Path, folder: Path = RESULTS, left: Collection[str] = ()) -> Path:
    """Put a table's JSON beside its page; rows in `left` stay as they were published."""
    target = folder / path.name
    old = json.loads(target.read_text(encoding="utf-8")) if target.is_file() else {}
    tree = merged(old, with_left(old, json.loads(path.read_text(encoding="utf-8")), left))
    write_text(target, compact(tree))
    return target


def compact(tree: Tree) -> str:
    """JSON with six significant digits, and a summary on a line of its own."""

    def rounded(part: Any) -> Any:
        if isinstance(part, dict):
            return {key: rounded(value) for key, value in part.items()}
        if isinstance(part, list):
            return [rounded(value) for value in part]
        return float(f"{part:.6g}") if isinstance(part, float) else part

    lines = json.dumps(rounded(tree), indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    return re.sub(r"\{\s+(\"mean\":[^{}\[\]]*?)\s+\}", lambda found: "{" + "".join(found[1].split()) + "}", lines)


def render(system: str, page: Page, speed: Mapping[str, list[Tree]]) -> str:
    """The page in Markdown. Raises WearcapError when it has too many words, or its table too many rows or columns."""
    made = (
        "After this page you know how good the figures are, on whom they were measured and where they fail, and can make each anew. It "
        f"is written by `python benchmarks/tables.py {system} --page` from the JSON files beside it; `python benchmarks/tables.py {system} "
        "--all` prints all their tables."
    )
    parts = [f"# {page.title}", made, *_straightened(system, page), page.headline.title, markdown(page.headline)]
    parts += ["## Held out", page.held_out, "## Simulated", page.simulated]
    parts += ["## Limits", _listed(page.limits)]
    clocked = _clocked(page.clocks, speed)
    parts += (
        [
            "## Speed",
            "On two cores; speeds depend on the CPU, and ranges are over the machines that are named.",
            _listed(clocked),
        ]
        if clocked
        else []
    )
    parts += ["## Pictures"] if page.pictures else []
    parts += [f"{caption}:\n\n![{caption.split(',')[0]}](../{name})" for name, caption in page.pictures]
    timed = [f"python benchmarks/run.py {' '.join(page.clocks)} --write docs/results/{SPEED}"] if clocked else []
    lines = "\n".join([*page.commands, *timed])
    parts += ["## Commands", f"```\n{lines}\n```"]
    shown = "\n\n".join(parts) + "\n"
    counts = len(page.headline.rows), len(page.headline.columns), len(shown.split())
    if any(count > most for count, most in zip(counts, (MOST_ROWS, MOST_COLUMNS, MOST_WORDS))):
        raise WearcapError(
            f"a page with a table of {counts[0]} rows and {counts[1]} columns and {counts[2]} words",
            where=system,
            expected=f"at most {MOST_ROWS} rows, {MOST_COLUMNS} columns and {MOST_WORDS} words",
        )
    return shown


def _listed(lines: Iterable[str]) -> str:
    return "\n".join(f"- {line}" for line in lines)


def _straightened(system: str, page: Page) -> list[str]:
    """That figures are of people with bent knees, and where newer ones stand."""
    if not any(BENT in grid.origin for grid in page.full):
        return []
    card = f"../../checkpoints/{system}.md"
    newer = (
        f" Today's checkpoint is scored on repaired hips in [its card]({card})." if (RESULTS / card).is_file() else ""
    )
    return [
        f"Figures of before {STRAIGHTENED} are of {BENT}: of people as they were before CMU's and HDM05's hips were repaired "
        f"and simulated people walked upright ([truth](../data.md#truth)). Do not compare them with later ones.{newer}"
    ]


def _clocked(clocks: Mapping[str, str], speed: Mapping[str, list[Tree]]) -> list[str]:
    """A sentence for each of the named benchmarks."""
    lines = []
    for benchmark, inside in clocks.items():
        if figures := figures_of(speed, benchmark):
            unit = re.split(r" \(|,", figures[0]["unit"])[0]
            reached, ratio = (_between(figure[key] for figure in figures) for key in ("value", "ratio"))
            lines.append(f"{inside}: {reached} {unit}, {ratio} × ({machines(figures)}).")
    return lines


def _between(values: Iterable[float]) -> str:
    shown = [number(value) for value in sorted(values)]
    return " to ".join(dict.fromkeys([shown[0], shown[-1]]))


def everything(system: str, page: Page, speed: Mapping[str, list[Tree]]) -> str:
    """All tables of the page's JSON in Markdown, and the system's figures of speed."""
    clocks = speed_grid({name: "" for name in speed if name.startswith(f"{system}_")} | dict(page.clocks), speed)
    grids = [page.headline, *page.full, *([clocks] if clocks.rows else [])]
    return "\n\n".join(f"## {grid.title}\n\n{grid.origin}\n\n{markdown(grid)}" for grid in grids) + "\n"


def speed_grid(clocks: Mapping[str, str], speed: Mapping[str, list[Tree]]) -> Grid:
    """Figures of the named benchmarks, with what they measure."""
    rows = []
    for benchmark, inside in clocks.items():
        for figure in speed.get(benchmark, []):
            measured = [f"{number(figure[key])}" for key in ("value", "baseline", "ratio", "goal")]
            what = inside if figure is speed[benchmark][0] else ""
            rows.append([f"`{figure['name']}`", what, *measured, figure["unit"], figure["date"], machine_of(figure)])
    columns = ("", "what is measured", "ours", "against", "ratio", "goal", "unit", "date", "machine")
    return Grid("Speed", columns, rows, f"`python benchmarks/run.py NAME --write docs/results/{SPEED}`.")


def number(value: float | None) -> str:
    """Three significant digits, without an exponent."""
    if value is None or not math.isfinite(value):
        return NONE
    digits = max(0, 2 - math.floor(math.log10(abs(value)))) if value else 0
    return f"{value:,.{min(digits, 6)}f}".replace(",", "") if digits else f"{value:.0f}"


def with_readme(readme: str, system: str, page: Page) -> str:
    """README with the page's cells in the system's row of its table. Raises WearcapError where it has none."""
    lines = readme.splitlines(keepends=True)
    for place, line in enumerate(lines):
        if line.startswith("| [") and f"](docs/{system}.md)" in line.split(" | ")[0]:
            cells = line.strip().strip("|").strip().split(" | ")
            cells[3:] = [page.measured or cells[3], page.speed or cells[4]]
            lines[place] = "| " + " | ".join(cells) + " |\n"
            return "".join(lines)
    raise WearcapError(f"no row of {system!r}", where="README.md", expected=f"a row that links docs/{system}.md")


def upside_down(rows: Mapping[str, Tree], metric: str, unit: str, digits: int) -> tuple[str, ...]:
    """What recordings with heads upside down add to the error of people."""
    names = ", ".join(UPSIDE_DOWN)
    whole, rest = (rows.get(f"ours{end}") for end in ("", f", without {names}"))
    if whole is None or rest is None:
        return ()
    return (
        f"CMU's file of {names} has the head upside down on an upright neck (158° about one axis), and the body is put "
        f"above it: the MPJPE is {mean(whole[metric], digits)} {unit} with this recording and {mean(rest[metric], digits)} "
        f"{unit} without it.",
    )
