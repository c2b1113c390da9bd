"""Headsets' poses in wearcap's axes: their convention, the order of quaternions and the unit of length, by evidence.

Every reading of a log (an order, a convention) is a wearer whose head and hands move. What people do with them is scored
as a logarithm of likelihood (nats): a reading is taken when it is better than the next by `MARGIN`. OpenXR and Unity differ
by front and back alone: a wearer who turns left turns left in both, and the left hand is left. What separates them is that
people look down, walk ahead and hold their hands ahead, and that eyes sit before the neck on which they turn.
"""

import math
from dataclasses import dataclass, field

import numpy as np
import torch

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.conventions import AUTO, CHOICES, UNITS_M, Conventions
from wearcap.io.devices.axes import CAMERA, OPENXR, UNITY, UNREAL
from wearcap.io.devices.hand_seats import SEATS, most_likely_seat, palm_of, wrist_of_hand
from wearcap.io.devices.headset_tables import RawPoses
from wearcap.recording.recording import FingerStream

CONVENTIONS = {
    "unity": UNITY, "openxr": OPENXR, "steamvr": OPENXR, "unreal": UNREAL, "head": torch.eye(3), "camera": CAMERA
}  # fmt: skip
"""Rotations, or reflections of left-handed axes, to x forward, y left, z up. World and device share them, so a pose is
turned on both sides: R = M R' Mᵀ, t = M t'."""
DETECTED = ("openxr", "unity", "unreal", "head")
"""Conventions that are looked for; OpenXR's stands for SteamVR's."""
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
    unit_m: float = 1.0
    """Metres per unit of the file."""
    fingers: dict[str, FingerStream] = field(default_factory=dict)
    """Hands by side, in the log's times."""


@dataclass(frozen=True)
class Wearer:
    """A log in one reading, at most some 30 rows a second: x forward, y left, z up, metres."""

    R: np.ndarray
    t: np.ndarray
    heading: np.ndarray
    """Horizontal unit vectors (n, 2) ahead of the head, whatever its pitch."""
    hands: dict[str, tuple[np.ndarray, np.ndarray | None]]
    """By joint, in the head's heading: places (m, 3) seen from the neck, and OpenXR's hand joints' axes along the fingers."""
    base: int
    """Rows in a sixth of a second."""
    velocity: np.ndarray
    """Horizontal, over twice `base`: (n - 2 base, 2)."""
    step_s: float

    @property
    def walking(self) -> np.ndarray:
        return np.linalg.norm(self.velocity, axis=1) > WALKING_M_S


def stands(wearer: Wearer) -> tuple[float, str]:
    """A head's up axis is near the world's (mean component 1 ± 0.35), its path flat, and often the floor the origin."""
    up, spread = wearer.R[:, 2, 2].mean(), wearer.t.var(0)
    total = max(float(spread.sum()), 1e-12)
    steep = min(1.0, total**0.5 / 0.3) * spread[2] / total
    floor = FLOOR_M[0] < float(np.percentile(wearer.t[:, 2], 90)) < FLOOR_M[1]
    return floor - 4 * steep - 0.5 * ((1 - up) / 0.35) ** 2, f"upright by {up:.2f}"


def walks_ahead(wearer: Wearer) -> tuple[float, str]:
    """Walking is forward: mean cosine between heading and velocity, in full from 6 s of walking on."""
    walking = wearer.walking
    if not walking.any():
        return 0.0, ""
    velocity, heading = wearer.velocity[walking], wearer.heading[wearer.base : -wearer.base][walking]
    along = ((velocity * heading).sum(1) / np.linalg.norm(velocity, axis=1)).mean()
    return 1.5 * min(1.0, walking.sum() * wearer.step_s / 6) * along, f"walks ahead {along:.2f}"


def looks_down(wearer: Wearer) -> tuple[float, str]:
    """Heads look down rather than up: a mean pitch of 10 ± 12°, against its opposite; beyond 43° no more."""
    down = np.degrees(np.arcsin(-wearer.R[:, 2, 0].clip(-1, 1))).mean()
    return float(np.clip(10 * down / 12**2, -3, 3)), f"looks {'down' if down > 0 else 'up'} {abs(down):.0f}°"


def turns_on_a_neck(wearer: Wearer) -> tuple[float, str]:
    """A headset sits before the axis on which it turns, 0.1 ± 0.065 m.

    The lever r (m) is fitted to second differences, Δ²t = Δ²R r, while nobody walks, since the steps of a walk and the
    nods against them look like another one. It counts as turned to the mean pitch, and as well as it is determined.
    """
    k = wearer.base
    turns, moves = (x[2 * k :] - 2 * x[k:-k] + x[: -2 * k] for x in (wearer.R, wearer.t))
    turns, moves = turns[~wearer.walking].reshape(-1, 3), moves[~wearer.walking].reshape(-1)
    if not len(moves):
        return 0.0, ""
    square = turns.T @ turns + 1e-6 * np.eye(3)
    lever = np.linalg.solve(square, turns.T @ moves)
    scatter = np.linalg.inv(square) * ((moves - turns @ lever) ** 2).mean() * 4 * k
    ahead = np.array([wearer.R[:, 2, 2].mean(), 0.0, -wearer.R[:, 2, 0].mean()])
    ahead /= max(float(np.linalg.norm(ahead)), 1e-9)
    before, variance = float(ahead @ lever), float(ahead @ scatter @ ahead) + 0.065**2
    score = 0.1 * float(np.clip(before, -0.2, 0.2)) / variance
    return score, f"turns {100 * before:.0f} cm behind the eyes" if abs(score) > 0.5 else ""


def hands_on_their_sides(wearer: Wearer) -> tuple[float, str]:
    """The left hand is left of the neck, the right one right of it, 0.2 ± 0.2 m; both hang below it, 0.4 ± 0.3 m."""
    places = {joint: np.median(place, axis=0) for joint, (place, _) in wearer.hands.items()}
    beside = [at[1] if joint.startswith("left") else -at[1] for joint, at in places.items()]
    score = -sum(min(4.0, ((aside - 0.2) / 0.2) ** 2 / 2) for aside in beside)
    score -= sum(min(4.0, ((at[2] + 0.4) / 0.3) ** 2 / 2) for at in places.values())
    mean = sum(beside) / max(len(beside), 1)
    return score, f"hands {100 * abs(mean):.0f} cm on their {'sides' if mean > 0 else 'other sides'}" if beside else ""


def hands_ahead(wearer: Wearer) -> tuple[float, str]:
    """Hands are held ahead of the neck rather than behind: 0.15 ± 0.22 m, against the opposite."""
    ahead = [float(np.median(place[:, 0])) for place, _ in wearer.hands.values()]
    mean = sum(ahead) / max(len(ahead), 1)
    score = sum(0.15 * float(np.clip(x, -0.4, 0.4)) / 0.22**2 for x in ahead)
    return score, f"hands {100 * abs(mean):.0f} cm {'ahead' if mean > 0 else 'behind'}" if ahead else ""


def elbows_in_reach(wearer: Wearer) -> tuple[float, str]:
    """A forearm (0.25 m) behind a hand joint ends near the shoulder: at most 0.4 m from it. Fists may be held anyhow."""
    score = 0.0
    for joint, (place, fingers) in wearer.hands.items():
        if fingers is not None:
            shoulder = np.array([0.0, 0.18 if joint.startswith("left") else -0.18, -0.12])
            far = np.linalg.norm(place - 0.25 * fingers - shoulder, axis=1)
            score -= np.clip((far - 0.4) / 0.05, 0, 3).mean()
    return score, ""


TERMS = (
    stands, walks_ahead, looks_down, turns_on_a_neck, hands_on_their_sides, hands_ahead, elbows_in_reach
)  # fmt: skip


def in_our_axes(poses: dict[str, RawPoses], how: Conventions, where: str, convention: str | None = None) -> HeadsetLog:
    """A log's poses ("head", "left_wrist", "right_wrist") in metres and wearcap's axes, hands as wrists, with notes.

    What `how` states wins; `convention` is what the file's format fixes, which counts as `FORMAT_NATS` of evidence.
    Raises WearcapError, which names the candidates, where the evidence does not decide.
    """
    families = {joint: raw.families if how.hands == AUTO else (how.hands,) for joint, raw in poses.items()}
    stated, orders = how.quaternion != AUTO, CHOICES["quaternion"]
    known = how.quaternion if stated else poses["head"].order
    if known or poses["head"].rotation.ndim == 3:
        orders = (known or orders[0],)
    turned = {order: {joint: _matrices(raw, order) for joint, raw in poses.items()} for order in orders}
    unit, about_unit = (how.unit_m, [f"unit {how.unit} as given"]) if how.unit_m else _unit(poses, turned, where)
    if how.axes != AUTO and len(orders) == 1:
        order, axes, notes = orders[0], how.axes, [f"axes {how.axes} as given"]
    else:
        names, expected = (DETECTED, convention) if how.axes == AUTO else ((how.axes,), None)
        keys = [(name, order) for name in names for order in orders]
        readings = {(name, order): _wearer(poses, unit, turned[order], name, families) for name, order in keys}
        (axes, order), notes = _best(readings, expected, where)
    notes += [f"quaternions {known} as {'given' if stated else 'named'}"] if known else []
    tracks = {joint: _in_axes(raw, unit, turned[order][joint], axes) for joint, raw in poses.items()}
    head, wrists = tracks.pop("head"), {}
    seats = {joint: families[joint] for joint in tracks}
    for some in {some for some in seats.values() if len(some) > 1}:
        alike = {joint: track for joint, track in tracks.items() if seats[joint] == some}
        likely, sure = most_likely_seat(head, alike, some)
        notes.append(f"controllers or hands are not named: {likely} by how arms bend, {100 * sure:.0f} % sure")
        seats |= dict.fromkeys(alike, (likely,))
    for joint, track in tracks.items():
        (family,) = seats[joint]
        R = wrist_of_hand(track.R_world_body, joint, family)
        wrists[joint] = Trajectory(track.timestamps, R, track.t_world_body - R @ palm_of(joint, family))
        notes.append(f"{joint} from {SEATS[family].label}")
    height = float(np.percentile(head.t_world_body[:, 2].numpy(), 90))
    floor = FLOOR_M[0] < height < FLOOR_M[1]
    origin = f"the origin is {'' if floor else 'not '}on the floor (the head is {height:.2f} m above it)"
    return HeadsetLog(head, wrists, axes, floor, (*notes, *about_unit, origin), unit)


def _matrices(raw: RawPoses, order: str) -> np.ndarray:
    """Rotations (n, 3, 3) of a device in the file's axes."""
    if raw.rotation.ndim == 3:
        return raw.rotation
    places = [order.index(axis) for axis in "wxyz"]
    return rotation.matrix_from_quat_wxyz(torch.tensor(raw.rotation[:, places])).numpy()


def _unit(poses: dict[str, RawPoses], turned: dict[str, dict[str, np.ndarray]], where: str) -> tuple[float, list[str]]:
    """Metres per unit, and a note if it is not the metre: of m, cm and mm, that in which hands are in reach of the head,
    it moves no faster than people, and its height is that over a floor or near an origin at the head."""
    head, hands = poses["head"], [raw for joint, raw in poses.items() if joint != "head"]
    up = max((R["head"][:, axis, axis].mean(), axis) for R in turned.values() for axis in (1, 2))[1]
    height = float(np.percentile(head.position[:, up], 90))
    speeds = np.linalg.norm(np.diff(head.position, axis=0), axis=1) / np.diff(head.seconds).clip(1e-6)
    far = [np.linalg.norm(raw.position - head.position[_rows(head, raw)], axis=1) for raw in hands]
    reach = max(float(np.median(np.concatenate(far))), 1e-9) if far else None
    scores = {}
    for name in ("m", "cm", "mm"):
        metres = UNITS_M[name] * height
        score = 0.0 if FLOOR_M[0] < metres < FLOOR_M[1] else -0.3 if abs(metres) < 0.45 else -1.5
        score -= (math.log(UNITS_M[name] * reach / 0.55) / 0.35) ** 2 / 2 if reach else 0.0
        scores[name] = score - 4.0 * (UNITS_M[name] * np.percentile(speeds, 95) > FASTEST_M_S)
    best = max(scores, key=lambda name: scores[name])
    at = f"the head at {height:.4g}" + (f", the hands {reach:.3g} from it" if reach else "")
    if scores[best] < LEAST_UNIT:
        fix = "Say the unit: unit=m|cm|mm|inch|foot, or metres per unit."
        raise WearcapError(f"no unit of length fits: {at}", where, "a person in m, cm or mm", fix)
    return UNITS_M[best], [] if best == "m" else [f"unit {best} ({at}: {UNITS_M[best] * height:.2f} m)"]


def _rows(head: RawPoses, raw: RawPoses) -> np.ndarray:
    """The head's row at each time of another device."""
    return np.searchsorted(head.seconds, raw.seconds).clip(max=len(head.seconds) - 1)


def _wearer(
    poses: dict[str, RawPoses],
    unit: float,
    turned: dict[str, np.ndarray],
    name: str,
    families: dict[str, tuple[str, ...]],
) -> Wearer:
    """A log read in a convention."""
    M, head, hands = CONVENTIONS[name].double().numpy(), poses["head"], {}
    thin = max(1, int(1 / 30 / np.median(np.diff(head.seconds))))
    seconds, R, t = head.seconds[::thin], M @ turned["head"][::thin] @ M.T, unit * head.position[::thin] @ M.T
    left = R[:, :2, 1] / np.linalg.norm(R[:, :2, 1], axis=1, keepdims=True).clip(1e-9)
    frame = np.zeros_like(R)  # columns: ahead, left and up of the head
    frame[:, :2, 0], frame[:, :2, 1], frame[:, 2, 2] = np.stack([left[:, 1], -left[:, 0]], 1), left, 1.0
    neck = t + R @ np.array(NECK_M)
    for joint in (joint for joint in poses if joint != "head"):
        rows = (_rows(head, poses[joint])[::thin] // thin).clip(max=len(seconds) - 1)
        place = unit * poses[joint].position[::thin] @ M.T - neck[rows]
        fingers = (M @ turned[joint][::thin] @ M.T)[:, :, 0] if families[joint] == ("wrist",) else None
        seen = [None if x is None else np.einsum("nij,ni->nj", frame[rows], x) for x in (place, fingers)]
        hands[joint] = seen[0], seen[1]
    step = float(np.median(np.diff(seconds)))
    k = max(1, min(round(_BASE_S / step), (len(seconds) - 1) // 2))
    velocity = (t[2 * k :] - t[: -2 * k])[:, :2] / (seconds[2 * k :] - seconds[: -2 * k])[:, None]
    return Wearer(R, t, frame[:, :2, 0], hands, k, velocity, step)


def _best(
    readings: dict[tuple[str, str], Wearer], expected: str | None, where: str
) -> tuple[tuple[str, str], list[str]]:
    """The (convention, order) that people's habits show, with notes; `expected` is the format's convention."""
    scores, words = {}, {}
    for key, wearer in readings.items():
        terms = [term(wearer) for term in TERMS]
        fits = expected is not None and CONVENTIONS[key[0]] is CONVENTIONS[expected]
        scores[key] = sum(score for score, _ in terms) + FORMAT_NATS * fits
        words[key] = ", ".join(word for _, word in terms if word)
    best, *others = sorted(scores, key=lambda key: -scores[key])
    if (up := readings[best].R[:, 2, 2].mean()) < LEAST_UPRIGHT:
        what = f"in no axes and no order of the quaternion the headset is upright (at best {up:.2f}: {' '.join(best)})"
        fix = "Say what the poses have: axes=unity|openxr|unreal quaternion=xyzw|wxyz."
        raise WearcapError(what, where, f"{LEAST_UPRIGHT} or more", fix)
    lead = {key: scores[best] - scores[key] for key in others}
    near = [best, *(key for key in others if lead[key] < MARGIN)]
    if len(near) > 1:
        shown = "; ".join(f"{' '.join(key)} ({words[key]}; {-lead.get(key, 0.0):.1f})" for key in near[:3])
        choices = (("axes", sorted({name for name, _ in near})), ("quaternion", sorted({order for _, order in near})))
        fix = " ".join(f"{name}={'|'.join(some)}" for name, some in choices if len(some) > 1)
        what = f"how the headset's poses are to be read is not certain: {shown}"
        raise WearcapError(what, where, f"a reading that is better by {MARGIN:g}", f"Say which: {fix}.")
    margin = f"; margin {lead[others[0]]:.1f} over {' '.join(others[0])}" if others else ""
    same = " (SteamVR's are the same)" if best[0] == "openxr" else ""
    return best, [f"axes {best[0]}{same}: {words[best]}{margin}", f"quaternions {best[1]}, upright by {up:.2f}"]


def _in_axes(raw: RawPoses, unit: float, R: np.ndarray, name: str) -> Trajectory:
    """A path of a named convention in metres and wearcap's axes, world and device alike."""
    M = CONVENTIONS[name].double().numpy()
    turned, t = (torch.tensor(x, dtype=torch.float32) for x in (M @ R @ M.T, unit * raw.position @ M.T))
    return Trajectory(torch.tensor(raw.seconds), turned, t)
