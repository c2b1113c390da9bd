"""Recordings as devices sense them, for tables: heads, watches and bodies with the errors of a preset."""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.tables.wearables import WEARABLES, WearableNoise, with_noise
from wearcap.body.skeleton import skeleton_of_height
from wearcap.recording import Recording, RecordingStore
from wearcap.tracking.stature import skeleton_of

GIVEN = "given"
"""Instead of a preset: the recording as it is, exact sensors, with the floor and the wearer's own bones given."""
WRONG_HEIGHTS = {"3 cm too tall": 0.03, "3 cm too short": -0.03}
"""Rows whose wearers give a wrong height, by name: how far off it is (m)."""


def add_sensors(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--sensors", choices=list(WEARABLES), default="typical", help="errors of heads and watches")


def sensed(recording: Recording, sensors: str, height_off_m: float | None = None) -> Recording:
    """What devices of a preset sense, the same in every run; the recording itself for `GIVEN`.

    `height_off_m`: how far the height that the wearer gives is off the true one; None: as the preset knows it.
    """
    given = recording
    if sensors != GIVEN:
        rng = np.random.default_rng([5, *recording.name.encode()])
        given = with_noise(recording, WearableNoise.preset(sensors), rng)
    true, known = skeleton_of(recording), skeleton_of(given)
    if height_off_m is None or true is None:
        return given
    return replace(given, skeleton=skeleton_of_height(true.stature + height_off_m, known))


class SensedStore(RecordingStore):
    """A data set whose recordings hold what devices of a preset sense (`sensed`); `true` loads them with their truth."""

    sensors: str = GIVEN
    height_off_m: float | None = None

    @classmethod
    def open(cls, root: str | Path, sensors: str = GIVEN, height_off_m: float | None = None) -> "SensedStore":
        store = super().open(root)
        assert isinstance(store, SensedStore)
        store.sensors, store.height_off_m = sensors, height_off_m
        return store

    def load(self, name: str) -> Recording:
        return sensed(super().load(name), self.sensors, self.height_off_m)

    def true(self, name: str) -> Recording:
        """The recording with its true motion and floor."""
        return super().load(name)
