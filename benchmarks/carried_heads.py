"""How high people carry their heads while upright, as a share of the head joint's height in the rest pose.

    python benchmarks/run.py carried_heads

Data sets whose bones and floors are known. The shares: of frames in which people walk upright on the floor; of frames in
which they stand; of the highest tenth of both, which heights follow from (`tracking.stature`); and of floors, by how much the
one that `tracking.floor.floor_from_path` finds is too low. value: median share over people; baseline: `tracking.floor.CARRIED`,
of which ratio is the multiple: heights and floors that follow from it are that much too large.
"""

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.geometry.trajectory import interpolate_clamped
from wearcap.metrics.gait import SPEED_M_S, standing
from wearcap.recording import Motion, Recording, RecordingStore
from wearcap.tracking.floor import CARRIED, UPRIGHT_WITHIN_S, floor_from_path
from wearcap.tracking.stature import UPRIGHT

KINDS = ("walking", "standing", "highest", "floors")
LEAST_S = 1.0
"""Least time (s) of walking or standing of a person that counts."""
STEP_M = 0.25
"""Height (m) over the floor that the lower foot's joint does not reach while people walk on it."""


def walking(motion: Motion, floor: Float[Tensor, "time"]) -> Bool[Tensor, "time"]:
    """Frames in which somebody walks on the floor, by the pelvis' displacement within a second, with the trunk upright."""
    half = max(round(0.5 * motion.fps), 1)
    pelvis, head = motion.joint("pelvis").t, motion.joint("head").t
    frame = torch.arange(len(motion))
    before, after = (frame - half).clamp(min=0), (frame + half).clamp(max=len(motion) - 1)
    seconds = (motion.timestamps[after] - motion.timestamps[before]).to(pelvis)
    speed = (pelvis[after] - pelvis[before])[:, :2].norm(dim=-1) / seconds.clamp(min=1e-6)
    upright = torch.nn.functional.normalize(head - pelvis, dim=-1)[:, 2] > 0.95
    feet = torch.stack([motion.joint(f"{side}_toe").t[:, 2] for side in ("left", "right")]).amin(0)
    return (speed > SPEED_M_S[0]) & (speed < SPEED_M_S[1]) & upright & ((feet - floor).abs() < STEP_M)


def shares(recording: Recording, legs: float = 1.0) -> dict[str, Float[np.ndarray, "time"]]:
    """Shares by kind of one recording with motion and floor; those of the floor only where it is long enough to be found.

    With legs that many times as long, heads and feet stay where they are, and the head is lower in the rest pose.
    """
    motion, track = recording.motion, recording.floor
    if motion is None or track is None or not len(track.height) or len(motion) < 3:
        return {}
    rest, of = motion.skeleton.rest_joints, motion.skeleton.index
    rest_m = motion.skeleton.height_of("head") - (1 - legs) * (rest[of("left_hip")] - rest[of("left_ankle")])[2].item()
    floor = interpolate_clamped(track.timestamps, track.height, motion.timestamps)
    share = (motion.joint("head").t[:, 2] - floor) / rest_m
    walks, stands = walking(motion, floor), standing(motion)
    found = {"walking": share[walks], "standing": share[stands], "highest": share[walks | stands]}
    found = {kind: value for kind, value in found.items() if len(value) > LEAST_S * motion.fps}
    if "highest" in found:
        found["highest"] = found["highest"].quantile(UPRIGHT)[None]
    if motion.timestamps[-1] - motion.timestamps[0] >= UPRIGHT_WITHIN_S / 3:
        below = floor_from_path(motion.timestamps, motion.joint("head").t, rest_m)
        found["floors"] = (1 + (below - floor) / rest_m).median()[None]
    return {kind: value.numpy() for kind, value in found.items()}


def by_person(folder: Path, split: str | None, legs: float = 1.0) -> dict[str, dict[str, float]]:
    """Median share of each kind by person of a prepared data set, NaN where a person shows none."""
    store, found = RecordingStore.open(folder), defaultdict(lambda: defaultdict(list))
    for name in store.names(split):
        recording = store.load(name)
        for kind, value in shares(recording, legs).items():
            found[recording.subject][kind].append(value)
    return {
        person: {kind: float(np.median(np.concatenate(of[kind]))) if of[kind] else np.nan for kind in KINDS}
        for person, of in found.items()
    }


def measure(folders: Sequence[str] = ("cmu", "hdm05", "simulated"), split: str | None = "train") -> list[dict]:
    figures = []
    for folder in folders:
        people = by_person(Path("datasets") / folder, split)
        for kind in KINDS:
            known = [share[kind] for share in people.values() if np.isfinite(share[kind])]
            if known:
                value = float(np.median(known))
                name, unit = f"carried_heads_{Path(folder).name}_{kind}", f"of the rest pose, {len(known)} people"
                found = {"name": name, "value": value, "unit": unit, "baseline": CARRIED}
                figures.append({**found, "ratio": value / CARRIED, "goal": 1.0})
    return figures
