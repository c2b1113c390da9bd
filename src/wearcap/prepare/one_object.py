"""Conversion of a take of a person and one object to a recording with the object's path and its environment."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.data.object_classes import object_class
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import Trajectory, resample
from wearcap.io.datasets.one_object import OneObject
from wearcap.io.formats.environment import FILE_NAME, write_environment
from wearcap.prepare.clean import CleaningLimits, foot_patches, without_glitches
from wearcap.prepare.engine import NOTE
from wearcap.prepare.mocap import About, MocapSettings, mocap_recording, on_xsens23
from wearcap.recording.motion import Motion
from wearcap.recording.recording import Recording
from wearcap.scene.environment import Environment
from wearcap.scene.objects import Freedom, SceneObject

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


def one_object_recording(take: OneObject, about: About, settings: MocapSettings, output: str | Path) -> Recording:
    """Like `mocap_recording`, with the object's path on the motion's clock and an environment of that one object.

    The environment is written to `output`/scenes/NAME; the object is free to move and handled throughout, so there
    are no `interactions`. Of the segments between gaps and glitches the longest is kept, as noted in the motion's
    provenance. Raises WearcapError for an object of unknown class and for a body that is upside down.
    """
    kind = object_class(take.object_name)
    kept, cut = longest_stretch(take)
    motion, note = without_glitches(on_xsens23(kept.motion), settings.limits)
    _require_upright(motion, about.name)
    recording = mocap_recording(motion, about, settings)
    assert recording.motion is not None
    notes = "; ".join(text for text in (cut, note) if text)
    provenance = recording.motion.provenance | ({NOTE: notes} if notes else {})
    path = _on_clock(kept.path, motion, recording.motion)
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


def longest_stretch(take: OneObject) -> tuple[OneObject, str]:
    """The longest part of a take without gaps beyond `MAX_GAP_S`, and a note about the cut ("" if there was none)."""
    gaps = (take.motion.timestamps.diff() > MAX_GAP_S).nonzero()[:, 0].tolist()
    if not gaps:
        return take, ""
    edges = [0, *(frame + 1 for frame in gaps), len(take.motion)]
    start, stop = max(pairwise(edges), key=lambda span: span[1] - span[0])
    return take.frames(slice(start, stop)), (
        f"kept frames {start} to {stop - 1} of {len(take.motion)}: {len(gaps)} gaps of more than {MAX_GAP_S} s"
    )


def on_level_ground(take: OneObject, limits: CleaningLimits) -> OneObject:
    """The take on xsens23, rotated so that the ground below the planted feet is level; provenance notes the tilt.

    Raises WearcapError for a ground tilted by more than `MAX_TILT_DEG`.
    """
    motion = on_xsens23(take.motion)
    positions, speed = foot_patches(motion)
    R = ground_rotation(positions[speed < limits.contact_speed])
    tilt = float(torch.rad2deg(torch.arccos(R[2, 2].clamp(max=1.0))))
    if tilt > MAX_TILT_DEG:
        raise WearcapError(
            f"the ground below the feet is tilted by {tilt:.0f}°",
            where=take.name,
            expected=f"at most {MAX_TILT_DEG:g}°",
            fix="Check which of the source's axes is up.",
        )
    motion = replace(motion, provenance=motion.provenance | {"tilt_deg": f"{tilt:.2f}"})
    return replace(take, motion=motion).turned(R)


def ground_rotation(points_world: Float[Tensor, "point 3"]) -> Float[Tensor, "3 3"]:
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


def _on_clock(path: Trajectory, before: Motion, after: Motion) -> Trajectory:
    """The object's path on the prepared motion's clock, with the same shift by the floor's height."""
    moved = after.t_world_root[0] - before.t_world_root[0]
    track = resample(path, before.timestamps[0] + after.timestamps)
    return Trajectory(after.timestamps, track.R_world_body, track.t_world_body + moved)


def _require_upright(motion: Motion, name: str) -> None:
    feet = torch.stack([motion.joint(f"{side}_ankle").t[:, 2] for side in ("left", "right")]).mean(0)
    above = float((motion.joint("head").t[:, 2] - feet).median())
    if above < -_UPSIDE_DOWN_M:
        raise WearcapError(
            f"the head is {-above:.2f} m below the feet",
            where=name,
            expected="a world whose z is up",
            fix="The source's axes are others than published.",
        )
