"""Rotations, rigid transforms, cameras, trajectories, distances and the software renderer.

Open `rotation.py`, `rigid.py` and `trajectory.py` first: everything else is said in them. `render.py` is the
renderer, `raster.py` its loops.
"""
