"""Skeletons, forward kinematics, body surfaces, retargeting.

Open `skeleton.py` first (joints by name), then `kinematics.py`; surfaces are a `BodyModel` (`model.py`), by default
Anny's (`anny_body.py`), or the user's own SMPL files (`smpl_body.py`).
"""
