"""How high people carry their heads while upright, as a share of the head joint's height in the rest pose.

Training splits of CMU, HDM05 and the simulator, whose bones and floors are known: the floor that
`tracking.floor.floor_from_path` finds is too low by what people are less upright than the rest pose. value: median share
over recordings; baseline: `tracking.floor.CARRIED`, of which ratio is the multiple.
"""

import statistics
from pathlib import Path

from wearcap.geometry.trajectory import interpolate_clamped
from wearcap.recording import RecordingStore
from wearcap.tracking.floor import CARRIED, floor_from_path


def measure(datasets: str = "datasets", names: tuple[str, ...] = ("cmu", "hdm05", "simulated")) -> list[dict]:
    figures = []
    for name in names:
        store, shares = RecordingStore.open(Path(datasets) / name), []
        for each in store.names("train"):
            recording = store.load(each)
            motion, track = recording.motion, recording.floor
            if motion is None or track is None:
                continue
            stature = motion.skeleton.height_of("head")
            found = floor_from_path(motion.timestamps, motion.joint("head").t, stature)
            true = interpolate_clamped(track.timestamps, track.height, motion.timestamps)
            shares.append(1 + (found - true).median().item() / stature)
        value = statistics.median(shares)
        figure = {
            "name": f"carried_heads_{name}",
            "value": value,
            "unit": f"of the rest pose, {len(shares)} recordings",
        }
        figures.append({**figure, "baseline": CARRIED, "ratio": value / CARRIED, "goal": 1.0})
    return figures
