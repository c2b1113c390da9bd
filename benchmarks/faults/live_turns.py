"""What the first minute of a live capture misjudges on recorded people: clocks by turns, headings by hanging arms.

    python -m benchmarks.faults.live_turns [DATASET ...] [--seconds 10]
    python -m benchmarks.faults.live_turns --headings [DATASET ...]

People turn their head before the body, so that turns show an offset of clocks although there is none. Head and wrists of recorded motion, on one clock, are compared as the guided first minute of a live capture does
(`wearcap.apps.live.clock_offset`), in windows a second apart in which both have turned to both sides. Prints one JSON line for
windows of people at one place with hanging arms, and one for all others: numbers of windows and recordings, the share that
is compared at all, quantiles (0, 5, 50, 95, 100 %) of the offset (s) found, and the share that is not left alone.

`--headings`: each test recording's head and watches are shown to the first minute that is not guided, from the recording's begin
on. Watches sit as they are usually worn and count headings of their own, with the errors of mounting and attitude that the
recording's sensors have, or where it has none those of `sensors.imu.ImuNoise`. Prints for each data set one JSON line for
watches on arms whose forearm is hanging in the last two seconds of the first minute, and one for all others: numbers of watches,
recordings and persons, quantiles (50, 75, 95, 100 %) of the error (degrees) of the heading that was found, and the median of
each wrist with its sign. Recordings that end before the first minute does are left out.
"""

import argparse
import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from wearcap.apps.live.clock_offset import LEAST_OFFSET_S, offset_by_turning, turned
from wearcap.apps.live.setup import Setup
from wearcap.apps.live.setup_estimation import HOLD_S, SetupEstimation
from wearcap.apps.live.sources.replay import ReplaySource
from wearcap.body.skeleton import WRISTS
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import Trajectory
from wearcap.recording import Motion, Recording
from wearcap.recording.store import RecordingStore
from wearcap.sensors.imu import ImuNoise, synthesize_imu
from wearcap.sensors.samples import WatchSample
from wearcap.systems.mocap_every.stream import MocapEverySession

SPOT_M, HANGING = 1.0, 0.6
"""Largest distance (m) of the pelvis from its median, and least downward component of a hanging forearm."""
ENOUGH = 0.99
"""Share of the turning; the first minute also waits until the wearer rests."""
WORN = dict(zip(WRISTS, (rotation.exp(torch.tensor([0.0, 0.0, 1.45])), rotation.exp(torch.tensor([0.1, 0.0, 1.7])))))
"""R_joint_watch of watches as they are usually worn."""
YAW_RAD = dict(zip(WRISTS, (2.0, -1.1)))
"""Turn from each watch's own world to the head's."""


def hangs(part: Motion, wrist: str) -> bool:
    """Whether the forearm of a wrist hangs for most of a motion."""
    forearm = torch.nn.functional.normalize(part.joint(wrist).t - part.joint(wrist.replace("wrist", "elbow")).t, dim=-1)
    return (forearm[:, 2] < -HANGING).float().mean().item() > 0.7


def windows(motion: Motion, seconds: float) -> Iterator[tuple[bool, Trajectory, Trajectory]]:
    """(whether at one place with a hanging arm, head, wrist) of each window and arm."""
    frames, step = round(seconds * motion.fps), round(motion.fps)
    for first in range(0, max(1, len(motion) - frames // 2), step):
        part = motion.sliced(first, min(first + frames, len(motion)))
        if len(part) < 4 * step:
            continue
        ground = part.joint("pelvis").t[:, :2]
        stays = (ground - ground.median(0).values).norm(dim=-1).max().item() < SPOT_M
        head = part.joint("head")
        for wrist in WRISTS:
            found = (Trajectory(part.timestamps, each.R, each.t) for each in (head, part.joint(wrist)))
            yield stays and hangs(part, wrist), *found


def recordings(folder: str, split: str | None = None) -> Iterator[Recording]:
    """The recordings of a data set, or of a split of it."""
    store = RecordingStore.open(folder)
    for name in store.names(split):
        yield store.load(name)


# --- clocks ---------------------------------------------------------------------------------------------------------


def print_clocks(datasets: list[str], seconds: float) -> None:
    """Print what turns show of clocks that are one."""
    found: dict[bool, list[tuple[str, float | None]]] = {True: [], False: []}
    for recording in (each for folder in datasets for each in recordings(folder)):
        motion = recording.motion
        for spot, head, wrist in [] if motion is None else windows(motion, seconds):
            if turned({"head": head, "wrist": wrist})[0] < ENOUGH:
                continue
            try:
                found[spot].append((recording.name, offset_by_turning(head, wrist)))
            except WearcapError:
                found[spot].append((recording.name, None))
    for spot, name in ((True, "on the spot, arms hanging"), (False, "others")):
        offsets = np.array([offset for _, offset in found[spot] if offset is not None])
        row = {"windows": name, "number": len(found[spot]), "recordings": len({each for each, _ in found[spot]})}
        row["compared"] = round(len(offsets) / max(len(found[spot]), 1), 3)
        row["compared_recordings"] = len({each for each, offset in found[spot] if offset is not None})
        if len(offsets):
            row["offset_s"] = np.quantile(offsets, [0, 0.05, 0.5, 0.95, 1]).round(3).tolist()
            row["shifted"] = round(float((np.abs(offsets) > LEAST_OFFSET_S).mean()), 4)
        print(json.dumps(row), flush=True)


# --- headings -------------------------------------------------------------------------------------------------------


class Heading(NamedTuple):
    """The heading of one watch."""

    recording: str
    subject: str
    wrist: str
    is_hanging: bool
    """Whether the forearm was hanging when the heading was found."""
    off_deg: float


def replayed(recording: Recording, seed: int) -> ReplaySource:
    """A replay of a recording's head and watches; watches that it lacks are made of its motion."""
    assert recording.motion is not None
    rng, imu = np.random.default_rng(seed), dict(recording.imu)
    for wrist in WRISTS:
        if wrist not in imu:
            imu[wrist] = synthesize_imu(recording.motion, wrist, noise=ImuNoise(), rng=rng)
    return ReplaySource(replace(recording, imu=imu, points=None), MocapEverySession)


def unguided(source: ReplaySource) -> tuple[Setup, float] | None:
    """What the first minute finds, and when (s, the recording's time); None where the recording ends before."""
    first = SetupEstimation(MocapEverySession.devices, tracked=False)
    for time_s, device, sample in source.events():
        if isinstance(sample, WatchSample):
            turn = rotation.about_axis("z", torch.tensor(-YAW_RAD[device]))
            R, acc = turn @ sample.R_world_imu @ WORN[device], turn @ sample.acc_world
            sample = sample._replace(R_world_imu=R, acc_world=acc)
        first.see(device, sample, time_s)
        if first.found is not None:
            return first.found, time_s
    return None


def headings(recording: Recording, seed: int) -> Iterator[Heading]:
    """The headings that the first minute finds of a recording's watches."""
    motion = recording.motion
    if motion is None or recording.head is None or (found := unguided(replayed(recording, seed))) is None:
        return
    setup, time_s = found
    stop = int(torch.searchsorted(motion.timestamps, time_s))
    part = motion.sliced(max(0, stop - round(HOLD_S * motion.fps)), max(stop, 1))
    for seat in setup.seats.values():
        if seat.joint in WRISTS:
            off = math.remainder(seat.yaw_rad - YAW_RAD[seat.joint], 2 * math.pi)
            subject = recording.subject or recording.name
            yield Heading(recording.name, subject, seat.joint, hangs(part, seat.joint), math.degrees(off))


def print_headings(datasets: list[str]) -> None:
    """Print by how much the headings of watches are off after the first minute that is not guided."""
    for folder in datasets:
        found = [each for seed, one in enumerate(recordings(folder, "test")) for each in headings(one, seed)]
        for is_hanging in (True, False):
            group = [each for each in found if each.is_hanging == is_hanging]
            row = {"dataset": Path(folder).name, "arms": "hanging" if is_hanging else "others", "watches": len(group)}
            row |= {
                "recordings": len({each.recording for each in group}),
                "persons": len({each.subject for each in group}),
            }
            if group:
                off = np.abs([each.off_deg for each in group])
                row["off_deg"] = np.quantile(off, [0.5, 0.75, 0.95, 1]).round(1).tolist()
                row["above_20_deg"] = round(float((off > 20).mean()), 3)
                for wrist in WRISTS:
                    own = [each.off_deg for each in group if each.wrist == wrist]
                    row[f"{wrist}_median_deg"] = round(float(np.median(own)), 1) if own else None
            print(json.dumps(row), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("datasets", nargs="*", metavar="DATASET", help="default: those of the figures in the docs")
    parser.add_argument("--seconds", type=float, default=10.0, help="length of a window")
    parser.add_argument("--headings", action="store_true", help="of watches, in place of clocks")
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.headings:
        print_headings(options.datasets or ["datasets/simulated", "datasets/cmu"])
    else:
        print_clocks(options.datasets or ["datasets/cmu"], options.seconds)


if __name__ == "__main__":
    main()
