"""Metrics as pure functions, each defined once, and tables of them."""
