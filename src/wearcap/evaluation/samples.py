"""Several samples of one input: the best of them, and how far they are apart."""

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from wearcap.evaluation.evaluate import Measure
from wearcap.metrics.position import mpjpe_cm
from wearcap.metrics.table import Row
from wearcap.recording import Motion
from wearcap.runtime.system import CaptureInput

DIVERSITY = "diversity_cm"
"""Score of the mean distance (cm) of a joint in two samples, in one frame."""


class Spread:
    """A measure that also scores how far a motion is on average from those of the same recording that came before it."""

    def __init__(self, measure: Measure):
        self._measure, self._before = measure, ("", list[Float[Tensor, "time joint 3"]]())

    def __call__(self, motion: Motion, source: CaptureInput, seed: int) -> Row:
        row, joints = self._measure(motion, source, seed), motion.T_world_joint.t
        before = self._before[1] if self._before[0] == row.recording else []
        self._before, apart = (row.recording, [*before, joints]), [mpjpe_cm(joints, other).item() for other in before]
        return replace(row, scores=row.scores | {DIVERSITY: sum(apart) / len(apart) if apart else math.nan})


def best_samples(rows: Sequence[Row]) -> list[Row]:
    """Of each recording the sample with the least main error, which comes first in all scores, and the mean distance of all
    pairs of its samples. The seeds' order must be that of the rows."""
    of_recording: defaultdict[str, list[Row]] = defaultdict(list)
    for row in rows:
        of_recording[row.recording].append(row)
    found = []
    for samples in of_recording.values():
        best = min(samples, key=lambda row: next(iter(row.scores.values())))
        pairs = sum(number * row.scores[DIVERSITY] for number, row in enumerate(samples) if number)
        diversity = pairs / (len(samples) * (len(samples) - 1) / 2)
        found.append(replace(best, seed=0, scores=best.scores | {DIVERSITY: diversity}))
    return found
