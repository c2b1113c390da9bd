"""HMD² with the hands that a head-mounted device sees: errors without hands, with those in view, and with all of them.

    python benchmarks/hands_in_view.py [--datasets datasets/cmu datasets/hdm05] [--split test] [--checkpoint hmd2]

Hands are true wrists, in view within 55 degrees to either side of the head's axis and 45 degrees above or below 15 degrees
under it; the head alone beside them. Recordings of two seconds or more, means over frames.
"""

import argparse
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
SCORES = ("mpjpe_cm", "hand_pe_cm", "lower_pe_cm", "within_68", "within_95")


def in_view(t_head_wrist: Float[Tensor, "time 3"]) -> Bool[Tensor, "time"]:
    """Whether a wrist in the head's axes is inside the field of view."""
    forward, left, up = t_head_wrist.unbind(-1)
    across, upright = torch.atan2(left, forward).rad2deg().abs(), torch.atan2(up, forward).rad2deg() + DOWN_DEG
    return (across < ACROSS_DEG) & (upright.abs() < UPRIGHT_DEG)


def with_hands(recording: Recording) -> Iterator[tuple[str, Recording, float]]:
    """The head's recording without hands, with those in view, and with all; and which share of the time each is there."""
    head, motion = recording.head, recording.motion
    assert head is not None
    assert motion is not None
    for kind in ("none", "in view", "all"):
        tracked, shares = {}, []
        for joint in WRISTS:
            T = motion.joint(joint)
            local = (head.T_world_head.R.mT @ (T.t - head.T_world_head.t)[..., None])[..., 0]
            seen = in_view(local) if kind == "in view" else torch.full((len(motion),), kind == "all")
            shares.append(seen.float().mean().item())
            if seen.any():
                tracked[joint] = Trajectory(head.timestamps[seen], T.R[seen], T.t[seen])
        yield kind, replace(recording, tracked=tracked, points=None, camera=None), sum(shares) / len(shares)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--datasets", type=Path, nargs="+", default=[Path("datasets/cmu"), Path("datasets/hdm05")], metavar="DIR"
    )
    parser.add_argument("--split", default="test")
    parser.add_argument("--checkpoint", default="hmd2")
    options = parser.parse_args()
    config = compose("capture", ["recording=none", "pipeline=hmd2", f"checkpoint={options.checkpoint}"])
    system = load_pipeline(options.checkpoint, config.pipeline, "cpu")
    for root in options.datasets:
        store, rows = RecordingStore.open(root), defaultdict(list)
        for name in store.names(options.split):
            recording = store.load(name)
            if recording.head is None or recording.motion is None or len(recording.motion) < LEAST_FRAMES:
                continue
            for kind, given, share in with_hands(recording):
                source = CaptureInput.in_dataset(given, store.root)
                row = system.score(system(source), source, 0)
                rows[kind].append([row.frames, 100 * share, *(row.scores[score] for score in SCORES)])
        for kind, found in rows.items():
            frames, *values = torch.tensor(found, dtype=torch.float64).unbind(1)
            means = [((value * frames).sum() / frames.sum()).item() for value in values]
            shown = ", ".join(f"{name} {mean:.2f}" for name, mean in zip(("there %", *SCORES), means))
            print(f"{root.name} {options.split}, {len(found)} recordings, hands {kind}: {shown}", flush=True)


if __name__ == "__main__":
    main()
