"""Wearable sensors: simulation from a motion, calibration, clock synchronisation and alignment to one world.

Simulated: `imu.py`, `simulated.py` (head device and suit), `slam.py`, `keypoints.py`. One clock: `clock.py`, by claps
(`claps.py`) or arm swings. One world: `initialization.py` (suit and scene), `camera_alignment.py` and
`watch_calibration.py` (MocapEvery's calibration), `monocular_slam.py`. Open `imu.py` first, then `initialization.py`.
"""
