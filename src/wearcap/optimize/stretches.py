"""Solves long recordings in overlapping stretches: bounded memory, and one stretch per core.

Where the camera is localised, the influence of a frame decays within seconds. A stretch is therefore solved together
with `overlap` localised frames beyond each of its ends, whose solution is discarded.
"""

from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import torch

from wearcap.optimize.banded import DEFAULTS, BandedSettings, solve_banded
from wearcap.optimize.hps import HpsData, HpsEnergy, HpsState
from wearcap.optimize.solution import Solution


def solve_in_stretches(
    energy: HpsEnergy,
    data: HpsData,
    settings: BandedSettings = DEFAULTS,
    stretch: int = 1800,
    overlap: int = 150,
    jobs: int = 2,
) -> Solution:
    """Run `solve_banded` on stretches of about `stretch` frames, `jobs` at a time.

    Borders are never within a localisation outage, and `overlap` counts localised frames. The history is the mean over
    stretches, weighted by their numbers of frames.
    """
    spans = list(_spans(data, stretch, overlap))
    with ThreadPoolExecutor(max_workers=max(jobs, 1)) as pool:
        solved = list(pool.map(lambda span: solve_banded(energy, data[span[0] : span[3]], settings), spans))
    kept = [s.state[keep - first : stop - first] for s, (first, keep, stop, _) in zip(solved, spans)]
    parts = zip(*(vars(state).values() for state in kept))
    length = max(len(s.history) for s in solved)
    history = []
    for step in range(length):
        entries = [(s.history[min(step, len(s.history) - 1)], b - a) for s, (_, a, b, _) in zip(solved, spans)]
        history.append({name: sum(e[name] * n for e, n in entries) / len(data) for name in entries[0][0]})
    return Solution(
        HpsState(*(torch.cat(part) for part in parts)), history, "; ".join(sorted({s.reason for s in solved}))
    )


def _spans(data: HpsData, stretch: int, overlap: int):
    """Frames (first, keep from, keep to, last) of each stretch."""
    localized = (data.hold_confidence > 0).long()
    localized_before = torch.cat([localized.new_zeros(1), localized.cumsum(0)])
    borders = [0]
    while len(data) - borders[-1] > 1.5 * stretch:
        border = borders[-1] + stretch
        while border < len(data) and not localized[border]:
            border += 1
        borders.append(border)
    borders = [b for b in borders if b < len(data)] + [len(data)]
    for keep, stop in pairwise(borders):
        first = int(torch.searchsorted(localized_before, localized_before[keep] - overlap, right=True)) - 1
        last = int(torch.searchsorted(localized_before, localized_before[stop] + overlap))
        yield max(min(first, keep), 0), keep, stop, min(max(last, stop), len(data))
