"""Offset of clocks that turns show although there is none: people turn their head before the body.

    python benchmarks/live_turns.py [DATASET ...] [--seconds 10]

Head and wrists of recorded motion, on one clock, are compared as the guided first minute of a live capture does
(`wearcap.live.clock_offset`), in windows a second apart in which both have turned to both sides. Prints one JSON line for
windows of people at one place with hanging arms, and one for all others: numbers of windows and recordings, the share that
is compared at all, quantiles (0, 5, 50, 95, 100 %) of the offset (s) found, and the share that is not left alone.
"""

import argparse
import json

import numpy as np
import torch

from wearcap.body.skeleton import WRISTS
from wearcap.errors import WearcapError
from wearcap.geometry.trajectory import Trajectory
from wearcap.live.clock_offset import LEAST_OFFSET_S, offset_by_turning, turned
from wearcap.recording import Motion
from wearcap.recording.store import dataset_folder, load_recording

SPOT_M, HANGING = 1.0, 0.6
"""Largest distance (m) of the pelvis from its median, and least downward component of a hanging forearm."""
ENOUGH = 0.99
"""Share of the turning; the first minute also waits until the wearer rests."""


def windows(motion: Motion, seconds: float):
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
            pose = part.joint(wrist)
            forearm = torch.nn.functional.normalize(pose.t - part.joint(wrist.replace("wrist", "elbow")).t, dim=-1)
            hangs = (forearm[:, 2] < -HANGING).float().mean().item() > 0.7
            yield stays and hangs, *(Trajectory(part.timestamps, each.R, each.t) for each in (head, pose))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("datasets", nargs="*", default=["datasets/cmu"], metavar="DATASET")
    parser.add_argument("--seconds", type=float, default=10.0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    found: dict[bool, list[tuple[str, float | None]]] = {True: [], False: []}
    for folder in options.datasets:
        for path in sorted((dataset_folder(folder) / "recordings").iterdir()):
            motion = load_recording(path).motion
            for spot, head, wrist in [] if motion is None else windows(motion, options.seconds):
                if turned({"head": head, "wrist": wrist})[0] < ENOUGH:
                    continue
                try:
                    found[spot].append((path.stem, offset_by_turning(head, wrist)))
                except WearcapError:
                    found[spot].append((path.stem, None))
    for spot, name in ((True, "on the spot, arms hanging"), (False, "others")):
        offsets = np.array([offset for _, offset in found[spot] if offset is not None])
        row = {"windows": name, "number": len(found[spot]), "recordings": len({each for each, _ in found[spot]})}
        row["compared"] = round(len(offsets) / max(len(found[spot]), 1), 3)
        row["compared_recordings"] = len({each for each, offset in found[spot] if offset is not None})
        if len(offsets):
            row["offset_s"] = np.quantile(offsets, [0, 0.05, 0.5, 0.95, 1]).round(3).tolist()
            row["shifted"] = round(float((np.abs(offsets) > LEAST_OFFSET_S).mean()), 4)
        print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
