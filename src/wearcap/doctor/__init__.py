"""The doctor: reports the content of a recording, likely problems, and how to fix them."""

from wearcap.doctor.examine import examine, examine_recording
from wearcap.doctor.report import Finding, Report

__all__ = ["Finding", "Report", "examine", "examine_recording"]
