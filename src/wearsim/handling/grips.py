"""Grips: a hand that holds an object from one time to another, however the object moves, and what they make of it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import exp
from wearcap.geometry.trajectory import Trajectory
from wearcap.recording.motion import Motion
from wearcap.scene.objects import SceneObject
from wearsim.people.track import ease

Vector = tuple[float, float, float]
Moves = Callable[[Float[np.ndarray, "time"], Rigid], Rigid]
"""Pose of an object in the world at increasing times (s), given the chest's pose at these times, on which only
carried objects depend."""

SKIN_M = 0.008
"""Depth of a palm's site inside the hand: it keeps this distance from the touched surface."""
SETTLED, DESCENT = 0.2, 0.5
"""Shares of the approach, at its end: the hand is off its place along the normal, and comes down on it."""


def vector(values: Float[np.ndarray, "3"]) -> Vector:
    """A vector as a tuple of floats."""
    x, y, z = (float(value) for value in values)
    return x, y, z


WANDER_HZ = (0.15, 0.8)
"""Range of the frequencies of the waves in the paths of hands that are not held."""


@dataclass(frozen=True, eq=False)
class Handled:
    """An object of a flat with what hands need to know of it."""

    object: SceneObject

    @property
    def name(self) -> str:
        return self.object.name

    @property
    def category(self) -> str:
        return self.object.category


@dataclass(frozen=True)
class GripPlace:
    """Place of a palm on an object, in the object's axes."""

    point: Vector
    """Position of the palm (m)."""
    normal: Vector
    """Unit vector out of the object's surface, towards the hand."""
    fingers: Vector
    """Preferred direction of the fingers; the arm may turn them some 40° about the normal."""

    @property
    def flat(self) -> bool:
        """Whether the palm lies on an upright face."""
        return abs(self.normal[2]) < 0.3

    def varied(self, rng: np.random.Generator, roll: float, yaw: float) -> "GripPlace":
        """The same point in a hand that is rolled about its fingers and turned about the normal by these deviations
        (rad)."""
        axes = torch.tensor([self.fingers, self.normal], dtype=torch.float64)
        angles = torch.from_numpy(np.clip(rng.normal(0.0, (roll, yaw)), -2 * roll, 2 * roll))
        rolled = exp(angles[0] * axes[0])
        turned = rolled @ exp(angles[1] * axes[1])
        return GripPlace(self.point, vector((turned @ axes[1]).numpy()), vector((turned @ axes[0]).numpy()))


@dataclass(frozen=True)
class Hold:
    """Goals that a grip sets for a hand over time, in the world."""

    palm: Float[Tensor, "time 3"]
    normal: Float[Tensor, "time 3"]
    fingers: Float[Tensor, "time 3"]

    def hand(self, sign: float, yaw: Float[Tensor, "*pick time"]) -> Float[Tensor, "*pick time 3 3"]:
        """Rotation of a hand (`sign` 1 left, -1 right) whose fingers are turned by `yaw` (rad) about the normal."""
        z = torch.nn.functional.normalize(self.normal, dim=-1)
        ahead = self.fingers - (self.fingers * z).sum(-1, keepdim=True) * z
        ahead = torch.nn.functional.normalize(ahead, dim=-1)
        turned = (exp(yaw[..., None] * z) @ ahead[..., None])[..., 0]
        y, z = sign * turned, z.expand_as(turned)
        return torch.stack([torch.linalg.cross(y, z), y, z], -1)


@dataclass(frozen=True)
class Grip:
    """A hand on a place of an object from `touch_s` to `release_s`, with the approach before and the return after it.

    Until it touches and after it releases, the hand's goal keeps off the surface along its normal by `hover_m`.
    """

    place: GripPlace
    moves: Moves
    touch_s: float
    release_s: float
    reach_s: float = 0.7
    return_s: float = 0.7
    hover_m: float = 0.06

    @classmethod
    def drawn(
        cls,
        place: GripPlace,
        moves: Moves,
        touch_s: float,
        release_s: float,
        rng: np.random.Generator,
        briskness: float,
    ) -> "Grip":
        """A grip with random durations of approach and return (0.4–1.2 s each) and hover distance."""
        there, back = (float(np.clip(rng.normal(0.75, 0.15) / briskness, 0.4, 1.2)) for _ in range(2))
        return cls(place, moves, touch_s, release_s, there, back, rng.uniform(0.04, 0.09))

    @property
    def start_s(self) -> float:
        return self.touch_s - self.reach_s

    @property
    def stop_s(self) -> float:
        return self.release_s + self.return_s

    def weight(self, times: Float[np.ndarray, "time"]) -> Float[np.ndarray, "time"]:
        """Weight of the grip's goal on the hand: 1 while it holds, minimum jerk before and after."""
        there = (times - self.start_s) / self.reach_s / (1.0 - SETTLED)
        back = 1.0 - (self.stop_s - times) / self.return_s / (1.0 - SETTLED)
        return ease(there) - ease(back)

    def hold(self, times: Float[np.ndarray, "time"], T_world_chest: Rigid) -> Hold:
        """Goal of the palm's position and of the hand's directions at times (s)."""
        T = self.moves(times, T_world_chest).to(torch.float64)
        point, normal, fingers = (
            torch.tensor(v, dtype=torch.float64) for v in (self.place.point, self.place.normal, self.place.fingers)
        )
        before = (self.touch_s - times) / (DESCENT * self.reach_s)
        after = (times - self.release_s) / (DESCENT * self.return_s)
        off = torch.from_numpy(self.hover_m * (ease(before) + ease(after)))
        out = T.R @ normal
        return Hold(T.t + T.R @ point + off[:, None] * out, out, T.R @ fingers)


def still(T_world_object: Rigid) -> Moves:
    """Motion of an object that stays where it is."""
    return lambda times, chest: Rigid(
        T_world_object.R.double().expand(len(times), 3, 3), T_world_object.t.double().expand(len(times), 3)
    )


def wandering(moves: Moves, rng: np.random.Generator, far_m: float) -> Moves:
    """The same motion with a drift within seconds, three waves per axis of a deviation (m): hands that nothing holds do
    not keep their place."""
    hertz, phase = rng.uniform(*WANDER_HZ, (3, 3)), rng.uniform(0.0, 2 * np.pi, (3, 3))
    amount = rng.normal(0.0, far_m, (3, 3))

    def wandered(times: Float[np.ndarray, "time"], T_world_chest: Rigid) -> Rigid:
        T = moves(times, T_world_chest)
        waves = amount * np.sin(2 * np.pi * hertz * times[:, None, None] + phase)
        return Rigid(T.R, T.t + torch.from_numpy(waves.sum(2)))

    return wandered


def posed(moves: Moves, at_s: float) -> Moves:
    """A motion that keeps to the chest as it is at one time (s): hands held out, however the body goes on."""

    def kept(times: Float[np.ndarray, "time"], T_world_chest: Rigid) -> Rigid:
        if not len(times):
            return moves(times, T_world_chest)
        frame = int(np.abs(times - at_s).argmin())
        T_world_then = T_world_chest[[frame]].to(torch.float64)
        T_chest_object = T_world_then.inverse() @ moves(times[[frame]], T_world_then).to(torch.float64)
        return T_world_chest.to(torch.float64) @ T_chest_object

    return kept


@dataclass(frozen=True)
class Handling:
    """One object's handling from the first touch to the last release, and its motion meanwhile."""

    name: str
    contact_class: str
    moves: Moves
    rows: tuple[tuple[float, float, tuple[bool, bool]], ...]
    """Intervals (s) with a fixed set of holding hands, one flag for each of `HANDS`."""
    rests_s: float = 0.0
    """Time at which the object has come to rest (s), if that is after the last release: a door swings on."""

    @classmethod
    def of(
        cls, name: str, contact_class: str, moves: Moves, grips: Sequence[tuple[str, Grip]], rests_s: float = 0.0
    ) -> "Handling":
        """A handling from its grips (side, grip): rows are split where the set of holding hands changes."""
        rows = []
        for start, stop in pairwise(sorted({time for _, grip in grips for time in (grip.touch_s, grip.release_s)})):
            middle = (start + stop) / 2
            hands = {side for side, grip in grips if grip.touch_s <= middle < grip.release_s}
            if hands:
                rows.append((start, stop, ("left" in hands, "right" in hands)))
        return cls(name, contact_class, moves, tuple(rows), rests_s)

    @property
    def start_s(self) -> float:
        return self.rows[0][0]

    @property
    def stop_s(self) -> float:
        return self.rows[-1][1]


def object_motion(T_world_object: Rigid, handlings: Sequence[Handling], motion: Motion) -> Trajectory:
    """Poses of an object on a motion's timestamps: as its handlings move it, static between them.

    `handlings` are those of this one object; `T_world_object` is its initial pose; `motion` is the wearer's, whose
    chest carried objects follow.
    """
    times, chest = motion.timestamps.numpy(), motion.joint("t8").to(torch.float64)
    R = T_world_object.R.double().repeat(len(times), 1, 1)
    t = T_world_object.t.double().repeat(len(times), 1)
    for handling in sorted(handlings, key=lambda handling: handling.start_s):
        first, last = np.searchsorted(times, (handling.start_s, max(handling.stop_s, handling.rests_s))).tolist()
        if first >= len(times):
            continue
        last = max(last, first + 1)
        pose = handling.moves(times[first:last], chest[first:last])
        R[first:last], t[first:last] = pose.R, pose.t
        R[last:], t[last:] = pose.R[-1], pose.t[-1]
    return Trajectory(motion.timestamps, R.float(), t.float())
