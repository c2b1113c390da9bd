"""Simulated calibration sessions, each made once."""

from functools import lru_cache

from torch import Tensor

from wearcap.geometry import rotation
from wearcap.simulation.recordings.calibration_session import CalibrationSession, simulate_calibration

SEEDS = range(5)


@lru_cache
def session(seed: int) -> CalibrationSession:
    return simulate_calibration(seed, walk_s=2.0)


def apart_deg(R_a: Tensor, R_b: Tensor) -> float:
    return rotation.geodesic(R_a.double(), R_b.double()).rad2deg().item()
