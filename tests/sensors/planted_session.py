"""Simulated calibration sessions, each made once."""

from functools import lru_cache

from torch import Tensor

import calibration_session as simulated
from wearcap.geometry import rotation
from wearcap.recording import ImuStream
from wearcap.sensors.stillness import Stretch
from wearcap.sensors.watch_calibration import WatchCalibration, measure_watches, require_watches

CalibrationSession = simulated.CalibrationSession
SEEDS = range(5)


@lru_cache
def session(seed: int) -> CalibrationSession:
    return simulated.simulate_calibration(seed, walk_s=2.0)


def calibrated(watches: dict[str, ImuStream], board: Stretch, t_pose: Stretch) -> dict[str, WatchCalibration]:
    """Both watches' calibrations after all checks."""
    found = measure_watches(watches, board, t_pose)
    require_watches(watches, found, t_pose)
    return found


def apart_deg(R_a: Tensor, R_b: Tensor) -> float:
    return rotation.geodesic(R_a.double(), R_b.double()).rad2deg().item()
