"""One simulated wearer for all tests of this folder."""

import numpy as np
import pytest

from wearsim.people.actions import ACTIVITIES
from wearsim.people.person import Person, draw_person
from wearsim.people.wearer import SimulatedMotion, simulate_motion
from wearsim.places.flat import build_flat
from wearsim.places.world import World


@pytest.fixture(scope="session")
def stairs_flat() -> World:
    return build_flat(np.random.default_rng(1), "flat", stairs=True)


@pytest.fixture(scope="session")
def person() -> Person:
    return draw_person("somebody", np.random.default_rng(51))


@pytest.fixture(scope="session")
def everything(stairs_flat: World, person: Person) -> SimulatedMotion:
    """100 s in which every activity is done in turn, the way leading over stairs."""
    return simulate_motion(stairs_flat, person, np.random.default_rng(1), 100.0, 60.0, list(ACTIVITIES))
