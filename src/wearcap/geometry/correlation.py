"""How far two signals are shifted against each other: correlation at all shifts, and the best one."""

import numpy as np


def correlate_shifts(a: np.ndarray, b: np.ndarray, least_overlap: float) -> tuple[np.ndarray, np.ndarray]:
    """All shifts (samples) at which at least a share `least_overlap` of the shorter signal overlaps, and Pearson's
    correlation of a[i] with b[i + shift] over the overlap."""
    size = 1 << (len(a) + len(b)).bit_length()
    least = least_overlap * min(len(a), len(b))
    shifts = np.arange(-len(a) + 1, len(b))
    a, b = a - a.mean(), b - b.mean()

    def correlate(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.fft.irfft(np.fft.rfft(x, size).conj() * np.fft.rfft(y, size), size)[shifts]

    one_a, one_b = np.ones_like(a), np.ones_like(b)
    count = correlate(one_a, one_b).round()
    keep = count >= max(least, 1)
    count, mean_a, mean_b = count[keep], correlate(a, one_b)[keep], correlate(one_a, b)[keep]
    covariance = correlate(a, b)[keep] / count - mean_a * mean_b / count**2
    spread_a = correlate(a * a, one_b)[keep] / count - mean_a**2 / count**2
    spread_b = correlate(one_a, b * b)[keep] / count - mean_b**2 / count**2
    return shifts[keep], covariance / np.sqrt(np.maximum(spread_a * spread_b, 1e-12))


def best_shift(shifts: np.ndarray, score: np.ndarray) -> tuple[float, float]:
    """The shift (samples, refined by a parabola) of the highest correlation, and that correlation."""
    best, part = int(score.argmax()), 0.0
    if 0 < best < len(score) - 1:
        left, middle, right = score[best - 1 : best + 2]
        part = 0.5 * (left - right) / min(left - 2 * middle + right, -1e-12)
    return float(shifts[best] + part), float(score[best])
