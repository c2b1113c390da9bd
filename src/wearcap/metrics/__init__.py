"""Metrics: pure functions, each defined once, and the tables made of them."""

from wearcap.metrics.table import Row, Summary, aggregate, evaluate_motion

__all__ = ["Row", "Summary", "aggregate", "evaluate_motion"]
