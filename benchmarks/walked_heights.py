"""Heights that follow from how high the head is carried, and from the walk too: knees in stance, joints and the height itself.

    python benchmarks/walked_heights.py [--checkpoint echo] [--clips 2] DATASET …

Clips of 6 to 40 s with two walking cycles or more, at most so many of a person; their skeletons are taken away, wrists are
the true ones. Prints a line for each clip, and the means.
"""

import argparse
from collections import Counter
from dataclasses import replace

import torch

import wearcap
from wearcap.body.skeleton import WRISTS, skeleton_of_height, xsens23
from wearcap.geometry.trajectory import Trajectory
from wearcap.metrics.gait import cycle_times, walking_scores
from wearcap.recording import Motion, RecordingStore
from wearcap.runtime.system import CaptureInput
from wearcap.runtime.walked_stature import LEAST_CYCLES, with_walked_stature
from wearcap.tracking.stature import with_stature


def knee_deg(motion: Motion) -> float:
    return float(walking_scores(motion, cycle_times(motion))["stance_knee_deg"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("datasets", nargs="+")
    parser.add_argument("--checkpoint", default="echo")
    parser.add_argument("--clips", type=int, default=2)
    parser.add_argument("--splits", nargs="+", default=["val", "test"])
    options = parser.parse_args()
    system, body, rows = wearcap.load(options.checkpoint), xsens23(), []
    ratio = skeleton_of_height(1.0, body).height_of("head")
    for dataset in options.datasets:
        store, done = RecordingStore.open(dataset), Counter[str]()
        for name in (name for split in options.splits for name in store.names(split)):
            whole = store.load(name)
            truth, subject = whole.motion, whole.subject or ""
            if truth is None or whole.floor is None or done[subject] >= options.clips:
                continue
            if not 6 <= whole.duration_s <= 40 or sum(map(len, cycle_times(truth))) < LEAST_CYCLES:
                continue
            wrists = {
                joint: Trajectory(truth.timestamps, truth.joint(joint).R, truth.joint(joint).t) for joint in WRISTS
            }
            recording, found = with_stature(replace(whole, skeleton=None, motion=None, shape={}, tracked=wrists), body)
            first = CaptureInput(recording)
            walked, height = with_walked_stature(system, first, found, body)
            if height.source != "walk":
                continue
            true_m, row = truth.skeleton.height_of("head") / ratio, [knee_deg(truth)]
            for source, stature in ((first, found), (walked, height)):
                (capture,) = system.capture([source], [0])
                assert capture.motion is not None
                near = torch.searchsorted(truth.timestamps, capture.motion.timestamps - 1e-4).clamp(max=len(truth) - 1)
                off = (capture.motion.T_world_joint.t - truth.T_world_joint.t[near]).norm(dim=-1).mean().item()
                row += [knee_deg(capture.motion), 100 * off, 100 * abs(stature.height_m - true_m)]
            done[subject] += 1
            rows.append(row)
            knee, head, walk = row[0], row[1:4], row[4:]
            print(f"{name}: knee {knee:.0f}°; by the head {head[0]:.0f}°, {head[1]:.1f} cm, height {head[2]:.1f} cm off; "
                  f"by the walk {walk[0]:.0f}°, {walk[1]:.1f} cm, {walk[2]:.1f} cm", flush=True)  # fmt: skip
    table = torch.tensor(rows)
    table[:, [1, 4]] = (table[:, [1, 4]] - table[:, :1]).abs()
    mean = table.mean(0).tolist()
    print(f"{len(rows)} clips, off by: the head {mean[1]:.1f}°, {mean[2]:.2f} cm, height {mean[3]:.1f} cm; "
          f"the walk {mean[4]:.1f}°, {mean[5]:.2f} cm, {mean[6]:.1f} cm")  # fmt: skip


if __name__ == "__main__":
    main()
