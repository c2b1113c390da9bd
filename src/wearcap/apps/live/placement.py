"""What the first seconds of devices show of how they are worn: stillness, height, sides, seats and headings.

Worlds have z up. In a standing wearer's rest the arms hang with the palms to the thighs and a little backwards
(`PRONATED_DEG`). A watch is on the back of the wrist, its z axis out of its face.
"""

import math
from collections import deque
from typing import NamedTuple

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory, resample
from wearcap.sensors.initialization import yaw_between

KEEP_S = 20.0
"""Time (s) of samples that are kept of a device."""
MAX_KEPT = 6000
EDGE_S = 0.25
MIN_STEP_S = 0.004
"""Samples nearer in time (s) than this to the last one are left out."""
CLOCK_BACK_S = 1.0
"""Step back in time (s) after which a device's clock is taken as set anew."""
STILL_M, STILL_DEG = 0.04, 8.0
"""Largest distance (m) and angle from the mean of someone who stands still: people sway by some centimetres."""
HEAD_M = (0.9, 2.1)
"""Heights (m) above the floor that are believed of the head joint of a wearer who stands, or sits on a chair."""
BELOW_M = 0.25
"""Least distance (m) of hanging hands below the head."""
HAND_LEAST = 0.25
"""Least height of a hand above the floor, as a share of the head's; lower trackers are worn on the feet."""
ASIDE_M = 0.08
"""Least distance (m) of a hand from the body's middle that tells its side."""
ALONG_FACE = 0.75
"""Component of the hanging hand's direction along a watch's z axis above which z cannot be its face."""
WALK_M_S, SMOOTH_S = 0.4, 0.4
"""Speed of walking, and the span (s) over which it is measured."""
PRONATED_DEG = 20.0
"""Angle by which the palms of hanging arms face backwards from the thighs, as those of people who stand: the median of 4
persons in CMU's training recordings is 24 for left and 16 for right arms, one of HDM05's has 17 (left)."""
SWING_RATIO = 2.0
"""Least ratio of a swinging arm's angular speed about its axis to that across it."""


class Window(NamedTuple):
    """Samples of one device within some seconds."""

    timestamps: Float64[Tensor, "time"]
    R: Float[Tensor, "time 3 3"]
    v: Float[Tensor, "time 3"]
    """Position (m), or of watches the free acceleration (m/s²)."""


class Seen:
    """The newest samples of one device."""

    def __init__(self, watch: bool):
        self.watch = watch
        self._samples: deque[tuple[float, Tensor, Tensor]] = deque(maxlen=MAX_KEPT)

    @property
    def newest_s(self) -> float:
        return self._samples[-1][0] if self._samples else -math.inf

    def add(self, time_s: float, R: Tensor, v: Tensor) -> None:
        """Keep a valid sample; late and repeated ones are left out."""
        if time_s < self.newest_s - CLOCK_BACK_S:
            self._samples.clear()
        if time_s < self.newest_s + MIN_STEP_S:
            return
        self._samples.append((time_s, R, v))
        while self._samples[0][0] < time_s - KEEP_S:
            self._samples.popleft()

    def shift(self, seconds: float) -> None:
        """Move what is kept in time."""
        self._samples = deque(((time_s + seconds, R, v) for time_s, R, v in self._samples), maxlen=MAX_KEPT)

    def between(self, start_s: float, stop_s: float) -> Window | None:
        """Samples of a span of time; None unless they fill it, but for `EDGE_S` at each end."""
        found = [sample for sample in self._samples if start_s <= sample[0] <= stop_s]
        if len(found) < 4 or found[0][0] > start_s + EDGE_S or found[-1][0] < stop_s - EDGE_S:
            return None
        times = torch.tensor([sample[0] for sample in found], dtype=torch.float64)
        return Window(times, torch.stack([sample[1] for sample in found]), torch.stack([sample[2] for sample in found]))


def moves(window: Window, watch: bool) -> bool:
    """Whether a device moves or turns more than that of someone who stands still."""
    off = (window.v - window.v.median(0).values).norm(dim=-1)
    if not watch and off.max() > STILL_M:
        return True
    R = rotation.mean_rotation(window.R)
    return math.degrees(rotation.geodesic(R.expand_as(window.R), window.R).max().item()) > STILL_DEG


def level_head(R_world_device: Float[Tensor, "time 3 3"], most_deg: float = 35.0) -> Float[Tensor, "3 3"] | None:
    """R_head_device of a wearer who looks straight ahead; its heading is the device's own.

    None where the device leans by more than `most_deg`: then it is not the head that is level.
    """
    R = rotation.mean_rotation(R_world_device.double())
    if R[2, 2] < math.cos(math.radians(most_deg)):
        return None
    return (rotation.about_axis("z", -rotation.yaw_of(R)) @ R).float()


class Placed(NamedTuple):
    """Where a tracker of unknown place is, seen from the head: to its left, and below it (m)."""

    left_m: float
    below_m: float


def placed(head: Window, tracker: Window) -> Placed:
    """Median place of a tracker in the head's heading."""
    at = torch.searchsorted(head.timestamps, tracker.timestamps).clamp(max=len(head.timestamps) - 1)
    yaw = rotation.yaw_of(head.R[at])
    off = tracker.v - head.v[at]
    left = off[:, 1] * yaw.cos() - off[:, 0] * yaw.sin()
    return Placed(left.median().item(), -off[:, 2].median().item())


def sides_of(places: dict[str, Placed], wanted: tuple[str, ...], head_m: float | None) -> dict[str, str]:
    """Wrists by tracker, of trackers of unknown place; `wanted` are wrists that none is known of.

    `head_m` is the head's height above the floor, if known. Trackers at feet, hips and above the hands are left out.
    """
    hands = {
        device: place.left_m
        for device, place in places.items()
        if place.below_m > BELOW_M
        and abs(place.left_m) > ASIDE_M
        and (head_m is None or head_m - place.below_m > HAND_LEAST * head_m)
    }
    found: dict[str, str] = {}
    for joint, sign in (("left_wrist", 1.0), ("right_wrist", -1.0)):
        aside = {device: sign * left for device, left in hands.items() if sign * left > 0}
        if joint in wanted and aside:
            found[max(aside, key=lambda device: aside[device])] = joint
    return found


def hanging(joint: str, yaw: float | Tensor) -> Float[Tensor, "3 3"]:
    """R_world_joint of the wrist of a hanging arm, of a wearer with this heading (rad)."""
    sign = -1.0 if joint.startswith("left") else 1.0
    turn = torch.as_tensor(yaw, dtype=torch.float32) + sign * math.radians(PRONATED_DEG)
    return rotation.about_axis("z", turn) @ rotation.about_axis("x", torch.tensor(sign * math.pi / 2))


def watch_side(R_ref_imu: Float[Tensor, "time 3 3"]) -> str | None:
    """The wrist of a hanging watch that is worn as usual: its x axis points to the left hand, or to the right elbow."""
    x_up = rotation.mean_rotation(R_ref_imu.double())[2, 0].item()
    return None if abs(x_up) < 0.5 else "left_wrist" if x_up < 0 else "right_wrist"


def watch_mount(R_ref_imu: Float[Tensor, "time 3 3"], joint: str) -> Float[Tensor, "3 3"] | None:
    """R_joint_imu of a watch on a hanging arm: the hand is below the elbow, z points out of the back of the wrist.

    None where z is along the forearm.
    """
    hand = -rotation.mean_rotation(R_ref_imu.double())[2]  # downwards, in the watch's axes
    if hand[2].abs() > ALONG_FACE:
        return None
    y = hand if joint.startswith("left") else -hand
    z = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    z = torch.nn.functional.normalize(z - (z @ y) * y, dim=0)
    return torch.stack([torch.linalg.cross(y, z), y, z]).float()


def hanging_yaw(R_ref_joint: Float[Tensor, "time 3 3"], joint: str, heading: float) -> float:
    """Turn (rad) from a watch's world to the head's, of a hanging arm."""
    R = rotation.mean_rotation(R_ref_joint.double())
    return yaw_between(R, hanging(joint, heading).double())[0].item()


def arm_is_down(R_ref_joint: Float[Tensor, "time 3 3"], joint: str, most_deg: float = 40.0) -> bool:
    """Whether a forearm hangs."""
    y = rotation.mean_rotation(R_ref_joint.double())[2, 1].item()
    return (y if joint.startswith("right") else -y) > math.cos(math.radians(most_deg))


class Walk(NamedTuple):
    """Times (s) at which the wearer walks, and the direction (rad) of the walk at each."""

    timestamps: Float64[Tensor, "time"]
    yaw: Float[Tensor, "time"]

    @property
    def seconds(self) -> float:
        if len(self.timestamps) < 2:
            return 0.0
        return len(self.timestamps) * self.timestamps.diff().median().item()

    def before(self, time_s: float) -> "Walk":
        """What was walked before a time."""
        return Walk(self.timestamps[self.timestamps < time_s], self.yaw[self.timestamps < time_s])


def walk_of(head: Window) -> Walk:
    """When and where to the head walks."""
    span = (head.timestamps[-1] - head.timestamps[0]).item()
    if span < 2 * SMOOTH_S:
        return Walk(head.timestamps[:0], head.v[:0, 0])
    at = torch.arange(head.timestamps[0].item() + SMOOTH_S / 2, head.timestamps[-1].item() - SMOOTH_S / 2, 1 / 30)
    at = at.double()
    path = Trajectory(head.timestamps, head.R, head.v)
    before, after = (resample(path, at + shift).t_world_body for shift in (-SMOOTH_S / 2, SMOOTH_S / 2))
    velocity = (after - before)[:, :2] / SMOOTH_S
    walking = velocity.norm(dim=-1) > WALK_M_S
    return Walk(at[walking], torch.atan2(velocity[:, 1], velocity[:, 0])[walking])


def swing_yaw(
    walk: Walk, watch: Window, R_joint_imu: Float[Tensor, "3 3"], joint: str, guess: float | None
) -> float | None:
    """Turn (rad) from a watch's world to the head's, by the axis about which its arm swings: across the walk.

    Of the two directions the one nearer to the `guess` is taken, or without it the one in which the forearm is bent
    forward. None where the arm hardly swings.
    """
    inside = (walk.timestamps > watch.timestamps[0] + 0.1) & (walk.timestamps < watch.timestamps[-1] - 0.1)
    at, yaw = walk.timestamps[inside], walk.yaw[inside].double()
    if len(at) < 15:
        return None
    path = Trajectory(watch.timestamps, watch.R.double(), watch.v.double())
    before, after = (resample(path, at + shift).R_world_body for shift in (-0.03, 0.03))
    rate = rotation.log(after @ before.mT) / 0.06
    turn = rotation.about_axis(
        "z", -yaw
    )  # seen from the walk, whose direction becomes x, but for the turn that is sought
    across = (turn @ rate[..., None])[:, :2, 0]
    values, axes = torch.linalg.eigh(across.mT @ across / len(at))
    if values[1] < SWING_RATIO**2 * values[0].clamp_min(1e-6) or values[1] < 0.1:
        return None
    axis = math.atan2(axes[1, 1].item(), axes[0, 1].item())
    found = [_wrapped(side * math.pi / 2 - axis) for side in (1.0, -1.0)]
    if guess is not None:
        return min(found, key=lambda one: abs(_wrapped(one - guess)))
    sign = 1.0 if joint.startswith("left") else -1.0
    hand = sign * (resample(path, at).R_world_body @ R_joint_imu.double().mT)[:, :, 1]
    forward = (turn @ hand[..., None])[:, :2, 0].mean(0)
    lean = math.atan2(forward[1].item(), forward[0].item())
    return min(found, key=lambda one: abs(_wrapped(one + lean)))


def _wrapped(angle: float) -> float:
    return math.remainder(angle, 2 * math.pi)


def head_of(window: Window, seat: Rigid) -> Window:
    """The head joint's poses; `seat` is T_head_device."""
    pose = Rigid(window.R, window.v) @ seat.inverse()
    return Window(window.timestamps, pose.R, pose.t)
