"""Wearable sensors: simulation from a motion, calibration, clock synchronisation and alignment to one world.

Simulated: `imu.py`, `head.py`, `slam.py`, `suit.py`, `keypoints.py`. One clock: `clock.py`, by `claps.py` or
`arm_swings.py`. One world: `alignment.py` (suit and scene), `camera_alignment.py` and `watch_calibration.py`
(MocapEvery's calibration). Open `imu.py` first, then `alignment.py`.
"""
