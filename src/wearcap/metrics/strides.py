"""What gait laboratories report of walking: steps and strides, their lengths, times and symmetry, from a motion's contacts."""

from bisect import bisect_left, bisect_right
from dataclasses import dataclass, fields
from itertools import pairwise
from statistics import fmean, stdev
from typing import Any

import numpy as np
import torch

from wearcap.body.skeleton import FOOT_PATCHES, SIDES
from wearcap.metrics.physics import foot_contact, foot_points
from wearcap.recording.motion import Motion
from wearcap.sensors.contacts import contacts_from_motion, steady

_STRIDE_S, _STRIDE_M = (0.5, 2.5), 0.2
"""Duration of a stride, and its least length: people who shuffle after a stroke walk some 0.3 m."""
_EARLIER_S = 0.3
"""Longest time between a strike and a sole at rest, and between that and the toes' leaving the floor."""
_FORWARD = 0.8
"""Least cosine between a stride and the pelvis' forward axis: turns, side steps and steps backwards are not counted."""


@dataclass(frozen=True)
class Stride:
    """From a foot's strike to its next one; the step is its second half, from the other foot's strike."""

    stride_length_m: float
    step_length_m: float
    """Along the stride, from the other foot's place."""
    step_width_m: float
    """Distance of the other foot's place from the line of this foot's two (Huxham et al. 2006); negative if they cross."""
    stride_time_s: float
    step_time_s: float
    stance_time_s: float
    swing_time_s: float
    stance_percent: float
    cadence_per_min: float
    """Steps per minute."""
    speed_m_s: float


@dataclass(frozen=True)
class _Stance:
    start_s: float
    stop_s: float
    place: np.ndarray
    """Horizontal place (m) of the ankle while the sole rests."""


def strides(motion: Motion) -> tuple[list[Stride], list[Stride]]:
    """Strides of the left and of the right foot that go straight ahead, one step of the other foot in each.

    Contacts are the motion's own (probability above one half), else those of the feet's speed. Raises WearcapError for a
    skeleton without heels and toe tips.
    """
    ahead, times = motion.joint("pelvis").R[:, :2, 0].double().numpy(), motion.timestamps.numpy()
    stances = _stances(motion)
    found: tuple[list[Stride], list[Stride]] = ([], [])
    for k, sign in ((0, 1.0), (1, -1.0)):
        others = [stance.start_s for stance in stances[1 - k]]
        for here, there in pairwise(stances[k]):
            between = stances[1 - k][bisect_right(others, here.start_s) : bisect_left(others, there.start_s)]
            duration, gone = there.start_s - here.start_s, there.place - here.place
            length = float(np.linalg.norm(gone))
            if len(between) != 1 or not _STRIDE_S[0] < duration < _STRIDE_S[1] or length < _STRIDE_M:
                continue
            first, last = np.searchsorted(times, (here.start_s, there.start_s))
            facing = ahead[first : last + 1].mean(0)
            if facing @ gone < _FORWARD * length * np.linalg.norm(facing):
                continue
            along, other, stance = gone / length, between[0], here.stop_s - here.start_s
            x, y = other.place - here.place
            found[k].append(
                Stride(
                    stride_length_m=length,
                    step_length_m=float((there.place - other.place) @ along),
                    step_width_m=sign * float(x * along[1] - y * along[0]),
                    stride_time_s=duration,
                    step_time_s=there.start_s - other.start_s,
                    stance_time_s=stance,
                    swing_time_s=duration - stance,
                    stance_percent=100 * stance / duration,
                    cadence_per_min=120 / duration,
                    speed_m_s=length / duration,
                )
            )
    return found


def _stances(motion: Motion) -> tuple[list[_Stance], ...]:
    """Stances of the left and of the right foot whose strike and end are in the motion, in order of time.

    Contacts tell that there is one; they are of soles at rest, which begin after the strike and end before the toes leave
    the floor. These moments are those of Zeni et al. 2008: the heel is farthest before the pelvis, and the toe tip farthest
    behind it.
    """
    contact = contacts_from_motion(motion) if motion.contact_prob is None else motion.contact_prob > 0.5
    feet = steady(foot_contact(contact), motion.fps).numpy()
    pelvis, points = motion.joint("pelvis"), foot_points(motion.skeleton, motion.T_world_joint)
    ahead = torch.einsum("tfpc,tc->tfp", (points - pelvis.t[:, None, None])[..., :2], pelvis.R[:, :2, 0]).numpy()
    times, found = motion.timestamps.numpy(), ([], [])
    for k, side in enumerate(SIDES):
        ankle = motion.joint(f"{side}_ankle").t[:, :2].double().numpy()
        edges = np.diff(feet[:, k].astype(np.int8), prepend=0, append=0)
        rests = list(zip(np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)))
        for before, (start, stop), after in zip([(0, 0), *rests], rests, [*rests[1:], (len(times), 0)]):
            if start == 0 or stop == len(times):
                continue
            middle = (start + stop) // 2
            first = max(before[1], int(np.searchsorted(times, times[start] - _EARLIER_S)))
            last = min(after[0], int(np.searchsorted(times, times[stop] + _EARLIER_S)))
            strike = first + int(ahead[first : middle + 1, k, 0].argmax())
            off = middle + int(ahead[middle:last, k, 1].argmin())
            place = np.median(ankle[start:stop], axis=0)
            found[k].append(_Stance(float(times[strike]), float(times[off]), place))
    return found


def gait_report(motion: Motion) -> dict[str, Any] | None:
    """Mean and spread (standard deviation) of each quantity of `Stride` by side, and the sides' asymmetry.

    The asymmetry is Robinson's (1987), 200 (left − right) / (left + right) of the means, in percent. None of a motion
    without a stride, and where there is nothing to tell contacts by.
    """
    sites = all(patch in motion.skeleton.sites for patch in FOOT_PATCHES)
    if len(motion) < 3 or (motion.contact_prob is None and not sites):
        return None
    sides = dict(zip(SIDES, strides(motion)))
    if not any(sides.values()):
        return None
    report: dict[str, Any] = {"strides": sum(map(len, sides.values()))}
    for side, own in sides.items():
        report[side] = {"strides": len(own)}
        for name in (field.name for field in fields(Stride)) if own else ():
            values = [getattr(stride, name) for stride in own]
            std = stdev(values) if len(values) > 1 else None
            report[side][name] = {"mean": round(fmean(values), 4), "std": None if std is None else round(std, 4)}
    if all(sides.values()):
        means = {name: [report[side][name]["mean"] for side in SIDES] for name in report["left"] if name != "strides"}
        names = ("step_length_m", "step_time_s", "stance_time_s", "swing_time_s")
        report["asymmetry_percent"] = {
            name: round(200 * (means[name][0] - means[name][1]) / sum(means[name]), 2) for name in names
        }
    return report
