"""Recordings as devices sense them, for tables: heads, watches and bodies with the errors of a preset."""

import argparse
from pathlib import Path

import numpy as np

from wearcap.recording import Recording, RecordingStore
from wearcap.sensors.wearables import WEARABLES, WornNoise, worn

GIVEN = "given"
"""Instead of a preset: the recording as it is, exact sensors, with the floor and the wearer's own bones given."""


def add_sensors(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--sensors", choices=list(WEARABLES), default="typical", help="errors of heads and watches")


def sensed(recording: Recording, sensors: str) -> Recording:
    """What devices of a preset sense, the same in every run; the recording itself for `GIVEN`."""
    if sensors == GIVEN:
        return recording
    return worn(recording, WornNoise.preset(sensors), np.random.default_rng([5, *recording.name.encode()]))


class SensedStore(RecordingStore):
    """A data set whose recordings hold what devices of a preset sense; `true` loads them with their truth."""

    sensors: str = GIVEN

    @classmethod
    def open(cls, root: str | Path, sensors: str = GIVEN) -> "SensedStore":
        store = super().open(root)
        assert isinstance(store, SensedStore)
        store.sensors = sensors
        return store

    def load(self, name: str) -> Recording:
        return sensed(super().load(name), self.sensors)

    def true(self, name: str) -> Recording:
        """The recording with its true motion and floor."""
        return super().load(name)
