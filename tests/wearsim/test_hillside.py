"""Hillsides: three terraces that stairs and ramps lead between, and a wearer who gets everywhere."""

import itertools

import numpy as np
import pytest

from wearsim.places.outdoor import build_hillside
from wearsim.recordings.simulate import SimulationConfig, simulate_recording


@pytest.fixture(scope="module", params=[0, 1])
def world(request):
    return build_hillside(np.random.default_rng(request.param), "hill")


def test_terraces_lie_four_metres_apart(world):
    heights = sorted(room.z for room in world.places.rooms)
    assert len(heights) == 3
    assert all(3.3 < step <= 4.01 for step in np.diff(heights))
    assert heights[1] == 0.0


def test_stairs_and_ramps_meet_the_terraces(world):
    rooms = sorted(room.z for room in world.places.rooms)
    for flight, (low, high) in zip(sorted(world.places.flights, key=lambda f: f.base_z), itertools.pairwise(rooms)):
        assert flight.base_z == pytest.approx(low)
        assert flight.top_z == pytest.approx(high)
        assert 0.15 <= flight.rise <= 0.17
    slopes = [np.hypot(*surface.plane[:2]) for surface in world.surfaces if surface.kind == "ramp"]
    assert len(slopes) == 2
    assert all(0.1 <= slope <= 0.15 for slope in slopes)


def test_every_terrace_is_reached_from_every_other(world):
    points = world.sample_floor(np.random.default_rng(0), 300)
    lowest, highest = points[points[:, 2].argmin()], points[points[:, 2].argmax()]
    for start, goal in ((lowest, highest), (highest, lowest)):
        path = world.plan_path(start, goal, np.random.default_rng(1))
        assert path is not None
        assert np.abs(np.diff(path[:, 2])).max() < 0.2


@pytest.mark.slow
def test_a_wearer_walks_up_and_down():
    config = SimulationConfig(duration_s=60.0, world="hillside", activities=("walk", "stand"))
    recording = simulate_recording(config, "hill", "test", 3)
    assert recording.floor is not None
    assert float(recording.floor.height.max() - recording.floor.height.min()) > 3.0
