"""Windows of 240 frames of four tensors from the store, against the same windows from compressed npz.

One 15-minute recording at 60 Hz; both files are warm in the page cache and opened beforehand. An npz member can only be
unpacked whole, which is what the store avoids. value and baseline: median ms per window. ratio = baseline / value,
to be at least `goal`.
"""

import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import planted

from wearcap.recording.store import RecordingFile

WINDOW = 240
KEYS = ("motion.R_parent_joint", "motion.t_world_root", "head.R_world_device", "head.t_world_device")
MINUTES = 15.0


def measure(minutes: float = MINUTES, windows: int = 200, npz_windows: int = 5) -> list[dict]:
    with tempfile.TemporaryDirectory() as folder:
        store = planted.write_store(folder, (60 * minutes,))
        file = RecordingFile(store.path_of("swing_0"))
        packed = Path(folder) / "recording.npz"
        np.savez_compressed(packed, **{key: file.tensor(key).numpy() for key in KEYS})
        archive = np.load(packed)
        starts = np.random.default_rng(0).integers(0, file.length(KEYS[0]) - WINDOW, windows).tolist()
        from_store = lambda start: [file.window(key, start, start + WINDOW) for key in KEYS]  # noqa: E731
        from_npz = lambda start: [archive[key][start : start + WINDOW] for key in KEYS]  # noqa: E731
        for ours, theirs in zip(from_store(starts[0]), from_npz(starts[0])):
            np.testing.assert_array_equal(ours.numpy(), theirs)
        baseline = _median_ms(from_npz, starts[:npz_windows])
        value = _median_ms(from_store, starts)
    return [
        {
            "name": "windows_vs_npz",
            "value": value,
            "unit": "ms per window",
            "baseline": baseline,
            "ratio": baseline / value,
            "goal": 20.0,
        }
    ]


def _median_ms(load: Callable, starts: list[int]) -> float:
    times = []
    for start in starts:
        begin = time.perf_counter()
        load(start)
        times.append(time.perf_counter() - begin)
    return 1000 * statistics.median(times)
