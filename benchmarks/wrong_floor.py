"""HMD² and MocapEvery that are given a floor which is too low or too high by some centimetres.

    python benchmarks/wrong_floor.py [--dataset datasets/cmu] [--split val] [--checkpoints hmd2 mocap_every] [--off -5 0 5]

The floor is the recording's, shifted (cm): HMD² takes it as what it would find below the head's path, MocapEvery as the
measured height h_0 that it starts from and then follows by the feet in contact (`pipeline.floor=follow`), and as one that
stays (`fixed`). Errors (cm) and the knee in stance (degrees) are those of `wearcap evaluate`, means over frames and recordings.
"""

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

from wearcap.cli.conf import compose, load_pipeline
from wearcap.geometry.trajectory import interpolate_clamped
from wearcap.metrics.table import TRUTH, aggregate
from wearcap.recording import Recording, RecordingStore
from wearcap.recording.recording import FloorTrack
from wearcap.runtime.system import CaptureInput
from wearcap.systems.hmd2 import pipeline as hmd2
from wearcap.tracking.head_path import HeadPath

SETTINGS = {"hmd2": {"": []}, "mocap_every": {"follows": ["pipeline.floor=follow"], "fixed": ["pipeline.floor=fixed"]}}
SHOWN = ("mpjpe_cm", "lower_pe_cm", "foot_pe_cm", "floor_penetration_cm", "stance_knee_deg", f"{TRUTH}stance_knee_deg")


def shifted_floor(recording: Recording, off_m: float) -> Recording:
    """The recording with its floor shifted, and without points, which would show the true one."""
    assert recording.floor is not None
    floor = FloorTrack(recording.floor.timestamps, recording.floor.height + off_m)
    return replace(recording, floor=floor, points=None, camera=None)


def over_stated_floor(found: Callable[..., HeadPath]) -> Callable[..., HeadPath]:
    """`head_path` with the floor that the recording states."""

    def path_of(recording: Recording, *args: Any) -> HeadPath:
        path, track = found(recording, *args), recording.floor
        assert track is not None
        return replace(path, floor_height=interpolate_clamped(track.timestamps, track.height, path.timestamps).float())

    return path_of


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dataset", type=Path, default=Path("datasets/cmu"), metavar="DIR")
    parser.add_argument("--split", default="val")
    parser.add_argument("--checkpoints", nargs="+", default=list(SETTINGS), choices=list(SETTINGS))
    parser.add_argument("--off", type=float, nargs="+", default=[-5.0, 0.0, 5.0], metavar="CM")
    options = parser.parse_args()
    store = RecordingStore.open(options.dataset)
    recordings = [store.load(name) for name in store.names(options.split)]
    recordings = [each for each in recordings if each.floor is not None and len(each.floor.height)]
    for checkpoint in options.checkpoints:
        for setting, overrides in SETTINGS[checkpoint].items():
            chosen = ["recording=none", f"pipeline={checkpoint}", f"checkpoint={checkpoint}", *overrides]
            system = load_pipeline(checkpoint, compose("capture", chosen).pipeline, "cpu")
            for off_cm in options.off:
                rows = []
                with patch.object(hmd2, "head_path", over_stated_floor(hmd2.head_path)):
                    for recording in recordings:
                        source = CaptureInput.in_dataset(shifted_floor(recording, off_cm / 100), store.root)
                        rows.append(system.score(system(source), source, 0))
                scores = aggregate(rows)
                shown = ", ".join(f"{name} {scores[name].mean:.2f}" for name in SHOWN if name in scores)
                print(f"{checkpoint} {setting} {off_cm:+g} cm ({len(rows)} recordings): {shown}", flush=True)


if __name__ == "__main__":
    main()
