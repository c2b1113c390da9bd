"""Headsets' poses in wearcap's axes: their convention, the order of quaternions and the unit of length, by evidence.

Every reading of a log (an order, a convention) is a wearer whose head and hands move. What people do with them is scored
as a logarithm of likelihood (nats): a reading is taken when it is better than the next by `MARGIN`. OpenXR and Unity differ
by front and back alone: a wearer who turns left turns left in both, and the left hand is left. What separates them is that
people look down, walk ahead and hold their hands ahead, and that eyes sit before the neck on which they turn.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.conventions import AUTO, CHOICES, UNITS_M, Conventions
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
MARGIN = 2.5
"""Least difference (nats) from the second best reading."""
FORMAT_NATS = 4.0
"""What it is worth (nats) that a file's format fixes the convention."""
LEAST_UPRIGHT = 0.2
"""Least mean component of a headset's up axis along the world's: its wearer looks down by less than 78°."""
LEAST_UNIT = -2.5
"""Least score (nats) of a unit of length."""
FLOOR_M = 0.9, 2.2
"""Heights of a head over the floor."""
FASTEST_M_S = 5.0
WALKING_M_S = 0.4
NECK_M = (-0.1, 0.0, -0.1)
"""The place about which a head turns, from its headset, in the head's axes."""
_BASE_S = 0.17


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
    hands: dict[str, tuple[np.ndarray, np.ndarray | None, np.ndarray]]
    """(rows, R, t); R of OpenXR's hand joints, ahead along the fingers; None for what a fist holds."""
    base: int
    """Rows in a sixth of a second."""

    @property
    def heading(self) -> np.ndarray:
        """Horizontal unit vectors (n, 2) ahead of the head, whatever its pitch."""
        left = self.R[:, :2, 1]
        left = left / np.linalg.norm(left, axis=1, keepdims=True).clip(1e-9)
        return np.stack([left[:, 1], -left[:, 0]], 1)

    @property
    def walk(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Horizontal velocities (m/s) of the rows but `base` at each end, where they are walking, and its seconds."""
        k = self.base
        seconds = self.seconds[2 * k :] - self.seconds[: -2 * k]
        velocity = (self.t[2 * k :] - self.t[: -2 * k])[:, :2] / seconds[:, None]
        walking = np.linalg.norm(velocity, axis=1) > WALKING_M_S
        return velocity, walking, float(walking.sum() * np.median(np.diff(self.seconds)))


Term = Callable[[Wearer], tuple[float, str]]


def upright(wearer: Wearer) -> tuple[float, str]:
    """The headset's up axis is near the world's: its mean component, 1 ± 0.35, looking down included."""
    up = wearer.R[:, 2, 2].mean()
    return -0.5 * ((1 - up) / 0.35) ** 2, f"upright by {up:.2f}"


def turns_about_up(wearer: Wearer) -> tuple[float, str]:
    """Heads turn about the vertical more than about any other axis: its share of squared turns of a sixth of a second."""
    step = wearer.R[wearer.base :] @ wearer.R[: -wearer.base].swapaxes(1, 2)
    turn = (
        np.stack([step[:, 2, 1] - step[:, 1, 2], step[:, 0, 2] - step[:, 2, 0], step[:, 1, 0] - step[:, 0, 1]], 1) / 2
    )
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
    velocity, walking, seconds = wearer.walk
    if not walking.any():
        return 0.0, ""
    heading = wearer.heading[wearer.base : -wearer.base]
    along = ((velocity * heading).sum(1) / np.linalg.norm(velocity, axis=1).clip(1e-9))[walking].mean()
    return 1.5 * min(1.0, seconds / 4) * along, f"walks ahead {along:.2f}"


def looks_down(wearer: Wearer) -> tuple[float, str]:
    """Heads look down rather than up: a mean pitch of 10 ± 12°, against its opposite; beyond 43° no more."""
    down = np.degrees(np.arcsin(-wearer.R[:, 2, 0].clip(-1, 1))).mean()
    return float(np.clip(10 * down / 12**2, -3, 3)), f"looks {'down' if down > 0 else 'up'} {abs(down):.0f}°"


def turns_on_a_neck(wearer: Wearer) -> tuple[float, str]:
    """A headset sits before the axis on which it turns, 0.1 ± 0.065 m.

    The lever r (m) is fitted to second differences, Δ²t = Δ²R r, while nobody walks, since the steps of a walk and the
    nods against them look like another one. It counts as turned to the mean pitch, and as well as it is determined.
    """
    k, standing = wearer.base, ~wearer.walk[1]
    second = [(x[2 * k :] - 2 * x[k:-k] + x[: -2 * k])[standing] for x in (wearer.R, wearer.t)]
    turns, moves = second[0].reshape(-1, 3), second[1].reshape(-1)
    if not len(moves):
        return 0.0, ""
    square = turns.T @ turns + 1e-6 * np.eye(3)
    lever = np.linalg.solve(square, turns.T @ moves)
    scatter = np.linalg.inv(square) * ((moves - turns @ lever) ** 2).mean() * 4 * k
    ahead = wearer.R[:, 2, 2].mean() * np.eye(3)[0] - wearer.R[:, 2, 0].mean() * np.eye(3)[2]
    ahead /= max(float(np.linalg.norm(ahead)), 1e-9)
    before, variance = float(ahead @ lever), float(ahead @ scatter @ ahead) + 0.065**2
    score = 0.1 * float(np.clip(before, -0.2, 0.2)) / variance
    return score, f"turns {100 * before:.0f} cm behind the eyes" if abs(score) > 0.5 else ""


def hands_on_their_sides(wearer: Wearer) -> tuple[float, str]:
    """The left hand is left of the neck, the right one right of it, 0.2 ± 0.2 m; both hang below it, 0.4 ± 0.3 m."""
    score, beside = 0.0, []
    for joint, offset in _from_neck(wearer):
        left, up = np.median(offset[:, 1:], axis=0)
        beside.append(left if joint.startswith("left") else -left)
        score -= min(4.0, ((beside[-1] - 0.2) / 0.2) ** 2 / 2) + min(4.0, ((up + 0.4) / 0.3) ** 2 / 2)
    mean = sum(beside) / max(len(beside), 1)
    return score, f"hands {100 * abs(mean):.0f} cm on their {'sides' if mean > 0 else 'other sides'}" if beside else ""


def hands_ahead(wearer: Wearer) -> tuple[float, str]:
    """Hands are held ahead of the neck rather than behind: 0.15 ± 0.24 m, against the opposite."""
    ahead = [float(np.median(offset[:, 0])) for _, offset in _from_neck(wearer)]
    if not ahead:
        return 0.0, ""
    mean = sum(ahead) / len(ahead)
    score = sum(0.15 * float(np.clip(x, -0.4, 0.4)) / 0.24**2 for x in ahead)
    return score, f"hands {100 * abs(mean):.0f} cm {'ahead' if mean > 0 else 'behind'}"


def elbows_in_reach(wearer: Wearer) -> tuple[float, str]:
    """A forearm (0.25 m) behind a hand joint ends near the shoulder: at most 0.4 m from it. Fists may be held anyhow."""
    score = 0.0
    for joint, offset in _from_neck(wearer):
        rows, R, _ = wearer.hands[joint]
        if R is None:
            continue
        ahead = wearer.heading[rows]
        forearm = np.stack(
            [(R[:, :2, 0] * ahead).sum(1), ahead[:, 0] * R[:, 1, 0] - ahead[:, 1] * R[:, 0, 0], R[:, 2, 0]], 1
        )
        shoulder = np.array([0.0, 0.18 if joint.startswith("left") else -0.18, -0.12])
        far = np.linalg.norm(offset - 0.25 * forearm - shoulder, axis=1)
        score -= np.clip((far - 0.4) / 0.05, 0, 3).mean()
    return score, ""


def stands_on_the_floor(wearer: Wearer) -> tuple[float, str]:
    """Many worlds begin on the floor: a head 0.9 to 2.2 m above the origin speaks for a reading, another height for none."""
    return 1.0 * (FLOOR_M[0] < float(np.percentile(wearer.t[:, 2], 90)) < FLOOR_M[1]), ""


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

    What `how` states wins; `convention` is what the file's format fixes, which counts as `FORMAT_NATS` of evidence.
    Raises WearcapError, which names the candidates, where the evidence does not decide.
    """
    kinds = {joint: how.hands if how.hands != AUTO else raw.kind or "grip" for joint, raw in poses.items()}
    known = how.quaternion if how.quaternion != AUTO else poses["head"].order
    orders = (
        (known or CHOICES["quaternion"][0],) if known or poses["head"].rotation.ndim == 3 else CHOICES["quaternion"]
    )
    turned = {order: {joint: _matrices(raw, order) for joint, raw in poses.items()} for order in orders}
    unit, about_unit = (how.unit_m, [f"unit {how.unit} as given"]) if how.unit_m else _unit(poses, turned, where)
    paths = {joint: unit * raw.position for joint, raw in poses.items()}
    if how.axes != AUTO and len(orders) == 1:
        order, axes, notes = orders[0], how.axes, [f"axes {how.axes} as given"]
    else:
        names = DETECTED if how.axes == AUTO else (how.axes,)
        readings = {
            (name, order): _wearer(poses, paths, turned[order], name, kinds) for name in names for order in orders
        }
        (axes, order), notes = _best(readings, how.axes if how.axes != AUTO else convention, where)
    if known:
        notes.append(f"quaternions {known} as {'given' if how.quaternion != AUTO else 'named'}")
    tracks = {joint: _in_axes(poses[joint].seconds, turned[order][joint], path, axes) for joint, path in paths.items()}
    wrists = {joint: _as_wrist(track, joint, kinds[joint]) for joint, track in tracks.items() if joint != "head"}
    held = {"wrist": "the hand joint", "grip": "the controller (grip pose)"}
    notes += [*about_unit, *(f"{joint} from {held[kinds[joint]]}" for joint in wrists)]
    height = float(np.percentile(tracks["head"].t_world_body[:, 2].numpy(), 90))
    floor = FLOOR_M[0] < height < FLOOR_M[1]
    if floor:
        notes.append(f"the origin is on the floor (head {height:.2f} m above it)")
    else:
        notes.append(f"the origin is not on the floor (head at {height:.2f} m), whose height stays unknown")
    return HeadsetLog(tracks["head"], wrists, axes, floor, tuple(notes))


def _matrices(raw: RawPoses, order: str) -> np.ndarray:
    """Rotations (n, 3, 3) of a device in the file's axes."""
    if raw.rotation.ndim == 3:
        return raw.rotation
    places = [(raw.order or order).index(axis) for axis in "wxyz"]
    return rotation.matrix_from_quat_wxyz(torch.tensor(raw.rotation[:, places])).numpy()


def _unit(poses: dict[str, RawPoses], turned: dict[str, dict[str, np.ndarray]], where: str) -> tuple[float, list[str]]:
    """Metres per unit, and a note if it is not the metre: of m, cm and mm, that in which hands are in reach of the head,
    it moves no faster than people, and its height is that over a floor or near an origin at the head."""
    head = poses["head"]
    up = max((R["head"][:, axis, axis].mean(), axis) for R in turned.values() for axis in (1, 2))[1]
    height = float(np.percentile(head.position[:, up], 90))
    steps = np.linalg.norm(np.diff(head.position, axis=0), axis=1) / np.diff(head.seconds).clip(1e-6)
    hands = [raw for joint, raw in poses.items() if joint != "head"]
    far = [np.linalg.norm(raw.position - head.position[_rows(head, raw)], axis=1) for raw in hands]
    reach = float(np.median(np.concatenate(far))) if far else None
    scores = {}
    for name in ("m", "cm", "mm"):
        unit = UNITS_M[name]
        high = unit * height
        score = 0.0 if FLOOR_M[0] < high < FLOOR_M[1] else -0.3 if abs(high) < 0.45 else -1.5
        score -= 0.5 * (math.log(max(unit * reach, 1e-9) / 0.55) / 0.35) ** 2 if reach is not None else 0.0
        scores[name] = score - 4.0 * (unit * np.percentile(steps, 95) > FASTEST_M_S)
    best = max(scores, key=lambda name: scores[name])
    at = f"the head at {height:.4g}" + (f", the hands {reach:.3g} from it" if reach is not None else "")
    if scores[best] < LEAST_UNIT:
        fix = "Say the unit: unit=m|cm|mm|inch|foot, or metres per unit."
        raise WearcapError(
            f"no unit of length fits: {at}", where, "metres, centimetres or millimetres of a person", fix
        )
    fits = f"unit {best}: {at} would be {UNITS_M[best] * height:.2f} m"
    return UNITS_M[best], [] if best == "m" else [fits + (f" and {UNITS_M[best] * reach:.2f} m" if reach else "")]


def _rows(head: RawPoses, raw: RawPoses) -> np.ndarray:
    """The head's row at each time of another device."""
    return np.searchsorted(head.seconds, raw.seconds).clip(max=len(head.seconds) - 1)


def _wearer(
    poses: dict[str, RawPoses],
    paths: dict[str, np.ndarray],
    turned: dict[str, np.ndarray],
    name: str,
    kinds: dict[str, str],
) -> Wearer:
    """A log (paths in m) read in a convention, at 30 rows a second or fewer."""
    M, head = CONVENTIONS[name].double().numpy(), poses["head"]
    step = float(np.median(np.diff(head.seconds)))
    thin = max(1, int(1 / 30 / step))
    seconds, hands = head.seconds[::thin], {}
    for joint in (joint for joint in poses if joint != "head"):
        rows = (_rows(head, poses[joint])[::thin] // thin).clip(max=len(seconds) - 1)
        R = M @ turned[joint][::thin] @ M.T if kinds[joint] == "wrist" else None
        hands[joint] = rows, R, paths[joint][::thin] @ M.T
    base = max(1, min(round(_BASE_S / (thin * step)), (len(seconds) - 1) // 2))
    return Wearer(seconds, M @ turned["head"][::thin] @ M.T, paths["head"][::thin] @ M.T, hands, base)


def _best(readings: dict[tuple[str, str], Wearer], known: str | None, where: str) -> tuple[tuple[str, str], list[str]]:
    """The (convention, order) that people's habits show, with notes; `known` is the convention that is expected."""
    scores, words = {}, {}
    for key, wearer in readings.items():
        terms = [term(wearer) for term in TERMS]
        expected = known is not None and CONVENTIONS[key[0]] is CONVENTIONS[known]
        scores[key] = sum(score for score, _ in terms) + FORMAT_NATS * expected
        words[key] = ", ".join(word for _, word in terms if word)
    ranked = sorted(scores, key=lambda key: -scores[key])
    best = ranked[0]
    if (up := readings[best].R[:, 2, 2].mean()) < LEAST_UPRIGHT:
        fix = "Say what the poses have: axes=unity|openxr|unreal quaternion=xyzw|wxyz."
        what = f"in no order of the quaternion and no axes the headset is upright (at best {up:.2f}, {' '.join(best)})"
        raise WearcapError(what, where, f"{LEAST_UPRIGHT} or more", fix)
    near = [key for key in ranked if scores[best] - scores[key] < MARGIN]
    if len(near) > 1:
        shown = "; ".join(f"{' '.join(key)} ({words[key]}; {scores[key] - scores[best]:.1f})" for key in near[:3])
        which = [sorted({key[part] for key in near}) for part in (0, 1)]
        fix = " ".join(f"{name}={'|'.join(some)}" for name, some in zip(("axes", "quaternion"), which) if len(some) > 1)
        what = f"how the headset's poses are to be read is not certain: {shown}"
        raise WearcapError(what, where, f"a reading that is better by {MARGIN:g}", f"Say which: {fix}.")
    notes = [f"axes {best[0]}" + (" (SteamVR's are the same)" if best[0] == "openxr" else "") + f": {words[best]}"]
    if len(ranked) > 1:
        notes[0] += f"; margin {scores[best] - scores[ranked[1]]:.1f} over {' '.join(ranked[1])}"
    if len({order for _, order in readings}) > 1:
        notes.append(f"quaternions {best[1]} (the head is upright by {up:.2f})")
    return best, notes


def _in_axes(seconds: np.ndarray, R: np.ndarray, t: np.ndarray, name: str) -> Trajectory:
    """A path (m) of a named convention in wearcap's axes, world and device alike."""
    M = CONVENTIONS[name].double().numpy()
    turned = torch.tensor(M @ R @ M.T, dtype=torch.float32)
    return Trajectory(torch.tensor(seconds), turned, torch.tensor(t @ M.T, dtype=torch.float32))


def _as_wrist(track: Trajectory, joint: str, kind: str) -> Trajectory:
    """The wrist's path of a hand's pose in wearcap's axes."""
    t = track.t_world_body - (PALM_M * track.R_world_body[:, :, 2] if kind == "grip" else 0.0)
    return Trajectory(track.timestamps, wrist_of_hand(track.R_world_body, joint, kind), t)


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
