"""OMOMO: the user's own download, a recording and an environment per sequence."""

import hashlib
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

from wearcap.errors import WearcapError
from wearcap.io.datasets.omomo import OmomoSequence, omomo_mesh_path, omomo_take, read_omomo
from wearcap.prepare.clean import foot_patches
from wearcap.prepare.engine import Task, content_hash
from wearcap.prepare.mocap import About, MocapSettings, on_xsens23
from wearcap.prepare.one_object import one_object_recording
from wearcap.prepare.splits import Splits
from wearcap.recording.motion import Motion
from wearcap.recording.recording import Recording

VERSION = 1
"""Version of the conversion, increased when the same source and settings yield another recording."""

LOOKED_AT = 20
"""Number of evenly chosen sequences whose speeds are used to check the frame rate."""
FAST_PELVIS, FAST_FOOT = 2.5, 9.0
"""Speeds (m/s) that nobody carrying objects exceeds for long: 95th percentile of the pelvis, 99th of the toes."""
SLOW_PELVIS, SLOW_FOOT = 0.4, 1.2
"""Speeds (m/s) of pelvis and toes, one of which any walking person exceeds; a step lifts a foot at some 3 m/s."""
WALKED_M = 1.0
"""Least walked distance (m) of sequences from which too low a rate can be concluded."""


@dataclass(frozen=True, eq=False)
class OmomoTake:
    """One sequence with its arrays, as the common file is read once; picklable, callable as a task."""

    root: Path
    sequence: OmomoSequence
    source_fps: float | int
    settings: MocapSettings
    license: str
    output: Path

    def __call__(self) -> Recording:
        """Recording of body and object with the floor at z = 0; the environment is written beside it."""
        take = omomo_take(self.sequence, self.root, self.source_fps)
        about = About(take.name, take.subject, "OMOMO", self.license, take.activity)
        return one_object_recording(take, about, self.settings, self.output)


def omomo_tasks(
    source: str | Path,
    output: str | Path,
    splits: Splits,
    settings: MocapSettings,
    source_fps: float | int,
    license: str,
) -> list[Task]:
    """One task per sequence of `source`'s files; environments go to `output`/scenes.

    `source_fps` is the frame rate, which the files lack. Raises WearcapError without sequences, for a rate that is no
    positive number, and for one at which the people would not move at human speeds.
    """
    source = Path(source)
    if not 0 < source_fps < 1e4:
        raise WearcapError(f"a frame rate of {source_fps} Hz", expected="source_fps=30 or another positive number")
    sequences = read_omomo(source)
    check_rate(sequences, source, source_fps)
    shared = content_hash(asdict(settings), float(source_fps), license, VERSION)
    meshes = {sequence.object_name: omomo_mesh_path(source, sequence.object_name) for sequence in sequences}
    of_mesh = {name: content_hash(path) if path.is_file() else "" for name, path in meshes.items()}
    tasks = []
    for sequence in sequences:
        make = OmomoTake(source, sequence, source_fps, settings, license, Path(output))
        settings_hash = content_hash(sequence.name, shared, of_mesh[sequence.object_name], _digest(sequence))
        tasks.append(Task(sequence.name, make, splits.of(sequence.subject), settings_hash))
    return tasks


def check_rate(sequences: list[OmomoSequence], root: str | Path, fps: float | int) -> None:
    """Raise WearcapError if, at this frame rate, people would run all the time or walk in slow motion.

    The check uses medians over `LOOKED_AT` sequences of the speeds of pelvis and toes; unreadable sequences are
    reported by their own tasks.
    """
    speeds = []
    for index in sorted({int(k) for k in np.linspace(0, len(sequences) - 1, LOOKED_AT)}):
        try:
            motion = omomo_take(sequences[index], root, fps).motion
        except WearcapError:
            continue
        if len(motion) > 2:
            speeds.append(walking_speeds(motion))
    if not speeds:
        return
    pelvis, foot, walked = np.median(np.array(speeds), axis=0)
    fast = pelvis > FAST_PELVIS or foot > FAST_FOOT
    slow = walked > WALKED_M and pelvis < SLOW_PELVIS and foot < SLOW_FOOT
    if fast or slow:
        raise WearcapError(
            f"at {fps:g} frames per second people walk at {pelvis:.2f} m/s and swing their feet at {foot:.2f} m/s",
            where=root,
            expected="some 1 and 3 m/s",
            fix=f"The true rate is {'lower' if fast else 'higher'} (public loaders use 30 or 120): give it as source_fps=….",
        )


def walking_speeds(motion: Motion) -> tuple[float, float, float]:
    """Speed over ground of the pelvis (95th percentile, m/s) and of the faster toes (99th), and the walked distance (m)."""
    motion = on_xsens23(motion)
    _, foot = foot_patches(motion)
    steps = motion.t_world_root[:, :2].diff(dim=0).norm(dim=-1)
    pelvis = steps / motion.timestamps.diff().to(steps.dtype)
    return (float(torch.quantile(pelvis, 0.95)), float(torch.quantile(foot.amax(1), 0.99)), float(steps.sum()))


def _digest(sequence: OmomoSequence) -> str:
    """Hash of one sequence's arrays alone, so that changes of others do not make it out of date."""
    digest = hashlib.sha256()
    for key, array in sorted(sequence.arrays.items()):
        digest.update(f"{key} {array.dtype} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
