"""Rotations, rigid transforms, cameras, trajectories, distances and the software renderer."""
