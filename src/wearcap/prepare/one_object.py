"""People who handle one object, BEHAVE and OMOMO: a recording with the object's path, and its environment."""

import hashlib
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.data.objects import object_class
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import Trajectory, resample
from wearcap.io.datasets.behave import BODY_FILE, INFO_FILE, OBJECT_FILE, behave_folder, behave_names, read_behave
from wearcap.io.datasets.omomo import OmomoSequence, omomo_mesh_path, omomo_take, read_omomo
from wearcap.io.datasets.one_object import OneObject
from wearcap.io.formats.environment import FILE_NAME, write_environment
from wearcap.prepare.engine import NOTE, Splits, Task, content_hash
from wearcap.prepare.mocap import About, MocapSettings, foot_patches, mocap_recording, on_xsens23, without_glitches
from wearcap.recording.recording import Recording
from wearcap.scene.objects import Environment, Freedom, SceneObject

VERSION = 2
"""Version of both conversions, increased when the same source and settings yield another recording."""

LOOKED_AT = 20
"""Number of evenly chosen sequences whose speeds are used to check the frame rate."""
FAST_PELVIS, FAST_FOOT = 2.5, 9.0
"""Speeds (m/s) that nobody carrying objects exceeds for long: 95th percentile of the pelvis, 99th of the toes."""
SLOW_PELVIS, SLOW_FOOT = 0.4, 1.2
"""Speeds (m/s) of pelvis and toes, one of which any walking person exceeds; a step lifts a foot at some 3 m/s."""
WALKED_M = 1.0
"""Least walked distance (m) of sequences from which too low a rate can be concluded."""
MAX_GAP_S = 0.2
"""Longest gap (s) that is interpolated; at longer ones the take is cut."""
MAX_TILT_DEG = 30.0
"""Largest tilt of the floor; beyond it the axes are not the documented ones."""

_KNOWN_WITHIN_M = 0.1
"""Spread (m, standard deviation) of foot positions at which half of the measured tilt is applied; nearly all if wider."""
_ROBUST_M = (1.0, 0.03)
"""Distance (m) from the floor at which a step has half weight, in the first and in the last iteration."""
_ROUNDS = 20
_MIN_STEPS = 10
_UPSIDE_DOWN_M = 0.2


def _one_object(
    read: Callable[[], OneObject], source: str, license: str, settings: MocapSettings, output: str | Path
) -> Recording:
    """Like `mocap_recording`, with the object's path on the motion's clock and an environment of that one object.

    The environment is written to `output`/scenes/NAME; the object is free to move and handled throughout, so there
    are no `interactions`. Of the segments between gaps and glitches the longest is kept, as noted in the motion's
    provenance. Raises WearcapError for an object of unknown class and for a body that is upside down.
    """
    take = read()
    about, kind = About(take.name, take.subject, source, license, take.activity), object_class(take.object_name)
    kept, cut, frames = take, "", len(take.motion)
    gaps = (take.motion.timestamps.diff() > MAX_GAP_S).nonzero()[:, 0].tolist()
    if gaps:
        edges = [0, *(frame + 1 for frame in gaps), frames]
        start, stop = max(pairwise(edges), key=lambda span: span[1] - span[0])
        kept = take.frames(slice(start, stop))
        cut = f"kept frames {start} to {stop - 1} of {frames}: {len(gaps)} gaps of more than {MAX_GAP_S} s"
    motion, note = without_glitches(on_xsens23(kept.motion), settings.limits)
    feet = torch.stack([motion.joint(f"{side}_ankle").t[:, 2] for side in ("left", "right")]).mean(0)
    above = float((motion.joint("head").t[:, 2] - feet).median())
    if above < -_UPSIDE_DOWN_M:
        what = f"the head is {-above:.2f} m below the feet"
        fix = "The source's axes are others than published."
        raise WearcapError(what, where=about.name, expected="a world whose z is up", fix=fix)
    recording = mocap_recording(motion, about, settings)
    assert recording.motion is not None
    notes = "; ".join(text for text in (cut, note) if text)
    provenance = recording.motion.provenance | ({NOTE: notes} if notes else {})
    after = recording.motion  # the object's path goes to its clock, with the same shift by the floor's height
    track = resample(kept.path, motion.timestamps[0] + after.timestamps)
    shift = after.t_world_root[0] - motion.t_world_root[0]
    path = Trajectory(after.timestamps, track.R_world_body, track.t_world_body + shift)
    item = SceneObject(take.object_name, kind, take.mesh, path.R_world_body[0], path.t_world_body[0], Freedom("free"))
    file = Path("scenes") / about.name / FILE_NAME
    write_environment(Environment((item,)), Path(output) / file)
    return replace(
        recording,
        motion=replace(recording.motion, provenance=provenance),
        object_motion={take.object_name: path},
        environment=file.as_posix(),
        shape=take.shape,
        location=take.location,
    )


def _ground_rotation(points_world: Float[Tensor, "point 3"]) -> Float[Tensor, "3 3"]:
    """Smallest rotation that levels the plane through positions of planted feet.

    The plane z = a·x + b·y + c is fitted robustly: points off it (feet on a step, on a chair's rung) lose their weight,
    and slopes are regularised towards 0 if the feet stayed in one place. Too few points give no rotation.
    """
    if len(points_world) < _MIN_STEPS:
        return torch.eye(3, dtype=points_world.dtype)
    points = points_world.double()
    weight = torch.ones(len(points), dtype=torch.float64)
    slope = torch.zeros(2, dtype=torch.float64)
    first, last = _ROBUST_M
    for step in range(_ROUNDS):
        share = (weight / weight.sum())[:, None]
        offset = points - (share * points).sum(0)
        plan, height = offset[:, :2], offset[:, 2]
        spread = plan.mT @ (share * plan) + _KNOWN_WITHIN_M**2 * torch.eye(2, dtype=torch.float64)
        slope = torch.linalg.solve(spread, plan.mT @ (share[:, 0] * height))
        scale = max(last, first * (last / first) ** (2 * step / _ROUNDS))
        weight = 1 / (1 + ((height - plan @ slope) / scale) ** 2)
    normal = torch.cat([-slope, torch.ones(1, dtype=torch.float64)])
    normal = normal / normal.norm()
    axis = torch.stack([normal[1], -normal[0], torch.zeros((), dtype=torch.float64)])
    angle = torch.arccos(normal[2].clamp(max=1.0))
    return rotation.exp(axis / axis.norm().clamp(min=1e-12) * angle).to(points_world.dtype)


def _level_behave(root: Path, name: str, settings: MocapSettings) -> OneObject:
    """A take, rotated so that the ground below the planted feet is level; provenance notes the tilt.

    Raises WearcapError for a ground tilted by more than `MAX_TILT_DEG`.
    """
    take = read_behave(root, name)
    motion = on_xsens23(take.motion)
    positions, speed = foot_patches(motion)
    R = _ground_rotation(positions[speed < settings.limits.contact_speed])
    tilt = float(torch.rad2deg(torch.arccos(R[2, 2].clamp(max=1.0))))
    if tilt > MAX_TILT_DEG:
        what = f"the ground below the feet is tilted by {tilt:.0f}°"
        fix = "Check which of the source's axes is up."
        raise WearcapError(what, where=take.name, expected=f"at most {MAX_TILT_DEG:g}°", fix=fix)
    motion = replace(motion, provenance=motion.provenance | {"tilt_deg": f"{tilt:.2f}"})
    return replace(take, motion=motion).turned(R)


def behave_tasks(
    source: str | Path, output: str | Path, splits: Splits, settings: MocapSettings, license: str
) -> list[Task]:
    """One task per sequence of `source`; environments go to `output`/scenes. The split list's rows are sequences.

    Raises WearcapError without sequences.
    """
    source = Path(source)
    meshes = sorted(source.glob("objects/*/*_f*.ply"))
    shared = content_hash(asdict(settings), license, VERSION, *meshes)
    tasks, sequences = [], behave_folder(source)
    for name in behave_names(source):
        files = [sequences / name / file for file in (BODY_FILE, OBJECT_FILE, INFO_FILE)]
        key = content_hash(name, shared, *(file for file in files if file.is_file()))
        read = partial(_level_behave, source, name, settings)
        make = partial(_one_object, read, "BEHAVE", license, settings, Path(output))
        tasks.append(Task(name, make, splits.of(name), key))
    return tasks


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
    _check_rate(sequences, source, source_fps)
    shared = content_hash(asdict(settings), float(source_fps), license, VERSION)
    meshes = {sequence.object_name: omomo_mesh_path(source, sequence.object_name) for sequence in sequences}
    of_mesh = {name: content_hash(path) if path.is_file() else "" for name, path in meshes.items()}
    tasks = []
    for sequence in sequences:
        arrays = hashlib.sha256()  # of this sequence alone, so that changes of others do not make it out of date
        for name, array in sorted(sequence.arrays.items()):
            arrays.update(f"{name} {array.dtype} {array.shape}".encode())
            arrays.update(np.ascontiguousarray(array).tobytes())
        key = content_hash(sequence.name, shared, of_mesh[sequence.object_name], arrays.hexdigest())
        read = partial(omomo_take, sequence, source, source_fps)
        make = partial(_one_object, read, "OMOMO", license, settings, Path(output))
        tasks.append(Task(sequence.name, make, splits.of(sequence.subject), key))
    return tasks


def _check_rate(sequences: list[OmomoSequence], root: str | Path, fps: float | int) -> None:
    """Raise WearcapError if, at this frame rate, people would run all the time or walk in slow motion.

    The check uses medians over `LOOKED_AT` sequences of the speeds over ground of the pelvis (95th percentile) and of
    the faster toes (99th); unreadable sequences are reported by their own tasks.
    """
    speeds = []
    for index in sorted({int(k) for k in np.linspace(0, len(sequences) - 1, LOOKED_AT)}):
        try:
            motion = omomo_take(sequences[index], root, fps).motion
        except WearcapError:
            continue
        if len(motion) > 2:
            motion = on_xsens23(motion)
            steps = motion.t_world_root[:, :2].diff(dim=0).norm(dim=-1)
            speed = torch.quantile(steps / motion.timestamps.diff().to(steps.dtype), 0.95)
            toes = torch.quantile(foot_patches(motion)[1].amax(1), 0.99)
            speeds.append((float(speed), float(toes), float(steps.sum())))
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
