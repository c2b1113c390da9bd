"""Feet from footprints: planted soles that roll about heel and ball, swings between them, and the load on each foot."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float

from wearsim.people.plan import SIDES, STEP_M, Footprint, Plan
from wearsim.people.track import Track, ease, hermite

ROLL_DOWN_S = 0.12
"""Time from landing to the flat foot."""
ROLL_UP_S = 0.59
"""Time from the flat foot to toe-off."""
STRIKE_RATE, OFF_RATE = 1.3, 2.1
"""Turn rates of the sole at landing and toe-off, as multiples of its pitch then over these times."""
TURN_ON = 0.42
"""Share of a swing in which the turn of the toe-off dies down."""
HANGING_RAD = 0.28
"""How far the toes lag behind the smoothest turn, late in mid-swing."""
TOES_FLAT, TOES_STIFF = 0.21, 0.4
"""Pitch of the sole (rad) up to which the toes stay flat, and what slows their further bend (rad²)."""
YIELD_RAD, YIELD_S, YIELD_TOP = 0.16, 0.51, 0.33
"""Bend by which a knee yields to the load in a long step, for how long, and when it is largest, as a share of that."""
FULL_STRIKE = -0.33
"""Pitch of a landing sole in a long step (rad)."""
SOFT_M = 0.008
"""Width over which the lowest point of a swinging sole changes from ball to heel."""
LONG_STAND_S = 0.9
EARLY_LIFT = 0.02
"""Height of the sole early in the swing, when it moves away over the floor (m)."""
LATE_LIFT = 0.04
"""Height of the heel shortly before it lands, per angle by which the toes are up then (m/rad)."""
STAIR_WAIT = 0.18
"""Share of a swing up a stair during which the foot only rises, and of one down during which it only sinks."""

Ramp = float | Float[np.ndarray, "*#batch"]
"""A share of a swing, one for all frames or each frame's own."""


@dataclass(frozen=True)
class _FootMotion:
    """One foot over time."""

    ankle: Float[np.ndarray, "time 3"]
    ground: Float[np.ndarray, "time 3"]
    """Floor point below the flat foot's ankle; between prints during the swing (m)."""
    heading: Float[np.ndarray, "time"]
    pitch: Float[np.ndarray, "time"]
    """Pitch of the foot relative to the horizontal, toe down positive (rad)."""
    toe_bend: Float[np.ndarray, "time"]
    """Upward bend of the toes (rad)."""
    planted: Bool[np.ndarray, "time"]
    contact: Bool[np.ndarray, "time 2"]
    """Contact of heel and toe tip."""
    pressure: Float[np.ndarray, "time 3"]
    """Centre of pressure of the foot on the floor while it stands (m)."""
    landed_s: Float[np.ndarray, "time"]
    """Time of the last landing."""
    yielding: Float[np.ndarray, "time"]
    """Bend by which the knee yields to the load after a landing, and takes back until the heel rises (rad)."""
    running: Bool[np.ndarray, "time"]
    climbs: Bool[np.ndarray, "time"]
    """Between a print and one on another step, kerb or stair."""

    @classmethod
    def of(cls, plan: Plan, side: str, times: Float[np.ndarray, "time"]) -> "_FootMotion":
        """Move a foot through its prints. Planted patches stand still in the world; swings clear the floor.

        In a stance the sole turns about the heel (toe up) or, with toes flat, about the ball (heel up); the swing
        continues both the turn and its rate, so that ankle and pitch are twice continuously differentiable.
        """
        skeleton, at = plan.skeleton, _Timeline(plan.prints[side], times)
        # points of the foot in the ankle's axes (the tip in the toe joint's), flat on the floor (m)
        heel, tip = (np.array(skeleton.sites[f"{side}_{site}"].t_joint_site) for site in ("heel", "toe_tip"))
        ball = skeleton.t_parent_joint[skeleton.index(f"{side}_toe")].double().numpy()
        roll, bend = at.roll(plan.heel_lift[side].sample(times)[:, 0])
        share, lifted = at.swing_share, bump(at.swing_share)
        rise = at["step"]
        slope = at.mix("height", np.ones_like(share)) - at["height"] - rise
        moved, turned = advance(share, rise), ease(share)
        # the stationary point is the ball while the heel is up, the heel while the toe is
        on_heel = np.where(at.planted, (roll < 0).astype(np.float64), np.where(at.land_pitch_next > 0, 0.0, turned))
        pivot_x, pivot_z = (ball[i] + on_heel * (heel[i] - ball[i]) for i in (0, 2))
        rolled = pivot_x - (np.cos(roll) * pivot_x + np.sin(roll) * pivot_z)
        # once the toes bend no further, the foot goes on about their tip
        tipped = tip[0] - (np.cos(roll - bend) * tip[0] + np.sin(roll - bend) * tip[2])
        rolled = rolled + (1.0 - on_heel) * tipped
        early = (share / 0.25) ** 3 * ((1.0 - share) / 0.75) ** 9  # the top at 0.25
        late = (share / 0.75) ** 9 * ((1.0 - share) / 0.25) ** 3  # a bump with its top at 0.75
        # height of the ankle over the sole's lowest point (m): a softened maximum over heel, ball and tip
        soft = SOFT_M * lifted
        sole_cos, sole_sin = np.cos(roll), np.sin(roll)
        toe_cos, toe_sin = np.cos(roll - bend), np.sin(roll - bend)
        ball_depth = sole_sin * ball[0] - sole_cos * ball[2]
        points = np.stack(
            [
                sole_sin * heel[0] - sole_cos * heel[2],
                ball_depth - toe_cos * tip[2],
                ball_depth + toe_sin * tip[0] - toe_cos * tip[2],
            ]
        )
        width = np.maximum(soft, 1e-5)
        top = points.max(0)
        depth = top + width * np.log(np.exp((points - top) / width).sum(0)) * (soft > 1e-5)
        raised = (
            at.clearance * lifted + EARLY_LIFT * early + LATE_LIFT * np.maximum(-at.land_pitch_next, 0.0) * late + depth
        )
        tilt, heading = at.mix("tilt", turned), at.mix("heading", turned)
        ground = at.mix("ground", moved[:, None])
        ground[:, 2] = at["height"] + slope * moved + rise * climb(rise, share)
        outward = at.bow * lifted
        cos, sin = np.cos(heading), np.sin(heading)
        ground[:, 0] -= outward * sin
        ground[:, 1] += outward * cos
        along = rolled * np.cos(tilt) + raised * np.sin(tilt)
        above = raised * np.cos(tilt) - rolled * np.sin(tilt)
        ankle = ground + np.stack([along * cos, along * sin, above], 1)
        pressure = ground + at.pressure(heel, ball)[:, None] * np.stack([cos, sin, np.zeros_like(cos)], 1)
        contact = at.planted[:, None] & np.stack([roll < 0.01, roll > -0.01], 1)
        landed, yielding, pitch = at["land_s"], at.yielding(), roll + tilt
        gait = (at.planted, contact, pressure, landed, yielding, at.running, at["climbs"])
        return cls(ankle, ground, heading, pitch, bend, *gait)


@dataclass(frozen=True)
class Feet:
    """Both feet of a plan at the times of a motion's frames (s); the rest of the body follows from them."""

    plan: Plan
    times: Float[np.ndarray, "time"]
    fps: float
    left: _FootMotion
    right: _FootMotion

    @classmethod
    def of(cls, plan: Plan, times: Float[np.ndarray, "time"], fps: float) -> "Feet":
        """The feet moved through the plan's prints."""
        return cls(plan, times, fps, *(_FootMotion.of(plan, side, times) for side in SIDES))

    def __getitem__(self, side: str) -> _FootMotion:
        return getattr(self, side)

    def load_on_left(self, rng: np.random.Generator) -> Float[np.ndarray, "time"]:
        """Share of the weight on the left foot; while standing long it shifts from leg to leg now and then."""
        times, alone = self.times, self.left.planted.astype(int) - self.right.planted.astype(int)
        edges = np.flatnonzero(np.diff(alone)) + 1
        starts, stops = np.concatenate([[0], edges]), np.concatenate([edges, [len(times)]])
        runs = [(alone[a], times[a], times[min(b, len(times) - 1)]) for a, b in zip(starts, stops)]
        load = Track(np.array([0.5 + 0.5 * runs[0][0]]))
        for index, (side, start, stop) in enumerate(runs):
            if side != 0:
                continue
            target = 0.5 + 0.5 * runs[index + 1][0] if index + 1 < len(runs) else 0.5
            if stop - start < LONG_STAND_S:
                load.move(start, stop, target)
                continue
            load.move(start, start + 0.45, 0.5)
            first, last = start + 0.6, stop - 0.8
            time = first + rng.exponential(3.0)
            while time + 2.0 < last:
                load.move(time, time + rng.uniform(0.8, 1.6), np.clip(0.5 + rng.normal(0.0, 0.17), 0.12, 0.88))
                time += 1.7 + rng.exponential(6.0)
            load.move(max(last - 0.8, first), max(last, first + 0.1), 0.5)
            load.move(stop - 0.5, stop, target)
        return load.sample(times)[:, 0]


class _Timeline:
    """Index of each frame's print, and the values of that print gathered per frame."""

    def __init__(self, prints: list[Footprint], times: np.ndarray):
        columns = {
            name: np.array([getattr(p, name) for p in prints], np.float64)
            for name in ("land_s", "lift_s", "land_pitch", "lift_pitch", "clearance", "bow", "tilt", "heading")
        }
        columns["ground"] = np.stack([p.ground for p in prints])
        columns["height"] = columns["ground"][:, 2]
        columns["step"] = np.array([a.rise_to(b) for a, b in pairwise(prints)] + [0.0])
        steps = np.abs(columns["step"]) > STEP_M
        columns["climbs"] = steps | np.append(False, steps[:-1])
        self._columns = columns
        self.now = np.clip(np.searchsorted(columns["land_s"], times, side="right") - 1, 0, None)
        self.next = np.minimum(self.now + 1, len(prints) - 1)
        self.since_land = times - self["land_s"]
        self.until_lift = self["lift_s"] - times
        self.planted = self.until_lift > 0
        self.swing_s = np.where(self.planted, 1.0, columns["land_s"][self.next] - self["lift_s"])
        self.swing_share = np.clip(-self.until_lift / self.swing_s, 0.0, 1.0)
        self.clearance, self.bow = columns["clearance"][self.next], columns["bow"][self.next]
        stance_s = (columns["lift_s"] - columns["land_s"])[self.next]
        self.down_next = np.minimum(ROLL_DOWN_S, 0.35 * stance_s)
        self.land_pitch_next = columns["land_pitch"][self.next]
        run = np.array([p.running for p in prints])
        self.running = run[self.now] | run[self.next]

    def __getitem__(self, name: str) -> np.ndarray:
        return self._columns[name][self.now]

    def mix(self, name: str, share: np.ndarray) -> np.ndarray:
        """A value between that of a frame's print and that of the next, by a share."""
        here = self._columns[name][self.now]
        return here + share * (self._columns[name][self.next] - here)

    def roll(self, heel_lift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pitch of the sole against the floor and bend of the toes (rad)."""
        stance_s = self["lift_s"] - self["land_s"]
        down, up = np.minimum(ROLL_DOWN_S, 0.35 * stance_s), np.minimum(ROLL_UP_S, 0.58 * stance_s)
        rate = OFF_RATE * self["lift_pitch"] / up
        zero = np.zeros_like(rate)
        landing = hermite(self.since_land / down, (self["land_pitch"], zero), (-STRIKE_RATE * self["land_pitch"], zero))
        leaving = hermite(1.0 - self.until_lift / up, (zero, self["lift_pitch"]), (zero, rate * up))
        stance = landing + leaving + heel_lift
        start = (self["lift_pitch"] + heel_lift, rate * self.swing_s)
        arriving = -STRIKE_RATE * self.land_pitch_next / self.down_next * self.swing_s
        swing = hermite(self.swing_share, (start[0], self.land_pitch_next), (zero, arriving))
        swing += hermite(self.swing_share / TURN_ON, (zero, zero), (TURN_ON * start[1], zero))
        swing += HANGING_RAD * (self.swing_share / 0.625) ** 5 * ((1.0 - self.swing_share) / 0.375) ** 3
        early, late = self.swing_share / 0.5, self.swing_share / 0.4 - 1.5
        bent, gain = toe_bend(start[0])
        relax = hermite(early, (bent, zero), (gain * start[1] * 0.5, zero))
        brace = hermite(late, (zero, np.maximum(self.land_pitch_next, 0.0)), (zero, np.minimum(0.4 * arriving, 0.0)))
        roll = np.where(self.planted, stance, swing)
        return roll, np.where(self.planted, toe_bend(stance)[0], relax + brace)

    def yielding(self) -> np.ndarray:
        """Bend of the knee beyond the nearly straight one with which the heel strikes (rad); more in longer steps."""
        strike = np.clip(self["land_pitch"] / FULL_STRIKE, 0.0, 1.2) ** 2
        share = self.since_land / np.minimum(YIELD_S, 0.62 * (self["lift_s"] - self["land_s"]))
        return YIELD_RAD * strike * ease(share / YIELD_TOP) * ease((1.0 - share) / (1.0 - YIELD_TOP))

    def pressure(self, heel: Float[np.ndarray, "3"], ball: Float[np.ndarray, "3"]) -> np.ndarray:
        """Centre of pressure ahead of the ankle (m): from heel to toes in a step, under the arch when standing."""
        middle = 0.30 * ball[0]
        after, before = ease(self.since_land / 0.28), ease(1.0 - self.until_lift / 0.45)
        strike = np.clip(self["land_pitch"] / -0.3, -1.0, 1.0)
        back = np.where(strike > 0, strike * (0.4 * heel[0] - middle), -strike * (ball[0] - middle))
        forth = np.clip(self["lift_pitch"] / 0.6, 0.0, 1.0) * (ball[0] + 0.01 - middle)
        return middle + back * (1.0 - after) + forth * before


def toe_bend(roll: Float[np.ndarray, "time"]) -> tuple[Float[np.ndarray, "time"], Float[np.ndarray, "time"]]:
    """Bend of the toes of a standing foot whose heel is up by an angle (rad), and its derivative: they lie flat at
    first, and bend less the further the heel is up."""
    beyond = np.maximum(roll - TOES_FLAT, 0.0)
    scale = beyond**2 + TOES_STIFF
    return np.maximum(roll, 0.0) - beyond**3 / scale, 1.0 - beyond**2 * (beyond**2 + 3.0 * TOES_STIFF) / scale**2


def glide(share: Float[np.ndarray, "*batch"], ramps: tuple[Ramp, Ramp] = (0.26, 0.4)) -> Float[np.ndarray, "*batch"]:
    """Progress of a swing, 0 to 1: accelerates over the first of `ramps` (shares of it), decelerates over the last."""

    def integral(u):
        return u**3 * (1.0 - 0.5 * u)

    first, last = ramps
    rise = first * integral(np.clip(share / first, 0.0, 1.0))
    flat = np.clip(share - first, 0.0, 1.0 - first - last)
    fall = last * (0.5 - integral(np.clip((1.0 - share) / last, 0.0, 1.0)))
    return (rise + flat + fall) / (1.0 - (first + last) / 2)


def advance(share: Float[np.ndarray, "*batch"], rise: Float[np.ndarray, "*#batch"]) -> Float[np.ndarray, "*batch"]:
    """Horizontal progress of a swing that rises by `rise` (m) in total, from 0 to 1."""
    up, down = np.clip(rise / 0.12, 0.0, 1.0), np.clip(-rise / 0.12, 0.0, 1.0)
    both = up + down
    return glide(
        np.clip((share - STAIR_WAIT * up) / (1.0 - STAIR_WAIT * both), 0.0, 1.0), (0.26 + 0.1 * both, 0.4 - 0.1 * both)
    )


def bump(share: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
    """Profile of a swing's lift: 0 at both ends, 1 in the middle."""
    return 64.0 * (share * (1.0 - share)) ** 3


def climb(rise: Float[np.ndarray, "*#batch"], share: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
    """Height profile of the floor below a swing: up early and down late, so that the foot clears the stair's edge."""
    early, late = ease(share / 0.58), ease((share - 0.45) / 0.55)
    up = np.clip(0.5 + rise / 0.12, 0.0, 1.0)
    return up * early + (1.0 - up) * late
