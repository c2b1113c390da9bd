"""What `wearcap doctor` prints: a table of findings, or JSON."""

import argparse
import json
from collections.abc import Callable
from dataclasses import asdict
from functools import partial

from hydra.utils import instantiate
from rich.box import SIMPLE
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from rich.text import Text

from wearcap.apps.doctor import examine
from wearcap.apps.doctor.preflight import preflight
from wearcap.checks import Report
from wearcap.checks.truth import FIGURES
from wearcap.cli.conf import compose
from wearcap.cli.stated import stated
from wearcap.runtime.system import System

_COLOR = {"ok": "green", "note": "cyan", "warning": "yellow", "error": "bold red"}


def examined(options: argparse.Namespace) -> Report:
    """Examine what the options name, print the findings and return them."""
    check = None if options.pipeline is None else _preflight(options.pipeline)
    how = stated(vars(options))
    if options.json:
        report = examine(options.path, preflight=check, how=how)
        findings = {name: [asdict(finding) for finding in found] for name, found in report.findings.items()}
        content = {"source": report.source, "sound": report.sound, "findings": findings, "people": report.people}
        print(json.dumps(content, indent=1, ensure_ascii=False))
    else:
        console = Console()
        with Progress(console=Console(stderr=True), transient=True) as progress:
            task = progress.add_task("examining", total=None)
            report = examine(
                options.path, lambda done, total: progress.update(task, completed=done, total=total), check, how
            )
        console.print(_table(report, options.quiet))
        if report.people:
            Console(width=max(console.width, 180)).print(_people(report))
        counts = {severity: len(report.of_severity(severity)) for severity in ("error", "warning", "note")}
        listed = ", ".join(f"{count} {severity}{'s' if count != 1 else ''}" for severity, count in counts.items())
        verdict = "[green]sound[/]" if report.sound else "[bold red]not sound[/]"
        count = len(report.findings) - len(report.people)
        console.print(f"{count} recording{'s' if count != 1 else ''}: {verdict} ({listed})")
    return report


def _preflight(name: str) -> Callable:
    """The check of what a pipeline, by its config's name, needs; its network is not loaded."""
    made = instantiate(compose("capture", ["recording=none", f"pipeline={name}"]).pipeline, _convert_="all")
    needs = made.needs() if isinstance(made, System) else made.func.required
    return partial(preflight, name=name, needs=needs)


def _table(report: Report, quiet: bool) -> Table:
    """One row per finding: the check, the result, the evidence, the fix, and the recordings concerned."""
    table = Table(title=report.source, title_justify="left")
    for column in ("", "check", "finding"):
        table.add_column(column, no_wrap=column == "")
    several = len(report.findings) > 1
    for finding, names in report.grouped():
        if quiet and finding.severity == "ok":
            continue
        color = _COLOR[finding.severity]
        cell = Text(finding.what, style=color if finding.severity != "ok" else "")
        cell.append(f"\n{finding.evidence}" if finding.evidence else "", style="dim")
        cell.append(f"\n→ {finding.fix}" if finding.fix else "", style="bold")
        if several:
            cell.append(f"\n{len(names)}: {', '.join(names[:3])}{' …' if len(names) > 3 else ''}", style="italic")
        table.add_row(Text(finding.severity, style=color), Text(finding.check), cell)
    return table


def _people(report: Report) -> Table:
    """One row per person of a data set: its figures, those out of bounds in the color of warnings."""
    table = Table("person", *(figure.heading for figure in FIGURES), title="people", title_justify="left", box=SIMPLE)
    table.columns[0].no_wrap = True
    for subject, person in report.people.items():
        table.add_row(subject, *(Text(f.text(person), style=_COLOR["warning"] * f.is_odd(person)) for f in FIGURES))
    return table
