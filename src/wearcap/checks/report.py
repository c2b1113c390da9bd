"""The doctor's findings by recording, the worst first."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import partialmethod

from wearcap.errors import WearcapError

SEVERITIES = ("ok", "note", "warning", "error")


@dataclass(frozen=True)
class Finding:
    """One statement about a recording."""

    severity: str
    """"ok" (looked at and sound), "note" (worth knowing), "warning" (looks wrong) or "error" (is wrong)."""
    check: str
    """Name of the check, in two or three words."""
    what: str
    evidence: str = ""
    fix: str = ""
    """Fix; empty if there is nothing to fix."""

    def __post_init__(self):
        if self.severity not in SEVERITIES:
            raise ValueError(f"severity {self.severity!r} is none of {SEVERITIES}")


@dataclass(frozen=True)
class Check:
    """A check by its name; its methods make its findings, of the severity that they are called after."""

    name: str

    def found(self, severity: str, what: str, evidence: str = "", fix: str = "") -> Finding:
        """A finding of a severity that the evidence decides."""
        return Finding(severity, self.name, what, evidence, fix)

    def ok(self, what: str, evidence: str = "") -> Finding:
        return self.found("ok", what, evidence)

    note = partialmethod(found, "note")
    warning = partialmethod(found, "warning")
    error = partialmethod(found, "error")


def has_error(findings: Iterable[Finding]) -> bool:
    """Whether any finding is an error."""
    return any(finding.severity == "error" for finding in findings)


def refusal(error: WearcapError, check: str = "reading") -> Finding:
    """A reader's error as a finding."""
    fix = " ".join(filter(None, [error.expected and f"Expected {error.expected}.", error.fix]))
    return Finding("error", check, error.what, str(error.where or ""), fix)


@dataclass(frozen=True)
class Report:
    """Findings of every examined recording, and of every person of a data set ("person NAME")."""

    source: str
    findings: dict[str, tuple[Finding, ...]]
    people: dict[str, dict[str, float]] = field(default_factory=dict)
    """Figures of a data set's people (`metrics.truth`)."""

    def of_severity(self, *severities: str) -> list[tuple[str, Finding]]:
        """(recording, finding) of these severities."""
        return [(name, f) for name, found in self.findings.items() for f in found if f.severity in severities]

    @property
    def sound(self) -> bool:
        """Whether no error was found."""
        return not self.of_severity("error")

    def grouped(self) -> list[tuple[Finding, list[str]]]:
        """Equal findings of several recordings merged: (the first finding, all recordings), worst first."""
        groups: dict[tuple, tuple[Finding, list[str]]] = {}
        for name, found in self.findings.items():
            for finding in found:
                key = (finding.severity, finding.check, finding.what)
                groups.setdefault(key, (finding, []))[1].append(name)
        return sorted(groups.values(), key=lambda group: -SEVERITIES.index(group[0].severity))
