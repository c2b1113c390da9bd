"""Preparation: sources in, a data set of recordings out."""

from wearcap.prepare.check import check_recording
from wearcap.prepare.engine import Report, Task, content_hash, prepare
from wearcap.prepare.splits import Splits, read_splits

__all__ = ["Report", "Splits", "Task", "check_recording", "content_hash", "prepare", "read_splits"]
