"""Augmentations of training windows, the same for every system.

A transform is a frozen dataclass: those of time change a `Cut`, which says what frames a window consists of, before the
frames are read; those of space change the `Window` that was read. Values are named as in docs/conventions.md, and the
name tells a transform what to do: `R_world_head` turns with the world, `acc_world_wrist` grows with the square of the
speed. All random numbers are the sample's own `Draws`.
"""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from wearcap.body.skeleton import MIRROR, Skeleton
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.sensors.imu import GRAVITY, PUSHED, acceleration, mean_filter
from wearcap.sensors.simulated import SlamNoise, slam_poses
from wearcap.sensors.watches import FILTER, MAX_GAP_S

_RATES = {"vel": 1, "acc": 2}
"""Power of the playback speed by which values of a kind grow, by the beginning of their names."""
_BETWEEN = ("R", "t", "vel", "acc", "floor")
"""Beginnings of names of values that are interpolated between frames; others are taken from the nearest frame."""
_LENGTHS = ("t", "vel", "acc", "floor", "size")
"""Beginnings of names of values that are proportional to a length."""


class Draws:
    """Random numbers of one sample, a function of its seed.

    The uniform numbers of `names` are drawn first and in this order, whether or not a transform uses them: a training
    sees the same samples when another augmentation is switched off. Everything else comes from `generator` in turn.
    """

    def __init__(self, seed: int, names: tuple[str, ...] = ()):
        self.generator = torch.Generator().manual_seed(seed)
        self._first = dict(zip(names, torch.rand(len(names), generator=self.generator).tolist()))

    def uniform(self, name: str) -> float:
        """The number of this name, uniform in [0, 1)."""
        return self._first[name] if name in self._first else torch.rand((), generator=self.generator).item()


@dataclass(frozen=True)
class Cut:
    """The frames of a recording that a window consists of. Whole frames are read as they are, others interpolated."""

    start: float
    """First frame; a float is measured from the recording's first frame in single precision."""
    count: int
    """Number of the window's frames."""
    length: int
    """Number of the recording's frames; positions beyond the last one repeat it."""
    stride: int = 1
    """Frames of the recording between successive windows."""
    step: int = 1
    """Frames of the recording per frame of the window."""
    latest: int | None = None
    """Last possible start; None: as late as the window fits into the recording."""
    stretch: float = 1.0
    """Largest speed that a transform may set."""
    speed: float | None = None
    shown: tuple[int, int | None] = (0, None)
    """Frame of the window that all earlier ones repeat, and number of frames before the padding, which repeats the
    last of them (None: all)."""
    kept: Bool[Tensor, "section"] | None = None
    """Which frames of `section` were not dropped; sensed values are interpolated between them."""

    @property
    def section(self) -> int:
        """Number of the recording's frames, from the start on, that the window may reach."""
        return math.ceil(self.count * self.step * self.stretch) + 1

    def _begin(self) -> float:
        reach = (self.count - 1) * self.step * (1 if self.speed is None else self.speed)
        return min(self.start, max(self.length - 1 - reach, 0) if self.latest is None else self.latest)

    def _places(self) -> tuple[int, Tensor]:
        """An origin, and the positions relative to it: whole numbers, or floats where frames are interpolated."""
        begin, number = self._begin(), torch.arange(self.count)
        if isinstance(begin, int):
            return begin, self.step * number if self.speed is None else self.step * self.speed * number
        return 0, begin + self.step * (1.0 if self.speed is None else self.speed) * number

    @cached_property
    def place(self) -> tuple[int, Tensor]:
        """Origin and positions of the frames, within the recording and without padding."""
        (origin, place), (first, shown) = self._places(), self.shown
        if first:
            place = place.clamp_min(place[first].item())
        if shown is not None:
            place = place.clamp_max(place[shown - 1].item())
        return origin, place.clamp_max(self.length - 1 - origin)

    @property
    def valid(self) -> Bool[Tensor, "time"]:
        """False for padding: frames after those that are shown, or after the recording's end."""
        (origin, place), (_, shown) = self._places(), self.shown
        return (torch.arange(self.count) < (self.count if shown is None else shown)) & (place < self.length - origin)

    @cached_property
    def frames(self) -> Int64[Tensor, "time"]:
        """Nearest frame of the recording."""
        origin, place = self.place
        return origin + place.round().long()

    @cached_property
    def bounds(self) -> tuple[int, int]:
        """The first frame that is read, and the one after the last."""
        parts = [part for sensed in (False, True) for part in self.between(sensed)[:2]]
        return min(int(part.min()) for part in parts), max(int(part.max()) for part in parts) + 1

    def between(
        self, sensed: bool = False
    ) -> tuple[Int64[Tensor, "time"], Int64[Tensor, "time"], Float[Tensor, "time"]]:
        """The frames before and after every position, and its fraction between them."""
        origin, place = self.place
        last = self.length - 1 - origin
        if sensed and self.kept is not None:
            frames = self.kept.nonzero()[:, 0] + (0 if origin else int(self._begin()))
            after = torch.searchsorted(frames, place, right=True).clamp(1, len(frames) - 1)
            low, high = frames[after - 1], frames[after]
            return origin + low.clamp_max(last), origin + high.clamp_max(last), (place - low) / (high - low)
        low = place.long()
        return origin + low, origin + (low + 1).clamp_max(last), (place - low).float()

    def take(self, name: str, part: Tensor, first: int = 0, *, sensed: bool = False, smooth: bool = False) -> Tensor:
        """The window's values of a recording ("frame ..."), of which `part` starts at frame `first`.

        Rotations, positions, rates and floor heights are interpolated (rotations are orthogonalised), others are those
        of the nearest frame. `sensed` values suffer from dropped frames. `smooth` also passes whole frames through the
        interpolation.
        """
        kind = name.split("_")[0]
        if kind not in _BETWEEN:
            return part[self.frames - first]
        low, high, share = self.between(sensed)
        if not smooth and not self.place[1].is_floating_point() and not (sensed and self.kept is not None):
            return part[low - first]
        blend = share.reshape(-1, *[1] * (part.ndim - 1)).to(part.dtype)
        value = torch.lerp(part[low - first], part[high - first], blend)
        if kind == "R":
            return rotation.matrix_from_rot6d(rotation.rot6d_from_matrix(value))
        return value if kind not in _RATES or self.speed is None else self.speed ** _RATES[kind] * value


@dataclass(frozen=True)
class Window:
    """Values of a window by their names, "time ..." each or without time (`size`, `t_parent_joint`)."""

    values: dict[str, Tensor]
    twins: dict[str, list[int]] = field(default_factory=dict)
    """What a mirror exchanges: the order of joints, wrists, feet … of the mirrored values, by their names."""
    mirrored: bool = False
    scale: float = 1.0
    fps: float = math.nan
    """Frames per second, which `Windows` fills in."""

    def changed(self, **values: Tensor) -> "Window":
        """The window with other values."""
        return replace(self, values=self.values | values)


@runtime_checkable
class TimeTransform(Protocol):
    """Changes which frames a window consists of."""

    def retimed(self, cut: Cut, random: Draws) -> Cut: ...


Transform = Callable[[Window, Draws], Window]
"""Changes the values of a window."""


@dataclass(frozen=True)
class Shift:
    """Starts a window up to a stride later."""

    whole_frames: bool = True
    """Whether by a whole number of frames; otherwise frames are interpolated."""

    def retimed(self, cut: Cut, random: Draws) -> Cut:
        later = random.uniform("shift") * cut.stride
        return replace(cut, start=cut.start + (int(later) if self.whole_frames else later))


@dataclass(frozen=True)
class TimeStretch:
    """Speeds a window up or slows it down by at most a factor; also 1 passes it through interpolation."""

    factor: float = 1.2

    def retimed(self, cut: Cut, random: Draws) -> Cut:
        return replace(cut, speed=self.factor ** (2 * random.uniform("speed") - 1))


@dataclass(frozen=True)
class DropFrames:
    """Drops up to a share of the frames that sensors gave; they are interpolated between the others."""

    share: float = 0.2

    def retimed(self, cut: Cut, random: Draws) -> Cut:
        share = self.share * torch.rand(1, generator=random.generator)
        kept = torch.rand(cut.section, generator=random.generator) >= share
        kept[[0, -1]] = True
        return replace(cut, kept=kept)


@dataclass(frozen=True)
class EarlyEnd:
    """Pads a share of the windows after `least` frames or more: a capture's first windows are not full."""

    share: float
    least: int = 10

    def retimed(self, cut: Cut, random: Draws) -> Cut:
        share, end = random.uniform("ends"), random.uniform("end")
        shown = cut.shown[0], self.least + int(end * (cut.count - self.least))
        return replace(cut, shown=shown) if share < self.share else cut


@dataclass(frozen=True)
class StillStart:
    """Lets the first frames of a share of the windows repeat one frame, as before the beginning of a capture."""

    share: float

    def retimed(self, cut: Cut, random: Draws) -> Cut:
        share, until = random.uniform("begins"), random.uniform("begin")
        shown = int(until * (cut.count - 2)), cut.shown[1]
        return replace(cut, shown=shown) if share < self.share else cut


@dataclass(frozen=True)
class Mirror:
    """Mirrors half of the windows left to right."""

    def __call__(self, window: Window, random: Draws) -> Window:
        return mirrored(window) if random.uniform("mirror") < 0.5 else window


@dataclass(frozen=True)
class Yaw:
    """Turns the world about its vertical by any angle."""

    def __call__(self, window: Window, random: Draws) -> Window:
        return turned(window, 2 * torch.pi * random.uniform("yaw"))


@dataclass(frozen=True)
class Scale:
    """Enlarges or shrinks wearer and world by a factor of at most `factor`."""

    factor: float = 1.1

    def __call__(self, window: Window, random: Draws) -> Window:
        return scaled(window, self.factor ** (2 * random.uniform("scale") - 1))


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
    axis and of positions along each. Values that a window lacks are left out. Random numbers are drawn for the first
    seven in any case, for those of `watches` unless they are 0.
    """

    head_deg: float = 0.0
    wrist_deg: float = 0.0
    """Orientation of a wrist's sensor: strap, attitude, heading."""
    acc_m_s2: float = 0.0
    """White noise of accelerations."""
    floor_m: float = 0.0
    head_m: float = 0.0
    """Where the device sits on the head, in the head's axes."""
    wrist_m: float = 0.0
    """Where a wrist's sensor is, in its own axes: a watch there has that place's acceleration."""
    size: float = 0.0
    """Of each measure of the body's size, as a share."""
    slam: SlamNoise | None = None
    """Of the head's tracked path; None: none."""
    watches: WatchErrors = WatchErrors()

    def __call__(self, window: Window, random: Draws) -> Window:
        """What moves differently or at another time comes first, what is measured wrongly follows."""
        generator, watches = random.generator, self.watches
        if self.slam is not None:
            window = _tracked(window, self.slam, generator)
        window = _worn(window, ((_slack, watches.play_deg), (_delayed, watches.delay_s)), generator)
        window = _constant(window, self, generator)
        measured = (_tilted, watches.tilt_deg), (_biased, watches.bias_m_s2), (_silenced, watches.silent)
        return _worn(window, measured, generator)


def _constant(window: Window, errors: SensorErrors, generator: torch.Generator) -> Window:
    """With constant errors of places, orientations, floor and size, and white noise of accelerations."""
    values, changed = window.values, {}
    angle = torch.randn(3, 3, generator=generator).deg2rad()
    turn = rotation.exp(angle * torch.tensor([[errors.wrist_deg], [errors.wrist_deg], [errors.head_deg]]))
    for name, order in (("R_world_wrist", [0, 1]), ("R_world_head", 2), ("R_world_point", [2, 0, 1])):
        if name in values:
            changed[name] = values[name] @ turn[order]
    if (acc := values.get("acc_world_wrist")) is not None:
        noise = torch.randn(acc.shape, generator=generator)
        changed["acc_world_wrist"] = (turn[:2] @ acc[..., None])[..., 0] + errors.acc_m_s2 * noise
    floor = errors.floor_m * torch.randn(1, generator=generator)
    changed |= {name: value + floor for name, value in values.items() if name.startswith("floor")}
    seat = torch.randn(3, 3, generator=generator)
    seat = seat * torch.tensor([[errors.wrist_m], [errors.wrist_m], [errors.head_m]])
    for point, order in (("wrist", [0, 1]), ("head", 2), ("point", [2, 0, 1])):
        t, R = f"t_world_{point}", f"R_world_{point}"
        if t in values and R in values:
            changed[t] = values[t] + (values[R] @ seat[order][..., None])[..., 0]
    if errors.wrist_m and "acc_world_wrist" in values:
        lever = (values["R_world_wrist"] @ seat[:2, :, None])[..., 0]
        changed["acc_world_wrist"] = changed["acc_world_wrist"] + _filtered_acceleration(lever, window.fps)
    if (size := values.get("size")) is not None:
        changed["size"] = size * (1 + errors.size * torch.randn(size.shape, generator=generator))
    return window.changed(**changed)


def _filtered_acceleration(t: Float[Tensor, "time wrist 3"], fps: float) -> Float[Tensor, "time wrist 3"]:
    """Acceleration (m/s²) of points as watches give it (MocapEvery eq. 8)."""
    return mean_filter(acceleration(t.flatten(1), fps), FILTER).unflatten(1, t.shape[1:])


def _tracked(window: Window, noise: SlamNoise, generator: torch.Generator) -> Window:
    """With the head's path as SLAM tracks it, and with it the points that are tracked from the head."""
    values, points = window.values, "R_world_point" in window.values
    if not points and "R_world_head" not in values:
        return window
    name = "point" if points else "head"
    true = Rigid(values[f"R_world_{name}"], values[f"t_world_{name}"])
    head = Rigid(true.R[:, 0], true.t[:, 0]) if points else true
    rng = np.random.default_rng(int(torch.randint(2**62, (), generator=generator)))
    sensed, _ = slam_poses(head, window.fps, noise, rng)
    if points:
        seen: Rigid = (sensed @ head.inverse())[:, None] @ true  # pyright: ignore[reportAssignmentType]
        return window.changed(R_world_point=seen.R, t_world_point=seen.t)
    changed = {"R_world_head": sensed.R, "t_world_head": sensed.t}
    if (wrist := values.get("t_world_wrist")) is not None:
        changed["t_world_wrist"] = (sensed @ head.inverse())[:, None] @ wrist
    return window.changed(**changed)


class _Watches(NamedTuple):
    R: Float[Tensor, "time wrist 3 3"]
    acc: Float[Tensor, "time wrist 3"]
    fps: float


_WatchError = Callable[[_Watches, float, torch.Generator], _Watches]


def _worn(window: Window, errors: tuple[tuple[_WatchError, float], ...], generator: torch.Generator) -> Window:
    """With errors of watches, each of its size; without watches as it is."""
    values = window.values
    if "acc_world_wrist" not in values:
        return window
    watches = _Watches(values["R_world_wrist"], values["acc_world_wrist"], window.fps)
    for error, size in errors:
        if size:
            watches = error(watches, size, generator)
    return window.changed(R_world_wrist=watches.R, acc_world_wrist=watches.acc)


def _slack(watches: _Watches, play_deg: float, generator: torch.Generator) -> _Watches:
    """On straps that give under the arms' acceleration (as in `sensors.imu.synthesize_imu`)."""
    sideways, axis = torch.nn.functional.normalize(torch.randn(2, 2, 3, generator=generator), dim=-1)
    pushed = ((watches.R.mT @ watches.acc[..., None])[..., 0] * sideways).sum(-1, keepdim=True)
    gives = math.radians(play_deg) * torch.tanh(pushed / PUSHED) * axis
    return watches._replace(R=watches.R @ rotation.exp(gives))


def _delayed(watches: _Watches, delay_s: float, generator: torch.Generator) -> _Watches:
    """Late or early; before the first frame and after the last one they repeat these."""
    R, acc, fps = watches
    count, wrist = len(R), torch.arange(2)
    place = torch.arange(count)[:, None] - delay_s * fps * torch.randn(2, generator=generator)
    place = place.clamp(0, count - 1)
    low = place.long()
    high, share = (low + 1).clamp_max(count - 1), (place - low)[..., None]
    acc = torch.lerp(acc[low, wrist], acc[high, wrist], share)
    R = torch.lerp(R[low, wrist], R[high, wrist], share[..., None])
    return _Watches(rotation.matrix_from_rot6d(rotation.rot6d_from_matrix(R)), acc, fps)


def _tilted(watches: _Watches, tilt_deg: float, generator: torch.Generator) -> _Watches:
    """With a gravity that is off, and does not cancel in their free acceleration."""
    angle = math.radians(tilt_deg) * torch.randn(2, 3, generator=generator)
    turn = rotation.exp(angle * torch.tensor([1.0, 1.0, 0.0]))
    gravity = torch.tensor([0.0, 0.0, GRAVITY])
    acc = (turn @ (watches.acc + gravity)[..., None])[..., 0] - gravity
    return watches._replace(R=turn @ watches.R, acc=acc)


def _biased(watches: _Watches, bias_m_s2: float, generator: torch.Generator) -> _Watches:
    """With a constant error of their accelerations, in their own axes."""
    bias = bias_m_s2 * torch.randn(2, 3, 1, generator=generator)
    return watches._replace(acc=watches.acc + (watches.R @ bias)[..., 0])


def _silenced(watches: _Watches, share: float, generator: torch.Generator) -> _Watches:
    """Silent for `MAX_GAP_S` or longer; shorter gaps are interpolated (`DropFrames`)."""
    R, acc, fps = watches
    happens, begins, lasts = torch.rand(3, 2, generator=generator)
    frame, last = torch.arange(len(R))[:, None], (len(R) * begins).long()
    silent = (happens < share) & (frame > last) & (frame <= last + (MAX_GAP_S * fps + len(R) * lasts).long())
    R = torch.where(silent[..., None, None], R[last, torch.arange(2)], R)
    return _Watches(R, acc.masked_fill(silent[..., None], 0), fps)


def mirrored(window: Window) -> Window:
    """The window mirrored left to right."""
    flip = torch.tensor(MIRROR)
    changed = {}
    for name, value in window.values.items():
        twins = window.twins.get(name)
        if twins is not None:
            value = value[twins] if name == "t_parent_joint" else value[:, twins]
        kind = name.split("_")[0]
        if kind == "R":
            value = value * torch.outer(flip, flip)
        elif kind in ("t", "vel", "acc"):
            value = value * flip
        changed[name] = value
    return replace(window, values=changed, mirrored=not window.mirrored)


def turned(window: Window, angle: float) -> Window:
    """The window with the world turned about its vertical by an angle (rad)."""
    R = rotation.about_axis("z", torch.tensor(angle))
    changed = {
        name: R @ value if name.startswith("R") else value @ R.mT
        for name, value in window.values.items()
        if "_world_" in name
    }
    if (local := window.values.get("R_parent_joint")) is not None:
        changed["R_parent_joint"] = torch.cat([(R @ local[:, 0])[:, None], local[:, 1:]], 1)
    return window.changed(**changed)


def scaled(window: Window, factor: float) -> Window:
    """The window with wearer and world scaled by a factor."""
    lengths = {name: value for name, value in window.values.items() if name.split("_")[0] in _LENGTHS}
    changed = window.changed(**{name: value * factor for name, value in lengths.items()})
    return replace(changed, scale=window.scale * factor)


def joint_twins(skeleton: Skeleton) -> list[int]:
    """Index of each joint's counterpart on the other side; joints on the midline are their own."""
    other = {"left": "right", "right": "left"}
    names = [re.sub("^(left|right)", lambda side: other[side[0]], name) for name in skeleton.joint_names]
    return skeleton.indices(*names)
