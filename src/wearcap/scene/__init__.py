"""What surrounds a wearer: scans, the floor, voxels, and objects with their degrees of freedom.

Open `environment.py` and `objects.py` first: a door or a sofa is a `SceneObject`, and `object_motion.py` says how it
follows the hands. `scan.py` holds a scanned scene and what cuts objects out of it is `editing.py`; `floor.py` and
`floor_update.py` find the ground under the feet, `voxels.py` the grids that HMD² sees.
"""
