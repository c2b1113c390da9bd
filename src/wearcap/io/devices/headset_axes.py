"""Headsets' poses in wearcap's axes: the order of quaternions, the unit of length, and which axes world and devices have.

Conventions are told apart by what people do with a head and two hands. OpenXR's axes read as Unity's are the same person
in a mirror that exchanges ahead and behind: who looks down looks up there, walks backwards, has the hands behind the back,
and turns a headset that lies behind the neck. Each reading gets the log-likelihood of these observations.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rotation import matrix_from_quat_wxyz, yaw_of
from wearcap.geometry.trajectory import Trajectory, resample
from wearcap.io.conventions import AUTO, CHOICES, Conventions
from wearcap.io.devices.axes import OPENXR, UNITY, UNREAL, WALKING_M_S
from wearcap.io.devices.headset_tables import RawPoses

CONVENTIONS = {"openxr": OPENXR, "unity": UNITY, "unreal": UNREAL}
"""Rotations, or reflections of left-handed axes, to x forward, y left, z up. World and device share them, so a pose is
turned on both sides, R = M R' Mᵀ, t = M t'. SteamVR's axes are OpenXR's."""
PALM_M = 0.08
"""Distance (m) of a held controller's origin, the palm's middle, from the wrist (nominal)."""
CLEAR = 2.0
"""Lead in log-likelihood of the best reading from which it is taken."""
UPRIGHT = 0.2
"""Least mean component of the head's up axis along the world's: heads look down by at most 75° on average."""
ARM_M = (0.12, 1.25)
"""Range of the usual distance (m) between head and hand; decades of it are far apart, so it tells the unit."""
HEAD_M = (0.9, 2.2)
"""Range of the height (m) over the floor at which heads are carried."""
_UNITS_M = {"metres": 1.0, "centimetres": 0.01, "millimetres": 0.001}
_FASTEST_M_S = 8.0
_WORST = -4.0
"""Least log-likelihood of one observation: none decides against all others."""
_STEP_S, _RATE_HZ = 0.2, 30.0
_SEEN_S = 2.0


@dataclass(frozen=True)
class HeadsetLog:
    """Paths of a headset and of the wearer's wrists in wearcap's axes, and how the log was understood."""

    head: Trajectory
    wrists: dict[str, Trajectory]
    """By joint; those that the log has."""
    axes: str
    floor: bool
    """Whether the world's origin lies on the floor, as the head's height shows."""
    notes: tuple[str, ...]
    """What was detected or left out, a sentence each."""


@dataclass(frozen=True)
class Reading:
    """How well one convention explains a log."""

    axes: str
    score: float
    upright: float
    evidence: str


def in_our_axes(poses: dict[str, RawPoses], how: Conventions, where: str, convention: str | None = None) -> HeadsetLog:
    """Everything in wearcap's axes and metres, hands as wrists, with notes on what was detected.

    `convention` is what the format fixes; what `how` states wins over it. Raises WearcapError where the head is upright in
    no reading, where several readings explain the log alike, and for places in no known unit.
    """
    order, notes = _order(poses["head"], how.quaternion, where)
    unit, unit_m = _unit(poses, how, where)
    raw = {joint: _track(pose, order, unit_m) for joint, pose in poses.items()}
    axes, reason = how.axes, "as stated"
    if axes == AUTO and convention is not None:
        axes, reason = convention, "by the format"
    if axes == AUTO:
        found = detected_axes(raw, where)
        axes, reason = found.axes, found.evidence
    axes = "openxr" if axes == "steamvr" else axes
    if axes not in CONVENTIONS:
        raise WearcapError(f"axes={axes} of a headset's log", where, f"one of {', '.join(CONVENTIONS)}, steamvr")
    same = " (SteamVR's are the same)" if axes == "openxr" else ""
    notes = [f"axes {axes}{same}: {reason}", *([unit] if unit else []), *notes]
    head, wrists = turned(raw.pop("head"), axes), {}
    for joint, track in raw.items():
        kind = how.hands if how.hands != AUTO else poses[joint].kind or "grip"
        moved = turned(track, axes)
        R = wrist_of_hand(moved.R_world_body, joint, kind)
        t = moved.t_world_body - (PALM_M * moved.R_world_body[:, :, 2] if kind == "grip" else 0.0)
        wrists[joint] = Trajectory(moved.timestamps, R, t)
        notes.append(f"{joint} from {'the hand joint' if kind == 'wrist' else 'the controller (grip pose)'}")
    height = float(np.percentile(head.t_world_body[:, 2].numpy(), 90))
    floor = HEAD_M[0] < height < HEAD_M[1]
    at = f"the origin is on the floor (head {height:.2f} m above it)"
    notes.append(
        at if floor else f"the origin is not on the floor (head at {height:.2f} m), whose height stays unknown"
    )
    return HeadsetLog(head, wrists, axes, floor, tuple(notes))


def turned(track: Trajectory, axes: str) -> Trajectory:
    """A path of a convention's axes in wearcap's, world and device alike."""
    M = CONVENTIONS[axes].to(track.R_world_body)
    return Trajectory(track.timestamps, M @ track.R_world_body @ M.mT, track.t_world_body @ M.mT)


# --- order and unit ------------------------------------------------------------------------------------------------


def _order(head: RawPoses, given: str, where: str) -> tuple[str, list[str]]:
    """Order of the quaternions, and a note; where nothing names it, the one in which the head is more upright."""
    if head.rotation.ndim == 3:
        return "xyzw", []
    if given != AUTO:
        return given, [f"quaternions {given} as stated"]
    if head.order is not None:
        return head.order, []
    upright = {}
    for order in CHOICES["quaternion"]:
        R = _rotations(head, order)
        upright[order] = max((M @ R @ M.T)[:, 2, 2].mean().item() for M in (c.double() for c in CONVENTIONS.values()))
    best, other = sorted(upright, key=lambda order: -upright[order])
    if upright[best] - upright[other] < 0.2:
        what = (
            f"the head is upright by {upright[best]:.2f} and {upright[other]:.2f} in the two orders of its quaternions"
        )
        raise WearcapError(what, where, "one that is clearly upright", "Say which: quaternion=xyzw or quaternion=wxyz.")
    return best, [f"quaternions {best} (the head is upright by {upright[best]:.2f}, else {upright[other]:.2f})"]


def _unit(poses: dict[str, RawPoses], how: Conventions, where: str) -> tuple[str, float]:
    """A note on the unit of length, empty for metres, and metres per unit."""
    if (stated := how.unit_m) is not None:
        return f"a unit is {stated:g} m as stated", stated
    head = poses["head"]
    height = np.percentile(np.abs(head.position), 90, axis=0).max()
    speed = np.linalg.norm(np.diff(head.position, axis=0), axis=1) / np.diff(head.seconds)
    arms = [_distance(head, pose) for joint, pose in poses.items() if joint != "head"]
    arm = float(np.median(arms)) if arms else math.nan
    for name, unit_m in _UNITS_M.items():
        within = ARM_M[0] < arm * unit_m < ARM_M[1] if arms else HEAD_M[0] < height * unit_m < HEAD_M[1]
        if within and np.median(speed) * unit_m < _FASTEST_M_S:
            about = f"the hands are {arm:.4g} from the head" if arms else f"the head is carried at {height:.4g}"
            return ("" if unit_m == 1 else f"the unit is {name} ({about})"), unit_m
    if not arms and np.median(speed) < _FASTEST_M_S and height < HEAD_M[1]:
        return "", 1.0  # recentred: the first pose is the origin
    seen = (
        f"hands {arm:.4g} from the head"
        if arms
        else f"a head at {height:.4g} that moves by {np.median(speed):.3g} a second"
    )
    raise WearcapError(
        f"{seen}, in no known unit of length", where, "metres, cm or mm", "Say it: unit=m, cm, mm, or metres per unit."
    )


def _distance(head: RawPoses, hand: RawPoses) -> float:
    at = np.stack([np.interp(hand.seconds, head.seconds, head.position[:, k]) for k in range(3)], 1)
    return float(np.median(np.linalg.norm(hand.position - at, axis=1)))


def _rotations(pose: RawPoses, order: str) -> Float[Tensor, "time 3 3"]:
    if pose.rotation.ndim == 3:
        return torch.tensor(pose.rotation)
    quat = pose.rotation / np.linalg.norm(pose.rotation, axis=1, keepdims=True)
    return matrix_from_quat_wxyz(torch.tensor(quat[:, [order.index(axis) for axis in "wxyz"]]))


def _track(pose: RawPoses, order: str, unit_m: float) -> Trajectory:
    position = torch.tensor(unit_m * pose.position, dtype=torch.float32)
    return Trajectory(torch.tensor(pose.seconds), _rotations(pose, order).float(), position)


# --- axes ----------------------------------------------------------------------------------------------------------


def detected_axes(raw: dict[str, Trajectory], where: str) -> Reading:
    """The reading of a log (m, its own axes) that explains it best.

    Raises WearcapError when the head is upright in none, and when the best does not lead by `CLEAR`.
    """
    readings = [_reading(raw, axes) for axes in CONVENTIONS]
    best, second = sorted(readings, key=lambda reading: -reading.score)[:2]
    if best.upright < UPRIGHT:
        what = f"the headset's up axis points {best.upright:.2f} up on average"
        fix = "Check the order of the quaternion (quaternion=xyzw|wxyz) and the axes (axes=openxr|unity|unreal)."
        raise WearcapError(what, where, f"{UPRIGHT} or more", fix)
    lead = best.score - second.score
    if lead < CLEAR:
        what = f"its axes may be {best.axes} ({best.evidence}) or {second.axes} ({second.evidence})"
        fix = f"Say which: axes={best.axes} or axes={second.axes}."
        raise WearcapError(what, where, "walking, looking about, hands at work: what shows which way is ahead", fix)
    return Reading(best.axes, best.score, best.upright, f"{best.evidence}; {second.axes} is less likely by {lead:.1f}")


def _reading(raw: dict[str, Trajectory], axes: str) -> Reading:
    """Log-likelihood of what a person does in one reading (means and deviations of people with headsets, our choice)."""
    paths = {joint: turned(_even(track), axes) for joint, track in raw.items()}
    head = paths.pop("head")
    upright = head.R_world_body[:, 2, 2].double().mean().item()
    pitch = math.degrees(head.R_world_body[:, 2, 0].double().clamp(-1, 1).asin().mean().item())
    found = {"upright": (upright, 1.0, 0.35), "looks up by °": (pitch, -8.0, 13.0)}
    if (along := _walks_ahead(head)) is not None:
        found["walks ahead"] = (along, 0.9, 0.6)
    forward, deviation = _lever(head)
    found["neck behind by m"] = (forward, 0.1, math.hypot(0.06, deviation))
    seen = {joint: _in_head(head, hand) for joint, hand in paths.items()}
    if seen:
        ahead, below = (float(np.mean([place[k].item() for place in seen.values()])) for k in (0, 2))
        found |= {"hands ahead by m": (ahead, 0.2, 0.2), "hands below by m": (-below, 0.5, 0.2)}
    sides = [sign * seen[joint][1].item() for joint, sign in (("left_wrist", 1), ("right_wrist", -1)) if joint in seen]
    if sides:
        found["hands to their sides by m"] = (float(np.mean(sides)), 0.17, 0.12)
    score = sum(max(-0.5 * ((value - mean) / deviation) ** 2, _WORST) for value, mean, deviation in found.values())
    evidence = ", ".join(f"{name} {value:.2g}" for name, (value, _, _) in found.items())
    return Reading(axes, score, upright, evidence)


def _even(track: Trajectory) -> Trajectory:
    """The path at a rate that shows what a person does, over at most ten minutes."""
    start, stop = track.timestamps[0].item(), min(track.timestamps[-1].item(), track.timestamps[0].item() + 600)
    return resample(track, torch.arange(start, stop, 1 / _RATE_HZ, dtype=torch.float64)) if len(track) > 2 else track


def _walks_ahead(head: Trajectory) -> float | None:
    """Mean cosine between the head's forward axis and its walk; None where there is hardly a walk."""
    second, t = round(_RATE_HZ), head.t_world_body.double()[:, :2]
    moved = t[second:] - t[:-second]  # in a second: who dodges comes back
    distance = moved.norm(dim=-1)
    walking = distance > WALKING_M_S
    if walking.sum() < _SEEN_S * _RATE_HZ:
        return None
    facing = torch.nn.functional.normalize(
        head.R_world_body[second // 2 :][: len(moved)][walking, :2, 0].double(), dim=-1
    )
    return ((facing * moved[walking]).sum(-1) / distance[walking]).mean().item()


def _in_head(head: Trajectory, hand: Trajectory) -> Float[Tensor, "3"]:
    """Median place (m) of a hand from the head, in axes level with the world and turned with the head."""
    near = torch.searchsorted(head.timestamps, hand.timestamps).clamp(max=len(head) - 1)
    apart = (hand.t_world_body - head.t_world_body[near]).double()
    yaw = yaw_of(head.R_world_body[near].double())
    return (rotation.about_axis("z", -yaw) @ apart[..., None])[..., 0].median(0).values


def _lever(track: Trajectory) -> tuple[float, float]:
    """Forward part (m) of the lever from the point that a device turns about to the device, and its deviation.

    A rigid turn about a point displaces the device by ΔR l over a short time, beside what a steady gait adds along the
    device's own axes: both by least squares.
    """
    step = round(_STEP_S * _RATE_HZ)
    if len(track) < 5 * step:
        return 0.0, 1.0
    R, t = track.R_world_body.double(), track.t_world_body.double()
    A, b = torch.cat([R[step:] - R[:-step], _STEP_S * R[step // 2 :][: len(R) - step]], -1), t[step:] - t[:-step]
    normal = torch.einsum("nki,nkj->ij", A, A) + 1e-3 * torch.eye(6, dtype=torch.float64)
    inverse = torch.linalg.inv(normal)
    lever = inverse @ torch.einsum("nki,nk->i", A, b)
    left = (b - A @ lever).square().mean().item()
    return lever[0].item(), math.sqrt(max(left * inverse[0, 0].item() * 3 * step, 0.0))  # steps overlap


def wrist_of_hand(R_world_hand: Float[Tensor, "time 3 3"], joint: str, kind: str) -> Float[Tensor, "time 3 3"]:
    """Rotation of a wrist joint from a hand pose in wearcap's axes (x forward, y left, z up of the device).

    "wrist" is OpenXR's hand joint: forward along the fingers, up out of the hand's back. "grip" is a held controller:
    forward along the fist from little finger to thumb, up along the fingers, x right out of the left hand's back and
    into the right palm. A wrist joint's own axes are the world's in a T-pose that faces x, palms down.
    """
    side = 1.0 if joint.startswith("left") else -1.0
    if kind == "wrist":
        R_joint_hand = rotation.about_axis("z", torch.tensor(side * torch.pi / 2))
    else:  # device axes in a T-pose: forward = x, up (fingers) = ± y, left = ∓ z
        R_joint_hand = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, side], [0.0, -side, 0.0]])
    return R_world_hand @ R_joint_hand.to(R_world_hand).mT
