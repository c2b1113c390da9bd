"""Several samples of one input: the best of each recording, and how far its samples are apart."""

from dataclasses import replace
from itertools import combinations

import pytest
import torch

from wearcap.cli.conf import sampling
from wearcap.errors import WearcapError
from wearcap.evaluation.datasets import scored
from wearcap.evaluation.samples import DIVERSITY, best_samples
from wearcap.metrics.table import aggregate
from wearcap.recording import RecordingStore
from wearcap.runtime.system import Captured, CaptureInput, System
from wearcap_testing import recording_of, swaying_motion

SAMPLES = 4


class Drawing(System):
    """The truth with every joint but the root's off along x, by an amount that depends on the recording and the seed."""

    name = "drawing"

    def __init__(self):
        self.off: dict[tuple[str, int], float] = {}

    def capture(self, recordings, seeds, options=None):
        found = []
        for source, seed in zip(map(CaptureInput.of, recordings), seeds):
            truth, random = (
                source.recording.motion,
                torch.Generator().manual_seed(100 * len(source.recording.name) + seed),
            )
            off = self.off[source.recording.name, seed] = torch.rand(1, generator=random).item()
            moved = replace(truth)
            pose = truth.T_world_joint
            away = torch.tensor([off, 0.0, 0.0])
            moved.__dict__["T_world_joint"] = replace(pose, t=pose.t + away)
            found.append(Captured(moved))
        return found

    def score(self, motion, source, seed):
        row = super().score(replace(motion), source, seed)  # of the truth itself, which is not off
        return replace(row, scores={"mpjpe_cm": 100 * self.off[row.recording, seed], "seed": float(seed)})


def test_of_every_recording_the_best_sample_counts_and_pairs_are_apart(tmp_path):
    store, system = RecordingStore(tmp_path), Drawing()
    for name, frames in (("one", 40), ("three", 20)):
        store.add(recording_of(swaying_motion(frames), name), split="test", config_hash="")
    outcomes = scored(
        ["one", "three"],
        system=lambda: system,
        key=str(tmp_path),
        root=tmp_path,
        seeds=range(SAMPLES),
        batch_size=3,
        samples=True,
    )
    best = {row.recording: row for row in best_samples([row for each in outcomes for row in each.rows])}
    for name, row in best.items():
        off = [system.off[name, seed] for seed in range(SAMPLES)]
        assert row.scores["mpjpe_cm"] == pytest.approx(100 * min(off))
        assert off[int(row.scores["seed"])] == min(off)
        pairs = [abs(a - b) for a, b in combinations(off, 2)]
        assert row.scores[DIVERSITY] == pytest.approx(100 * sum(pairs) / len(pairs), rel=1e-4)
    means = aggregate(list(best.values()))
    expected = (40 * best["one"].scores["mpjpe_cm"] + 20 * best["three"].scores["mpjpe_cm"]) / 60
    assert means["mpjpe_cm"].mean == pytest.approx(expected)


def test_a_system_without_samples_says_so():
    with pytest.raises(WearcapError, match="draws none"):
        sampling(Drawing())
