"""Rotations, rigid transforms, cameras, trajectories, distances and the software renderer.

Open `rotation.py`, `rigid.py` and `trajectory.py` first: the rest builds on them. `render.py` is the renderer,
`raster.py` its compiled loops.
"""
