"""The plan of a simulated motion: footprints and keyed channels, written by activities and read by the generator."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
from jaxtyping import Float
from torch import Tensor

from wearsim.handling.grips import Grip
from wearsim.people.person import Person
from wearsim.people.track import Track
from wearsim.places.outline import turn

SIDES = ("left", "right")
OTHER = {"left": "right", "right": "left"}
LEFT_SIGN = {"left": 1.0, "right": -1.0}
STEEPEST = 0.2
"""A foot adapts to slopes below this, and stays level on steeper ones (a step's edge)."""
STEP_M = 0.05
"""Rise from print to print, beyond that of their slopes, from which on it counts as a step."""
SOFT_M = 0.02
"""Height that soft knees and a slouch take off a standing body."""

A = TypeVar("A", float, np.ndarray)


def wrap(angle: A) -> A:
    """The same angle in [-π, π)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


@dataclass(frozen=True)
class Footprint:
    """Place and time of a foot's stance; pitches are of the sole relative to the floor, toe down positive (rad)."""

    ground: Float[np.ndarray, "3"]
    """Floor point below the ankle of the flat foot (m)."""
    heading: float
    """Heading of the foot (rad), unwrapped."""
    tilt: float = 0.0
    """Tilt of the floor along the foot, falling forwards positive (rad)."""
    land_s: float = -1e3
    lift_s: float = 1e6
    land_pitch: float = 0.0
    lift_pitch: float = 0.0
    clearance: float = 0.02
    """Clearance of the sole above the floor in the middle of the swing that ends here (m)."""
    bow: float = 0.0
    """Outward deviation of that swing from the straight line (m)."""
    running: bool = False

    def rise_to(self, new: "Footprint") -> float:
        """Height of a new print above this one (m) beyond the slope on which both stand: a step, kerb or stair."""
        rise = float(new.ground[2] - self.ground[2])
        if self.tilt == new.tilt == 0.0:
            return rise
        offset = (new.ground - self.ground)[:2]
        slopes = (-np.tan(p.tilt) * (offset @ turn(p.heading)[:, 0]) / 2 for p in (self, new))
        remaining = rise - sum(slopes)
        return remaining if abs(remaining) > STEP_M else 0.0


@dataclass
class HandScore:
    """Plan of one hand beyond swinging: a held posture relative to the chest, and a goal in the world."""

    pose_weight: Track = field(default_factory=lambda: Track(np.zeros(1)))
    pose: Track = field(default_factory=lambda: Track(np.zeros(6)))
    """Wrist from the shoulder in the chest's axes as a share of the arm's length (left hand's mirror image for
    the right), elbow swivel (rad, 0 points down, positive lifts outwards), hand roll and hand bend (rad)."""
    goal_weight: Track = field(default_factory=lambda: Track(np.zeros(1)))
    goal: Track = field(default_factory=lambda: Track(np.zeros(3)))
    """Wrist in the world (m)."""

    def go_for(self, point: Float[np.ndarray, "3"], out: tuple[float, float], back: tuple[float, float]) -> None:
        """Bring the wrist to a point in the world (m) in one interval of time and let it go in another (s)."""
        self.goal.move(out[0], out[0], point)
        self.goal_weight.visit(1.0, out, back)

    def take(self, pose, out: tuple[float, float], back: tuple[float, float]) -> None:
        """Bring a hanging hand into a pose in one interval of time and let it hang again in another (s)."""
        self.pose.move(out[0], out[0], pose)
        self.pose_weight.visit(1.0, out, back)


@dataclass(frozen=True)
class Label:
    """The time of an activity, by its name."""

    start_s: float
    stop_s: float
    name: str


class Plan:
    """The motion planned so far. Activities append to it; `time` is when the next may start."""

    def __init__(self, person: Person, position: np.ndarray, heading: float, floor_height: Callable[..., np.ndarray]):
        self.skeleton, self.style, self.floor_height = person.skeleton, person.style, floor_height
        self.time = 0.0
        self.labels: list[Label] = []
        self.hands = {side: HandScore() for side in SIDES}
        self.grips: dict[str, list[Grip]] = {side: [] for side in SIDES}
        """Grips in the order of time; one may be reached for while the one before it is left."""
        self.lean = Track(np.zeros(3))
        """Trunk lean beyond the habitual one: forward lean, bend to the right, twist to the left (rad)."""
        self.crouch = Track(np.zeros(1))
        """Lowering of the pelvis (m)."""
        self.shift = Track(np.zeros(2))
        """Offset of the pelvis from its balanced place, forwards and to the left (m): pushing leans on it."""
        self.heel_lift = {side: Track(np.zeros(1)) for side in SIDES}
        """Pitch of a standing foot on its ball (rad)."""
        self.seat_weight = Track(np.zeros(2))
        """Weight of `seat` relative to the feet in the pelvis' position: in the plane, and in height."""
        self.seat = Track(np.array([*position[:2], 0.9]))
        """Hip middle when sitting, in the world (m)."""
        self.gaze = Track(np.array([0.0, 0.0]))
        """Head relative to the walking direction: yaw to the left, pitch downwards (rad)."""
        self.gaze_weight = Track(np.zeros(1))
        self.gaze_point = Track(np.array([*position[:2], 1.5]))
        """A point in the world that is looked at while its weight is 1 (m)."""
        self.prints: dict[str, list[Footprint]] = {
            side: [self.footprint(side, position, heading, self.style.gait.stance_width / 2)] for side in SIDES
        }

    def footprint(self, side: str, center: np.ndarray, heading: float, half_width: float, **how) -> Footprint:
        """A print beside a floor point, turned out by the wearer's habit, on the floor near the point's height."""
        sign = LEFT_SIGN[side]
        ground = np.array(center, np.float64)
        ground[:2] += sign * half_width * turn(heading)[:, 1]
        foot_heading = heading + sign * self.style.gait.toe_out
        heel, tip = self.sole
        under = ground[:2] + np.array([0.0, heel, tip])[:, None] * turn(foot_heading)[:, 0]
        heights = self.floor_height(under, np.full(3, ground[2]))
        tilt = 0.0
        if np.isfinite(heights[0]):
            ground[2] = heights[0]
            slope = (heights[2] - heights[1]) / (tip - heel)
            if abs(slope) < STEEPEST:  # a slope, not an edge; on its bend the sole bridges heel and toes
                tilt = float(-np.arctan(slope))
                ground[2] = heights[1] - heel * slope
        return Footprint(ground, foot_heading, tilt, **how)

    @property
    def sole(self) -> tuple[float, float]:
        """Distances of heel and tip of the toes ahead of the ankle (m)."""
        toe, sites = self.skeleton.index("left_toe"), self.skeleton.sites
        ball = float(self.skeleton.t_parent_joint[toe, 0])
        return sites["left_heel"].t_joint_site[0], ball + sites["left_toe_tip"].t_joint_site[0]

    def step(self, side: str, lift_s: float, land_s: float, lift_pitch: float, print_: Footprint) -> None:
        """Lift a foot and put it down on a new print; `time` becomes the moment of landing."""
        prints = self.prints[side]
        prints[-1] = replace(prints[-1], lift_s=lift_s, lift_pitch=lift_pitch)
        heading = prints[-1].heading + wrap(print_.heading - prints[-1].heading)
        prints.append(replace(print_, land_s=land_s, heading=heading))
        self.time = land_s

    def grip(self, side: str, grip: Grip) -> None:
        """Add a grip to a hand; the hand must have let go of its last object."""
        if self.grips[side] and self.grips[side][-1].release_s > grip.start_s + 1e-9:
            raise ValueError(f"the {side} hand reaches at {grip.start_s} s for one object while it holds another")
        self.grips[side].append(grip)

    def bones(self, *joints: str) -> Float[Tensor, "joint 3"]:
        """Offsets of joints from their parents in the rest pose (m), in float64."""
        return self.skeleton.t_parent_joint[self.skeleton.indices(*joints)].double()

    @property
    def position(self) -> Float[np.ndarray, "3"]:
        """Floor point between the feet as they stand at the end of the plan (m)."""
        return (self.prints["left"][-1].ground + self.prints["right"][-1].ground) / 2

    @property
    def heading(self) -> float:
        """Heading of the body at the end of the plan (rad)."""
        left, right = (self.prints[side][-1].heading for side in SIDES)
        return right + wrap(left - right) / 2

    @property
    def hip_height(self) -> float:
        """Height of the hips above the floor when standing upright (m)."""
        skeleton = self.skeleton
        legs = skeleton.indices("left_knee", "left_ankle")
        return float(-skeleton.t_parent_joint[legs, 2].sum()) - skeleton.sites["left_heel"].t_joint_site[2]

    @property
    def arm_length(self) -> float:
        """Distance from shoulder to wrist (m)."""
        joints = self.skeleton.indices("left_elbow", "left_wrist")
        return float(self.skeleton.t_parent_joint[joints].norm(dim=-1).sum())

    @property
    def shoulder(self) -> Float[np.ndarray, "3"]:
        """Position of the left shoulder relative to the chest's joint in the rest pose (m)."""
        return self.bones("left_collar", "left_shoulder").sum(0).numpy()

    @property
    def shoulder_height(self) -> float:
        """Height of the shoulders above the floor when standing upright (m)."""
        spine = self.skeleton.indices("l5", "l3", "t12", "t8")
        above = float(self.skeleton.t_parent_joint[spine, 2].sum()) + float(self.shoulder[2])
        return self.hip_height + above - SOFT_M

    def label(self, start_s: float, name: str) -> None:
        self.labels.append(Label(start_s, self.time, name))
