"""Augmentations of training windows, the same for every system.

A transform is a frozen dataclass that changes a whole `Batch`: with `cut` which frames its windows consist of, before
these are read, or by being called the values that were read. Values are named as in docs/conventions.md, and the
name tells a transform what to do: `R_world_head` turns with the world, `acc_world_wrist` grows with the square of the
speed. Random numbers come from the batch's `Draws`, by names that no other transform uses.
"""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from wearcap.body.skeleton import MIRROR, Skeleton
from wearcap.data.batch import Batch
from wearcap.data.draws import Draws
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.sensors.imu import GRAVITY, PUSHED
from wearcap.sensors.simulated import DRIFT_S, SlamNoise
from wearcap.sensors.watches import FILTER, MAX_GAP_S

_LENGTHS = ("t", "vel", "acc", "floor", "size")
"""Beginnings of names of values that are proportional to a length."""


@runtime_checkable
class Cutting(Protocol):
    """A transform of the frames that windows consist of."""

    def cut(self, batch: Batch) -> Batch: ...


@dataclass(frozen=True)
class Shift:
    """Starts a window up to a stride later."""

    whole_frames: bool = True
    """Whether by a whole number of frames; otherwise frames are interpolated."""

    def cut(self, batch: Batch) -> Batch:
        later = batch.draws.uniform("shift").double() * batch.stride
        return replace(batch, later=later.long() if self.whole_frames else later)


@dataclass(frozen=True)
class TimeStretch:
    """Speeds a window up or slows it down by at most a factor; also 1 passes it through interpolation."""

    factor: float = 1.2

    def cut(self, batch: Batch) -> Batch:
        return replace(batch, speed=_factors(batch, "speed", self.factor), stretch=self.factor)


@dataclass(frozen=True)
class DropFrames:
    """Drops up to a share of the frames that sensors gave; they are interpolated between the others."""

    share: float = 0.2

    def cut(self, batch: Batch) -> Batch:
        share = self.share * batch.draws.uniform("dropped share", 1)
        kept = batch.draws.uniform("dropped", batch.section) >= share
        kept[:, [0, -1]] = True
        return replace(batch, kept=kept)


@dataclass(frozen=True)
class EarlyEnd:
    """Pads a share of the windows after `least` frames or more: a capture's first windows are not full."""

    share: float
    least: int = 10

    def cut(self, batch: Batch) -> Batch:
        end = self.least + (batch.draws.uniform("end") * (batch.count - self.least)).long()
        return replace(batch, end=torch.where(batch.draws.uniform("ends") < self.share, end, batch.count))


@dataclass(frozen=True)
class StillStart:
    """Lets the first frames of a share of the windows repeat one frame, as before the beginning of a capture."""

    share: float

    def cut(self, batch: Batch) -> Batch:
        begin = (batch.draws.uniform("begin") * (batch.count - 2)).long()
        return replace(batch, begin=torch.where(batch.draws.uniform("begins") < self.share, begin, 0))


@dataclass(frozen=True)
class Mirror:
    """Mirrors half of the windows left to right."""

    def cut(self, batch: Batch) -> Batch:
        return replace(batch, mirrored=batch.draws.uniform("mirror") < 0.5)


@dataclass(frozen=True)
class Yaw:
    """Turns the world about its vertical by any angle."""

    def __call__(self, batch: Batch) -> Batch:
        return turned(batch, 2 * torch.pi * batch.draws.uniform("yaw"))


@dataclass(frozen=True)
class Scale:
    """Enlarges or shrinks wearer and world by a factor of at most `factor`."""

    factor: float = 1.1

    def __call__(self, batch: Batch) -> Batch:
        return scaled(batch, _factors(batch, "scale", self.factor))


def _factors(batch: Batch, name: str, largest: float) -> Float[Tensor, "batch"]:
    """Factors from 1 / `largest` to `largest`."""
    return torch.exp(math.log(largest) * (2 * batch.draws.uniform(name) - 1))


@dataclass(frozen=True)
class WatchErrors:
    """Further errors of watches, standard deviations within a window where they say no other."""

    tilt_deg: float = 0.0
    """Of gravity as each watch knows it, about both horizontal axes: its world is turned, and a part of gravity taken for
    acceleration."""
    bias_m_s2: float = 0.0
    """Of accelerations, in the watch's axes."""
    play_deg: float = 0.0
    """Largest angle by which a strap gives under the arm's acceleration."""
    delay_s: float = 0.0
    """Of each watch against the head; negative ones are early."""
    silent: float = 0.0
    """Share of windows in which a watch is silent for half a second or longer. As in captures, its orientation is then
    the last one, and its acceleration zero (`sensors.watches.bridged`)."""


@dataclass(frozen=True)
class SensorErrors:
    """Errors of trackers and watches, of the floor and of the body's size.

    They are constant within a window, where they say no other, and standard deviations, those of orientations about each
    axis and of positions along each. Values that a window lacks are left out.
    """

    head_deg: float | Sequence[float] = 0.0
    """How the device sits on the head: about the head's x, y and z axis, if there are three (roll, pitch, yaw)."""
    wrist_deg: float = 0.0
    """Orientation of a wrist's sensor: strap, attitude, heading."""
    acc_m_s2: float = 0.0
    """White noise of accelerations."""
    floor_m: float = 0.0
    head_m: float | Sequence[float] = 0.0
    """Where the device sits on the head, in the head's axes: forward, left, up, if there are three."""
    wrist_m: float = 0.0
    """Where a wrist's sensor is, in its own axes: a watch there has that place's acceleration."""
    size: float = 0.0
    """Of each measure of the body's size, as a share."""
    slam: SlamNoise | None = None
    """Of the head's tracked path; None: none."""
    watches: WatchErrors = WatchErrors()

    def __call__(self, batch: Batch) -> Batch:
        """What moves differently or at another time comes first, what is measured wrongly follows."""
        if self.slam is not None:
            batch = _tracked(batch, self.slam)
        batch = _worn(batch, ((_slack, self.watches.play_deg), (_delayed, self.watches.delay_s)))
        batch = _constant(batch, self)
        measured = (_tilted, self.watches.tilt_deg), (_biased, self.watches.bias_m_s2), (_silenced, self.watches.silent)
        return _worn(batch, measured)


def _constant(batch: Batch, errors: SensorErrors) -> Batch:
    """With constant errors of places, orientations, floor and size, and white noise of accelerations."""
    values, draws, changed = batch.values, batch.draws, {}
    head, wrist = ("head", errors.head_deg, errors.head_m), ("wrist", errors.wrist_deg, errors.wrist_m)
    turn, seat = {}, {}
    for name, deg, metres in (head, wrist):
        count = 1 if name == "head" else 2
        turned, moved = draws.normal(f"{name} turned", 1, count, 3), draws.normal(f"{name} seat", 1, count, 3)
        turn[name] = rotation.exp(turned.new_tensor(deg).deg2rad() * turned)
        seat[name] = moved.new_tensor(metres) * moved
    turn["point"], seat["point"] = (torch.cat([each["head"], each["wrist"]], 2) for each in (turn, seat))
    turn["head"], seat["head"] = turn["head"][:, :, 0], seat["head"][:, :, 0]
    if (acc := values.get("acc_world_wrist")) is not None:
        changed["acc_world_wrist"] = _applied(turn["wrist"], acc)
        if errors.acc_m_s2:
            changed["acc_world_wrist"] += errors.acc_m_s2 * draws.normal("acceleration", *acc.shape[1:])
    floor = errors.floor_m * draws.normal("floor", 1)
    changed |= {name: value + floor for name, value in values.items() if name.startswith("floor")}
    for name in ("head", "wrist", "point"):
        R, t = values.get(f"R_world_{name}"), values.get(f"t_world_{name}")
        if R is not None:
            changed[f"R_world_{name}"] = _turned_about(R, turn[name])
            if t is not None:
                changed[f"t_world_{name}"] = t + _applied(R, seat[name])
    if errors.wrist_m and "acc_world_wrist" in values:
        lever = _applied(values["R_world_wrist"], seat["wrist"])
        changed["acc_world_wrist"] = changed["acc_world_wrist"] + filtered_acceleration(lever, batch.fps)
    if (size := values.get("size")) is not None:
        changed["size"] = size * (1 + errors.size * draws.normal("size", size.shape[-1]))
    return batch.changed(**changed)


def _turned_about(
    R: Float[Tensor, "batch time *point 3 3"], turn: Float[Tensor, "batch 1 *point 3 3"]
) -> Float[Tensor, "batch time *point 3 3"]:
    """R @ turn, as one product for all frames: many of 3x3 take several times as long."""
    rows = R.movedim(1, -3).flatten(-3, -2)
    return (rows @ turn[:, 0]).unflatten(-2, (-1, 3)).movedim(-3, 1)


def _applied(R: Float[Tensor, "*#batch 3 3"], vector: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*batch 3"]:
    return (R * vector[..., None, :]).sum(-1)


def filtered_acceleration(
    t: Float[Tensor, "batch time wrist 3"], fps: float, n: int = 4
) -> Float[Tensor, "batch time wrist 3"]:
    """Acceleration (m/s²) of points as watches give it (MocapEvery eq. 8); ends repeat the nearest frame that has one."""
    count = t.shape[1]
    if count <= 2 * n:
        return torch.zeros_like(t)
    inner = (t[:, : -2 * n] + t[:, 2 * n :] - 2 * t[:, n:-n]) * (fps / n) ** 2
    flat = inner.flatten(2).mT
    half = FILTER // 2
    return F.avg_pool1d(F.pad(flat, (n + half, n + half), mode="replicate"), FILTER, 1).mT.reshape(t.shape)


def _tracked(batch: Batch, noise: SlamNoise) -> Batch:
    """With the head's path as SLAM tracks it, and with it the points that are tracked from the head."""
    values, name = batch.values, "point" if "R_world_point" in batch.values else "head"
    if f"R_world_{name}" not in values:
        return batch
    true = Rigid(values[f"R_world_{name}"], values[f"t_world_{name}"])
    head = Rigid(true.R[:, :, 0], true.t[:, :, 0]) if name == "point" else true
    sensed = slam_paths(head, batch.fps, noise, batch.draws)
    moved: Rigid = sensed @ head.inverse()
    if name == "point":
        seen: Rigid = moved[:, :, None] @ true  # pyright: ignore[reportAssignmentType]
        return batch.changed(R_world_point=seen.R, t_world_point=seen.t)
    changed = {"R_world_head": sensed.R, "t_world_head": sensed.t}
    if (wrist := values.get("t_world_wrist")) is not None:
        changed["t_world_wrist"] = moved[:, :, None] @ wrist
    return batch.changed(**changed)


def slam_paths(T_world_device: Rigid, fps: float, noise: SlamNoise, draws: Draws) -> Rigid:
    """Paths of a device as SLAM tracks them: `sensors.simulated.slam_poses` for the windows of a batch."""
    R, t = T_world_device.R, T_world_device.t
    jitter = _smooth("jitter", t, draws, noise.jitter_period_s * fps)
    R = R @ rotation.exp(math.radians(noise.jitter_deg) * jitter[..., :3])
    step = t.diff(dim=1, prepend=t[:, :1]).norm(dim=-1, keepdim=True)
    t = t + noise.jitter_m * jitter[..., 3:]
    if noise.drift_share or noise.yaw_drift_deg_per_sqrt_min:
        off = noise.drift_share * (draws.normal("drift", *t.shape[1:]) * step.sqrt()).cumsum(1)
        yaw = (
            draws.normal("yaw drift", t.shape[1]) * math.radians(noise.yaw_drift_deg_per_sqrt_min) / math.sqrt(60 * fps)
        )
        yaw[:, 0] = 0.0
        turn = rotation.about_axis("z", yaw.cumsum(1))
        path = t + off - t[:, :1]
        off = _blurred(off + _applied(turn, path) - path, DRIFT_S * fps)
        R, t = turn @ R, t + off - off[:, :1]
    if noise.wander_m or noise.wander_deg:
        wander = _smooth("wander", t, draws, noise.wander_period_s * fps) / math.sqrt(3)
        R = rotation.exp(math.radians(noise.wander_deg) * wander[..., :3]) @ R
        t = t + noise.wander_m * wander[..., 3:]
    if noise.lean_deg or noise.scale:
        lean = math.radians(noise.lean_deg) / math.sqrt(2) * draws.normal("lean", 1, 3)
        world = rotation.exp(F.pad(lean[..., :2], (0, 1)))
        scale = 1 + noise.scale * draws.normal("stretched world", 1, 1)
        R, t = world @ R, t[:, :1] + scale * _applied(world, t - t[:, :1])
    return Rigid(R, t)


def _smooth(
    name: str, like: Float[Tensor, "batch time 3"], draws: Draws, period: float
) -> Float[Tensor, "batch time 6"]:
    """Gaussian noise of unit deviation that changes over about `period` frames."""
    sigma = period / 4
    if sigma < 0.3:
        return draws.normal(name, like.shape[1], 6)
    pad = int(4 * sigma) + 1
    smooth = _blurred(draws.normal(name, like.shape[1] + 2 * pad, 6), sigma)[:, pad:-pad]
    # A Gaussian kernel of width σ leaves white noise the variance 1 / (2 √π σ).
    return smooth * math.sqrt(2 * math.sqrt(math.pi) * sigma)


def _blurred(value: Float[Tensor, "batch time axis"], sigma: float) -> Float[Tensor, "batch time axis"]:
    """Values smoothed by a Gaussian kernel of `sigma` frames; ends are repeated."""
    reach = int(4 * sigma + 0.5)
    kernel = torch.exp(-0.5 * (torch.arange(-reach, reach + 1, device=value.device) / sigma).square())
    flat = F.pad(value.mT, (reach, reach), mode="replicate").flatten(0, 1)[:, None]
    return F.conv1d(flat, (kernel / kernel.sum())[None, None])[:, 0].unflatten(0, (len(value), -1)).mT


class _Watches(NamedTuple):
    R: Float[Tensor, "batch time wrist 3 3"]
    acc: Float[Tensor, "batch time wrist 3"]
    fps: float
    draws: Draws


_WatchError = Callable[[_Watches, float], _Watches]


def _worn(batch: Batch, errors: tuple[tuple[_WatchError, float], ...]) -> Batch:
    """With errors of watches, each of its size; without watches as it is."""
    if "acc_world_wrist" not in batch.values or not any(size for _, size in errors):
        return batch
    watches = _Watches(batch.values["R_world_wrist"], batch.values["acc_world_wrist"], batch.fps, batch.draws)
    for error, size in errors:
        if size:
            watches = error(watches, size)
    return batch.changed(R_world_wrist=watches.R, acc_world_wrist=watches.acc)


def _slack(watches: _Watches, play_deg: float) -> _Watches:
    """On straps that give under the arms' acceleration (as in `sensors.imu.synthesize_imu`)."""
    sideways, axis = F.normalize(watches.draws.normal("strap", 2, 1, 2, 3), dim=-1).unbind(1)
    pushed = (_applied(watches.R.mT, watches.acc) * sideways).sum(-1, keepdim=True)
    gives = math.radians(play_deg) * torch.tanh(pushed / PUSHED) * axis
    return watches._replace(R=watches.R @ rotation.exp(gives))


def _delayed(watches: _Watches, delay_s: float) -> _Watches:
    """Late or early; before the first frame and after the last one they repeat these."""
    R, acc, fps, draws = watches
    count = R.shape[1]
    late = delay_s * fps * draws.normal("watch delay", 1, 2)
    place = (torch.arange(count, device=R.device)[:, None] - late).clamp(0, count - 1)
    low = place.long()
    high, share = (low + 1).clamp_max(count - 1), (place - low)[..., None]

    def between(value: Tensor) -> Tensor:
        flat = value.flatten(3)
        rows = (each[..., None].expand_as(flat) for each in (low, high))
        return torch.lerp(*(flat.gather(1, row) for row in rows), share).reshape(value.shape)

    turned = rotation.matrix_from_rot6d(rotation.rot6d_from_matrix(between(R)))
    return watches._replace(R=turned, acc=between(acc))


def _tilted(watches: _Watches, tilt_deg: float) -> _Watches:
    """With a gravity that is off, and does not cancel in their free acceleration."""
    lean = math.radians(tilt_deg) * watches.draws.normal("watch tilt", 1, 2, 2)
    turn = rotation.exp(F.pad(lean, (0, 1)))
    # The difference that a turned gravity makes to the specific force g e_z.
    acc = _applied(turn, watches.acc) + GRAVITY * (turn[..., 2] - _up(turn))
    return watches._replace(R=turn @ watches.R, acc=acc)


def _up(like: Tensor) -> Float[Tensor, "3"]:
    return torch.eye(3, device=like.device, dtype=like.dtype)[2]


def _biased(watches: _Watches, bias_m_s2: float) -> _Watches:
    """With a constant error of their accelerations, in their own axes."""
    bias = bias_m_s2 * watches.draws.normal("watch bias", 1, 2, 3)
    return watches._replace(acc=watches.acc + _applied(watches.R, bias))


def _silenced(watches: _Watches, share: float) -> _Watches:
    """Silent for `MAX_GAP_S` or longer; shorter gaps are interpolated (`DropFrames`)."""
    R, acc, fps, draws = watches
    count = R.shape[1]
    happens, begins, lasts = draws.uniform("watch silence", 3, 1, 2).unbind(1)
    frame, last = torch.arange(count, device=R.device)[:, None], (count * begins).long()
    silent = (happens < share) & (frame > last) & (frame <= last + (MAX_GAP_S * fps + count * lasts).long())
    still = R.gather(1, last[..., None, None].expand(-1, -1, -1, 3, 3))
    return watches._replace(R=torch.where(silent[..., None, None], still, R), acc=acc.masked_fill(silent[..., None], 0))


def turned(batch: Batch, angle: Float[Tensor, "batch"]) -> Batch:
    """The batch with each window's world turned about its vertical by an angle (rad)."""
    R = rotation.about_axis("z", angle)[:, None]
    changed = {}
    for name, value in batch.values.items():
        if "_world_" in name:
            turn = R.reshape(-1, *[1] * (value.ndim - 3), 3, 3) if name[0] == "R" else R
            flat = value if name[0] == "R" else value.flatten(1, -2)
            changed[name] = turn @ flat if name[0] == "R" else (flat @ R[:, 0].mT).reshape(value.shape)
    if (local := batch.values.get("R_parent_joint")) is not None:
        local[:, :, 0] = R @ local[:, :, 0]  # the root's alone: other joints' turn with it
    return batch.changed(**changed)


def scaled(batch: Batch, factor: Float[Tensor, "batch"]) -> Batch:
    """The batch with wearers and worlds scaled by factors."""
    changed = {
        name: value * factor.reshape(-1, *[1] * (value.ndim - 1))
        for name, value in batch.values.items()
        if name.split("_")[0] in _LENGTHS
    }
    scale = factor if batch.scale is None else batch.scale * factor
    return replace(batch.changed(**changed), scale=scale)


def mirrored_rotations(
    R_parent_joint: Float[Tensor, "*batch joint 3 3"], skeleton: Skeleton
) -> Float[Tensor, "*batch joint 3 3"]:
    """Local rotations of the pose mirrored left to right."""
    flip = R_parent_joint.new_tensor(MIRROR)
    return R_parent_joint[..., joint_twins(skeleton), :, :] * torch.outer(flip, flip)


def joint_twins(skeleton: Skeleton) -> list[int]:
    """Index of each joint's counterpart on the other side; joints on the midline are their own."""
    other = {"left": "right", "right": "left"}
    names = [re.sub("^(left|right)", lambda side: other[side[0]], name) for name in skeleton.joint_names]
    return skeleton.indices(*names)
