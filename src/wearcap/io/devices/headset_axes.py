"""Headsets' poses in wearcap's axes: their convention, the order of quaternions and the unit of length, by evidence.

Every reading of a log (an order, a convention) is a wearer whose head and hands move. What people do with them is scored
as a logarithm of likelihood (nats): a reading is taken when it is better than the next by `MARGIN`. OpenXR and Unity differ
by front and back alone: a wearer who turns left turns left in both, and the left hand is left. What separates them is that
people look down, walk ahead and hold their hands ahead, and that eyes sit before the neck on which they turn.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.conventions import AUTO, ORDERS, Conventions
from wearcap.io.devices.axes import CAMERA, OPENXR, UNITY
from wearcap.io.devices.headset_tables import RawPoses

UNREAL = torch.diag(torch.tensor([1.0, -1.0, 1.0]))
CONVENTIONS = {
    "unity": UNITY, "openxr": OPENXR, "steamvr": OPENXR, "unreal": UNREAL, "head": torch.eye(3), "camera": CAMERA
}  # fmt: skip
"""x right, y up in Unity (z forward, left-handed) and in OpenXR and SteamVR (z backward); x forward, y right, z up in
Unreal (left-handed). "head" has wearcap's own axes, "camera" OpenCV's."""
DETECTED = ("openxr", "unity", "unreal", "head")
"""Conventions that are told apart; OpenXR's stands for SteamVR's."""
PALM_M = 0.08
"""Distance (m) of a held controller's origin, the palm's middle, from the wrist (nominal)."""
MARGIN = 2.0
"""Least difference (nats) from the second best reading."""
LEAST_UPRIGHT = 0.2
"""Least mean component of a headset's up axis along the world's: its wearer looks down by less than 78°."""
WALKING_M_S = 0.4
NECK_M = (-0.1, 0.0, -0.1)
"""The place about which a head turns, from its headset, in the head's axes."""
_BASE_S = 0.25


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
class Wearer:
    """A log in one reading: x forward, y left, z up, metres; `hands` by joint, with each pose's row of the head."""

    seconds: np.ndarray
    R: np.ndarray
    t: np.ndarray
    hands: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]
    """(rows, R, t)."""
    base: int
    """Rows in a quarter of a second."""

    @property
    def heading(self) -> np.ndarray:
        """Horizontal unit vectors (n, 2) ahead of the head, whatever its pitch."""
        left = self.R[:, :2, 1]
        left = left / np.linalg.norm(left, axis=1, keepdims=True).clip(1e-9)
        return np.stack([left[:, 1], -left[:, 0]], 1)


Term = Callable[[Wearer], tuple[float, str]]


def upright(wearer: Wearer) -> tuple[float, str]:
    """The headset's up axis is near the world's: its mean component, 1 ± 0.35, looking down included."""
    up = wearer.R[:, 2, 2].mean()
    return -0.5 * ((1 - up) / 0.35) ** 2, f"upright by {up:.2f}"


def turns_about_up(wearer: Wearer) -> tuple[float, str]:
    """Heads turn about the vertical more than about any other axis: its share of squared turns of a quarter second."""
    step = wearer.R[wearer.base :] @ wearer.R[: -wearer.base].swapaxes(1, 2)
    turn = np.stack([step[:, 2, 1] - step[:, 1, 2], step[:, 0, 2] - step[:, 2, 0], step[:, 1, 0] - step[:, 0, 1]], 1) / 2
    square = (turn**2).mean(0)
    total = float(square.sum())
    return 3 * min(1.0, total**0.5 / 0.1) * square[2] / max(total, 1e-12), ""


def stays_level(wearer: Wearer) -> tuple[float, str]:
    """A head's path is flat: the vertical's share of its variance, counted from 0.3 m of movement on."""
    spread = wearer.t.var(0)
    total = float(spread.sum())
    return -4 * min(1.0, total**0.5 / 0.3) * spread[2] / max(total, 1e-12), ""


def walks_ahead(wearer: Wearer) -> tuple[float, str]:
    """Walking is forward: mean cosine between heading and velocity, in full from 4 s of walking on."""
    k = wearer.base
    seconds = wearer.seconds[2 * k :] - wearer.seconds[: -2 * k]
    velocity = (wearer.t[2 * k :] - wearer.t[: -2 * k])[:, :2] / seconds[:, None]
    speed = np.linalg.norm(velocity, axis=1)
    walking = speed > WALKING_M_S
    if not walking.any():
        return 0.0, ""
    along = ((velocity * wearer.heading[k:-k]).sum(1) / speed.clip(1e-9))[walking].mean()
    walked = walking.sum() * np.median(seconds) / (2 * k)
    return 4 * min(1.0, walked / 4) * along, f"walks ahead {along:.2f}"


def looks_down(wearer: Wearer) -> tuple[float, str]:
    """Heads look down rather than up: a mean pitch of 10 ± 15°, in nats against its opposite; beyond 45° no more."""
    down = np.degrees(np.arcsin(-wearer.R[:, 2, 0].clip(-1, 1))).mean()
    return float(np.clip(10 * down / 15**2, -2, 2)), f"looks {'down' if down > 0 else 'up'} {abs(down):.0f}°"


def turns_on_a_neck(wearer: Wearer) -> tuple[float, str]:
    """A headset sits before the axis on which it turns, 0.1 ± 0.06 m.

    The lever r (m) is fitted to second differences over a quarter of a second, in which steady walking vanishes:
    Δ²t = Δ²R r; it counts as turned to the mean pitch, and as well as it is determined.
    """
    k = wearer.base
    second = lambda x: x[2 * k :] - 2 * x[k:-k] + x[: -2 * k]  # noqa: E731
    turns, moves = second(wearer.R).reshape(-1, 3), second(wearer.t).reshape(-1)
    square = turns.T @ turns + 1e-6 * np.eye(3)
    lever = np.linalg.solve(square, turns.T @ moves)
    scatter = np.linalg.inv(square) * ((moves - turns @ lever) ** 2).mean() * 4 * k
    ahead = wearer.R[:, 2, 2].mean() * np.eye(3)[0] - wearer.R[:, 2, 0].mean() * np.eye(3)[2]
    ahead /= max(float(np.linalg.norm(ahead)), 1e-9)
    before, variance = float(ahead @ lever), float(ahead @ scatter @ ahead) + 0.06**2 + 0.05**2
    return 0.1 * float(np.clip(before, -0.2, 0.2)) / variance, f"turns {100 * before:.0f} cm behind the eyes"


def hands_on_their_sides(wearer: Wearer) -> tuple[float, str]:
    """The left hand is left of the neck, the right one right of it: 0.2 ± 0.25 m; and below the eyes: 0.5 ± 0.3 m."""
    score, beside = 0.0, 0.0
    for joint, offset in _from_neck(wearer):
        side = np.median(offset[:, 1]) * (1 if joint.startswith("left") else -1)
        score -= min(4.0, 0.5 * ((side - 0.2) / 0.25) ** 2) + min(
            4.0, 0.5 * ((np.median(offset[:, 2]) + 0.4) / 0.3) ** 2
        )
        beside += side / len(wearer.hands)
    return score, f"hands {100 * beside:.0f} cm on their sides" if wearer.hands else ""


def hands_ahead(wearer: Wearer) -> tuple[float, str]:
    """Hands are held ahead of the neck rather than behind: 0.15 ± 0.25 m, in nats against the opposite."""
    ahead = [float(np.median(offset[:, 0])) for _, offset in _from_neck(wearer)]
    if not ahead:
        return 0.0, ""
    mean = sum(ahead) / len(ahead)
    score = sum(0.15 * float(np.clip(x, -0.4, 0.4)) / 0.25**2 for x in ahead)
    return score, f"hands {100 * abs(mean):.0f} cm {'ahead' if mean > 0 else 'behind'}"


def elbows_in_reach(wearer: Wearer) -> tuple[float, str]:
    """A forearm (0.25 m) behind a hand joint ends near the shoulder: at most 0.4 m from it. Fists may be held anyhow."""
    score = 0.0
    for joint, offset in _from_neck(wearer):
        rows, R, _ = wearer.hands[joint]
        if R is None:
            continue
        ahead = wearer.heading[rows]
        forearm = np.stack([(R[:, :2, 0] * ahead).sum(1), ahead[:, 0] * R[:, 1, 0] - ahead[:, 1] * R[:, 0, 0], R[:, 2, 0]], 1)
        shoulder = np.array([0.0, 0.18 if joint.startswith("left") else -0.18, -0.12])
        far = np.linalg.norm(offset - 0.25 * forearm - shoulder, axis=1)
        score -= np.clip((far - 0.4) / 0.05, 0, 3).mean()
    return score, ""


def stands_on_the_floor(wearer: Wearer) -> tuple[float, str]:
    """Many worlds begin on the floor: a head 0.9 to 2.2 m above the origin speaks for a reading, another height for none."""
    return 1.0 * (0.9 < float(np.percentile(wearer.t[:, 2], 90)) < 2.2), ""


TERMS: tuple[Term, ...] = (
    upright,
    turns_about_up,
    stays_level,
    stands_on_the_floor,
    walks_ahead,
    looks_down,
    turns_on_a_neck,
    hands_on_their_sides,
    hands_ahead,
    elbows_in_reach,
)


def _from_neck(wearer: Wearer) -> list[tuple[str, np.ndarray]]:
    """Each hand's path (m) seen from the neck in its heading: ahead, left, up."""
    neck, heading, found = wearer.t + wearer.R @ np.array(NECK_M), wearer.heading, []
    for joint, (rows, _, t) in wearer.hands.items():
        offset, ahead = t - neck[rows], heading[rows]
        left = ahead[:, 0] * offset[:, 1] - ahead[:, 1] * offset[:, 0]
        found.append((joint, np.stack([(offset[:, :2] * ahead).sum(1), left, offset[:, 2]], 1)))
    return found


def in_our_axes(poses: dict[str, RawPoses], how: Conventions, where: str, convention: str | None = None) -> HeadsetLog:
    """A log's poses ("head", "left_wrist", "right_wrist") in metres and wearcap's axes, hands as wrists, with notes.

    What `how` states wins; `convention` is what the file's format fixes, which decides where the evidence does not.
    Raises WearcapError, which names the candidates, where neither does.
    """
    kinds = {joint: how.hands if how.hands != AUTO else raw.kind or "grip" for joint, raw in poses.items()}
    unit, about_unit = _unit(poses, how, where)
    order, axes, notes = _reading(poses, how, where, convention, kinds, unit)
    notes += about_unit
    head, *held = (_track(raw, order, axes, unit) for raw in (poses["head"], *(poses[joint] for joint in poses if joint != "head")))
    wrists = {}
    for joint, moved in zip((joint for joint in poses if joint != "head"), held, strict=True):
        R = wrist_of_hand(moved.R_world_body, joint, kinds[joint])
        t = moved.t_world_body - (PALM_M * moved.R_world_body[:, :, 2] if kinds[joint] == "grip" else 0.0)
        wrists[joint] = Trajectory(moved.timestamps, R, t)
        notes.append(f"{joint} from {'the hand joint' if kinds[joint] == 'wrist' else 'the controller (grip pose)'}")
    height = float(np.percentile(head.t_world_body[:, 2].numpy(), 90))
    floor = 0.9 < height < 2.2
    if floor:
        notes.append(f"the origin is on the floor (head {height:.2f} m above it)")
    else:
        notes.append(f"the origin is not on the floor (head at {height:.2f} m), whose height stays unknown")
    return HeadsetLog(head, wrists, axes, floor, tuple(notes))


def _reading(
    poses: dict[str, RawPoses], how: Conventions, where: str, convention: str | None, kinds: dict[str, str], unit: float
) -> tuple[str, str, list[str]]:
    """(order of quaternions, convention, notes): what is stated or named, or the reading that people's habits show."""
    head = poses["head"]
    known = how.quaternion if how.quaternion != AUTO else head.order
    orders = (known or "xyzw",) if known or head.rotation.ndim == 3 else ORDERS
    names = DETECTED if how.axes == AUTO else (how.axes,)
    said = [f"quaternions {known} {'as given' if how.quaternion != AUTO else 'as named'}"] if known else []
    if len(orders) == len(names) == 1:
        return orders[0], names[0], [f"axes {names[0]} as given", *said]
    ranked = []
    for order in orders:
        for name in names:
            terms = [term(_wearer(poses, order, name, kinds, unit)) for term in TERMS]
            words = ", ".join(word for _, word in terms if word)
            ranked.append((sum(score for score, _ in terms), order, name, words))
    ranked.sort(reverse=True)
    ...
