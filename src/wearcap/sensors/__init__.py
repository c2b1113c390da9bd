"""Wearable sensors: their errors, calibration, clock synchronisation and alignment to one world.

From a motion: `imu.py`, `simulated.py` (head device). One clock: `clock.py`, by claps
(`claps.py`) or arm swings. One world: `initialization.py` (suit and scene), `camera_alignment.py` and
`watch_calibration.py` (MocapEvery's calibration), `monocular_slam.py`. Open `imu.py` first, then `initialization.py`.
"""
