"""Tracked points of a body: the path of a head, the floor below it, bodies that are anchored to what is tracked, and their
refinement."""
