"""Long recordings in stretches that overlap: bounded memory, and one stretch per core.

What a frame says fades along time within seconds where the camera is localised. A stretch therefore takes frames
beyond its ends along, as many as hold the motion firmly, and leaves them to its neighbours.
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
    """`solve_banded` over stretches of about `stretch` frames, `jobs` at a time.

    No border lies in an outage of localisation, and `overlap` counts frames that were localised. The history is the
    stretches' mean, by their share of the frames.
    """
    spans = list(_spans(data, stretch, overlap))
    with ThreadPoolExecutor(max_workers=max(jobs, 1)) as pool:
        solved = list(pool.map(lambda span: solve_banded(energy, data[span[0] : span[3]], settings), spans))
    kept = [s.state[keep - first : stop - first] for s, (first, keep, stop, _) in zip(solved, spans)]
    parts = zip(*(vars(state).values() for state in kept))
    length = max(len(s.history) for s in solved)
    history = []
    for step in range(length):
        entries = [
            (s.history[min(step, len(s.history) - 1)], b - a) for s, (_, a, b, _) in zip(solved, spans)
        ]
        history.append({name: sum(e[name] * n for e, n in entries) / len(data) for name in entries[0][0]})
    return Solution(
        HpsState(*(torch.cat(part) for part in parts)), history, "; ".join(sorted({s.reason for s in solved}))
    )


def _spans(data: HpsData, stretch: int, overlap: int):
    """(first, keep from, keep to, last) of each stretch."""
    firm = (data.hold_confidence > 0).long()
    held = torch.cat([firm.new_zeros(1), firm.cumsum(0)])
    borders = [0]
    while len(data) - borders[-1] > 1.5 * stretch:
        border = borders[-1] + stretch
        while border < len(data) and not firm[border]:
            border += 1
        borders.append(border)
    borders = [b for b in borders if b < len(data)] + [len(data)]
    for keep, stop in pairwise(borders):
        first = int(torch.searchsorted(held, held[keep] - overlap, right=True)) - 1
        last = int(torch.searchsorted(held, held[stop] + overlap))
        yield max(min(first, keep), 0), keep, stop, min(max(last, stop), len(data))
