"""Tracked points of a body: the path of a head, the floor below it, and bodies that are anchored to what is tracked."""
