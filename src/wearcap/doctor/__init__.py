"""The doctor: says what it sees in a recording, what looks wrong, and how to mend it."""

from wearcap.doctor.examine import examine, examine_recording
from wearcap.doctor.report import Finding, Report

__all__ = ["Finding", "Report", "examine", "examine_recording"]
