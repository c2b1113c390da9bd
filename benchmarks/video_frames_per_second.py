"""Videos as `wearcap capture` writes them: truth and capture side by side in a furnished flat, doors and all.

Ten seconds of a simulated minute in which somebody opens doors and moves furniture, at 30 frames a second, two panels of
480 x 400; all of it, from motions to the file. value: frames per second; baseline: 30, the video's own rate. ratio = value / baseline.
"""

import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from wearcap.viewer.picture import write_video
from wearsim.recordings.interaction_session import InteractionConfig, simulate_interactions

FPS = 30.0


def measure(seconds: float = 10.0, repeats: int = 3) -> list[dict]:
    recording, flat = simulate_interactions(InteractionConfig(minutes=1.0), "walk", "val", 0)
    assert recording.motion is not None
    motion = replace(recording.motion, object_motion=recording.object_motion).between(0.0, seconds)
    shown, rates = {"truth": motion, "capture": motion}, []
    with TemporaryDirectory() as folder:
        path = Path(folder) / "motion.mp4"
        write_video(path, shown, environment=flat.environment, max_seconds=0.2)  # compiled
        for _ in range(repeats):
            begin = time.perf_counter()
            write_video(path, shown, environment=flat.environment)
            rates.append((seconds * FPS) / (time.perf_counter() - begin))
    value = sorted(rates)[repeats // 2]
    unit = f"frames/s, two panels, {len(flat.environment)} objects"
    return [
        {
            "name": "video_frames_per_second",
            "value": value,
            "unit": unit,
            "baseline": FPS,
            "ratio": value / FPS,
            "goal": 1.0,
        }
    ]
