"""HMD² and ECHO with the hands that a head-mounted device sees: errors without hands, with those in view, and with all.

    python benchmarks/hands_in_view.py [--datasets datasets/cmu datasets/hdm05] [--split test] [--checkpoint hmd2|echo_gaps]

Hands are true wrists, in view within 55 degrees to either side of the head's axis and 45 degrees above or below 15 degrees
under it; the head alone beside them. Recordings of two seconds or more, means over frames. ECHO sees every hand in the first
two frames, since it takes a recording without any for one whose true wrists it may use; its errors are not anchored.
"""

import argparse
import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.body.skeleton import WRISTS
from wearcap.cli.conf import compose, load_pipeline
from wearcap.geometry.trajectory import Trajectory
from wearcap.recording import Recording, RecordingStore
from wearcap.runtime.system import CaptureInput

ACROSS_DEG, UPRIGHT_DEG, DOWN_DEG = 55.0, 45.0, 15.0
LEAST_FRAMES = 120
ERRORS, CERTAINTY = ("mpjpe", "hand_pe", "lower_pe"), ("within_68", "within_95")


def in_view(t_head_wrist: Float[Tensor, "time 3"]) -> Bool[Tensor, "time"]:
    """Whether a wrist in the head's axes is inside the field of view."""
    forward, left, up = t_head_wrist.unbind(-1)
    across, upright = torch.atan2(left, forward).rad2deg().abs(), torch.atan2(up, forward).rad2deg() + DOWN_DEG
    return (across < ACROSS_DEG) & (upright.abs() < UPRIGHT_DEG)


def with_hands(recording: Recording, first: int = 0) -> Iterator[tuple[str, Recording, float]]:
    """The head's recording without hands, with those in view, and with all; and which share of the time each is there.

    In the `first` frames every hand is.
    """
    head, motion = recording.head, recording.motion
    assert head is not None
    assert motion is not None
    for kind in ("none", "in view", "all"):
        tracked, shares = {}, []
        for joint in WRISTS:
            T = motion.joint(joint)
            local = (head.T_world_head.R.mT @ (T.t - head.T_world_head.t)[..., None])[..., 0]
            seen = in_view(local) if kind == "in view" else torch.full((len(motion),), kind == "all")
            seen[:first] = True
            shares.append(seen.float().mean().item())
            if seen.any():
                tracked[joint] = Trajectory(head.timestamps[seen], T.R[seen], T.t[seen])
        yield kind, replace(recording, tracked=tracked, points=None, camera=None), sum(shares) / len(shares)


def errors_of(scores: dict[str, float]) -> list[float]:
    """Errors (cm) of scores in cm or mm, and shares within the deviations that HMD² gives."""
    cm = [scores.get(f"{name}_cm", 0.1 * scores.get(f"{name}_mm", math.nan)) for name in ERRORS]
    return [*cm, *(scores.get(name, math.nan) for name in CERTAINTY)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--datasets", type=Path, nargs="+", default=[Path("datasets/cmu"), Path("datasets/hdm05")], metavar="DIR"
    )
    parser.add_argument("--split", default="test")
    parser.add_argument("--checkpoint", default="hmd2")
    options = parser.parse_args()
    echo = options.checkpoint.startswith("echo")
    chosen = [f"pipeline={'echo' if echo else 'hmd2'}", f"checkpoint={options.checkpoint}"]
    config = compose("capture", ["recording=none", *chosen])
    system = load_pipeline(options.checkpoint, config.pipeline, "cpu")
    for root in options.datasets:
        store, rows = RecordingStore.open(root), defaultdict(list)
        for name in store.names(options.split):
            recording = store.load(name)
            if recording.head is None or recording.motion is None or len(recording.motion) < LEAST_FRAMES:
                continue
            for kind, given, share in with_hands(recording, 2 if echo else 0):
                source = CaptureInput.in_dataset(given, store.root)
                row = system.score(system(source), source, 0)
                rows[kind].append([row.frames, 100 * share, *errors_of(row.scores)])
        for kind, found in rows.items():
            frames, *values = torch.tensor(found, dtype=torch.float64).unbind(1)
            means = [((value * frames).sum() / frames.sum()).item() for value in values]
            names = ("there %", *(f"{name}_cm" for name in ERRORS), *CERTAINTY)
            shown = ", ".join(f"{name} {mean:.2f}" for name, mean in zip(names, means) if not math.isnan(mean))
            print(f"{root.name} {options.split}, {len(found)} recordings, hands {kind}: {shown}", flush=True)


if __name__ == "__main__":
    main()
