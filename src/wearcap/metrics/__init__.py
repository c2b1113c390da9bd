"""Metrics as pure functions, each defined once, and tables of them."""

from wearcap.metrics.table import Row, Summary, aggregate, evaluate_motion

__all__ = ["Row", "Summary", "aggregate", "evaluate_motion"]
