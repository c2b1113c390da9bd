"""The wearer's surroundings: scans, the floor, voxel grids, and objects with their degrees of freedom.

Open `objects.py` first: a door or a sofa is a `SceneObject` of an `Environment`; `follow_hands` moves it. `scan.py`
holds a scanned scene, `editing.py` cuts objects out of it; `floor.py` estimates the floor height, `voxels.py` makes the
grids that HMD² takes as input.
"""
