"""Scores of captures over whole data sets, and the baselines beside them."""
