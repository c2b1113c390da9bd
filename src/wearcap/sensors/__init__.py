"""What sensors on a moving body say: simulated from a motion, calibrated, brought onto one clock and into one world.

Simulated: `imu.py`, `head.py`, `slam.py`, `suit.py`, `keypoints.py`. One clock: `clock.py`, by `claps.py` or
`arm_swings.py`. One world: `alignment.py` (suit and scene), `camera_alignment.py` and `watch_calibration.py`
(MocapEvery's calibration). Open `imu.py` first, then `alignment.py`.
"""
