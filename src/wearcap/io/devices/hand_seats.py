"""How what a hand holds or wears sits on the wrist joint: a table of seats, and the choice among them by what arms can do.

Headsets give the poses of controllers, of which the body needs the wrist. A log that does not say what its poses are of is
read with each seat: elbows between the head's shoulders and the wrist, joint limits and a loose prior tell which one a
living arm could have held.
"""

import math
from collections.abc import Sequence, Set
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from wearcap.body.skeleton import xsens23
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import Trajectory

PALM_M = 0.08
"""Distance (m) of the palm's middle, where a controller is held, from the wrist (nominal)."""


@dataclass(frozen=True)
class HandSeat:
    """A device's pose in the hand; its axes are x forward, y left, z up, as files are read."""

    label: str
    pitch_deg: float
    """Angle by which the straight hand points below the device's forward axis, the thumb up; `flat` devices have none."""
    ahead_m: float
    """How far the device's origin lies ahead of the palm's middle, along its forward axis."""
    deviation_deg: float
    """Standard deviation of that angle among hands and models (prior)."""
    flat: bool = False
    """Whether forward is along the fingers and up is out of the hand's back, as of OpenXR's hand joints."""
    palm_m: float = PALM_M


SEATS = {
    # OpenXR 1.1, 6.3.2: "-Z goes through the tube formed by the fingers, from little finger to thumb, +X into the right palm".
    # A tube lies obliquely in a fist: on Touch, SteamVR's render models have openxr_aim 60° below openxr_grip.
    "grip": HandSeat("the controller (grip pose)", 60.0, 0.0, 12.0),
    # The same section: a ray "pointed by moving the forearm"; its origin is the controller's front.
    "aim": HandSeat("the controller (aim pose)", 0.0, 0.04, 12.0),
    # Unity's Oculus plugin and SteamVR's raw Touch: A-Frame points the ray along (0, -0.8, -1), 39° below forward.
    "touch": HandSeat("a Touch controller (its own pose)", 39.0, 0.02, 12.0),
    # SteamVR's render model: the grip is turned up by 15.4° against the raw pose, and 13 cm behind it.
    "index": HandSeat("an Index controller (raw pose)", 45.0, 0.13, 12.0),
    # SteamVR's raw pose lies in the ring, ahead of the handle. Wands are held like remotes: forearms are 14° below forward.
    "vive": HandSeat("a Vive wand (raw pose)", 14.0, 0.11, 15.0),
    # XR_EXT_hand_tracking: -Z along the fingers to the tip, +Y out of the back.
    "wrist": HandSeat("the hand joint", 0.0, 0.0, 8.0, flat=True, palm_m=0.0),
    "palm": HandSeat("the palm's joint", 0.0, 0.0, 8.0, flat=True),
}
"""Seats by family, as `hands=` names them."""
HELD = ("grip", "aim", "touch", "index", "vive")
CANDIDATES = (*HELD, "wrist")
"""Families that are told apart where a log says nothing; the palm's joint turns as the wrist's does."""
_NAMES = {
    "wrist": {"wrist"}, "grip": {"grip"}, "aim": {"aim", "pointer"}, "touch": {"touch"}, "index": {"knuckles"},
    "vive": {"vive", "wand"}
}  # fmt: skip
"""Words that name a family."""
_OF_HELD = {"controller", "controllers", "ctrl", "saber"}
_OF_HANDS = {"hand", "hands", "lefthand", "righthand", "joint"}
NECK_M, SHOULDER_M = (-0.1, 0.0, -0.1), (-0.05, 0.18, -0.07)
"""The neck seen from a headset, in its axes, and the left shoulder seen from there, in the head's heading (m)."""
# Means and standard deviations (degrees) of people at CMU and in VR games, the latter widened by half for other habits.
FLEXION_DEG, DEVIATION_DEG, PRONATION_DEG, SWIVEL_DEG = (-22.0, 28.0), (-3.0, 24.0), (5.0, 45.0), (-15.0, 55.0)
"""Of a forearm seen from its hand, towards the back and the thumb; of the back of the hand about the forearm, against the
elbow's axis; and of the elbow about the line from shoulder to wrist, against down and somewhat out."""
REACH_M = 0.05
"""Standard deviation (m) by which a wrist may lie out of the arm's reach, for shoulders are not where the head says."""
LEAST_NATS = -9.0
"""What a frame counts at worst: arms do what they like, and trackers err."""
_ELBOWS, _MOST_FRAMES, _FRAME_S, _MOST_LOOKS, _LOOK_S = 24, 200, 0.2, 4.0, 4.0


def wrist_of_hand(R_world_hand: Float[Tensor, "time 3 3"], joint: str, family: str) -> Float[Tensor, "time 3 3"]:
    """Rotation of a wrist joint from a device's pose. A wrist joint's own axes are the world's in a T-pose that faces x,
    palms down: x to the thumb, y (of the right hand: -y) along the straight hand, z out of its back."""
    x, z = _forward_and_up(joint, family)
    return R_world_hand @ torch.stack([x, torch.linalg.cross(z, x), z]).to(R_world_hand)


def palm_of(joint: str, family: str) -> Float[Tensor, "3"]:
    """Place (m) of a device's origin in the wrist joint's axes."""
    seat = SEATS[family]
    return torch.tensor([0.0, seat.palm_m * side_of(joint), 0.0]) + seat.ahead_m * _forward_and_up(joint, family)[0]


def families_named(words: Set[str]) -> tuple[str, ...]:
    """Families that poses with these words in their names may be of: one, all candidates, or only those of controllers,
    where nothing speaks of hands."""
    named = tuple(family for family, known in _NAMES.items() if words & known)
    return named[:1] or (CANDIDATES if words & _OF_HANDS and not words & _OF_HELD else HELD)


def side_of(joint: str) -> float:
    """1 for the left hand, -1 for the right one."""
    return 1.0 if joint.startswith("left") else -1.0


def _forward_and_up(joint: str, family: str) -> tuple[Tensor, Tensor]:
    """Directions of a device's forward and up axes in the wrist joint's axes."""
    seat, side = SEATS[family], side_of(joint)
    sine, cosine = math.sin(math.radians(seat.pitch_deg)), math.cos(math.radians(seat.pitch_deg))
    forward = torch.tensor([sine, side * cosine, 0.0])
    return forward, torch.tensor([0.0, 0.0, 1.0] if seat.flat else [cosine, -side * sine, 0.0])


def most_likely_seat(
    head: Trajectory, hands: dict[str, Trajectory], candidates: Sequence[str] = CANDIDATES
) -> tuple[str, float]:
    """The family whose seat makes arms of a log's hand poses, the same for both hands, and its probability.

    Both are in wearcap's axes (m). Frames within seconds say the same, and all frames share what shoulders and habits
    are off by: a log counts as one look per `_LOOK_S`, at most as `_MOST_LOOKS`.
    """
    looks = min(_MOST_LOOKS, (head.timestamps[-1] - head.timestamps[0]).item() / _LOOK_S)
    head = Trajectory(head.timestamps, head.R_world_body.float(), head.t_world_body.float())
    off = torch.tensor([-1.5, -0.75, 0.0, 0.75, 1.5])  # of a seat's angle, in its standard deviations
    nats = (-(off**2) / 2).log_softmax(0).repeat(len(candidates), 1)
    for joint, hand in hands.items():
        step = max(1, round(_FRAME_S / max(hand.timestamps.diff().median().item(), 1e-3)), len(hand) // _MOST_FRAMES)
        some = Trajectory(hand.timestamps[::step], hand.R_world_body[::step].float(), hand.t_world_body[::step].float())
        for k, family in enumerate(candidates):
            tilted = off * SEATS[family].deviation_deg
            nats[k] += looks * torch.stack(
                [arm_nats(head, _pitched(some, turn), joint, family).mean() for turn in tilted]
            )
    probability = nats.logsumexp(1).softmax(0)
    best = int(probability.argmax())
    return candidates[best], probability[best].item()


def _pitched(hand: Trajectory, angle_deg: Tensor) -> Trajectory:
    """A device turned in the hand about its left axis, as if its seat's angle were larger."""
    turned = hand.R_world_body @ rotation.about_axis("y", angle_deg.deg2rad())
    return Trajectory(hand.timestamps, turned, hand.t_world_body)


def arm_nats(head: Trajectory, hand: Trajectory, joint: str, family: str) -> Float[Tensor, "time"]:
    """Logarithm of likelihood (nats) of the arm that holds a device with a family's seat, over all elbows it may have."""
    side, body = side_of(joint), xsens23()
    upper, fore = (body.t_parent_joint[body.index(name)].norm() for name in ("left_elbow", "left_wrist"))
    near = torch.searchsorted(head.timestamps, hand.timestamps.contiguous()).clamp(max=len(head) - 1)
    R_heading = rotation.about_axis("z", rotation.yaw_of(head.R_world_body[near]))
    x, y, z = SHOULDER_M
    neck = head.t_world_body[near] + head.R_world_body[near] @ torch.tensor(NECK_M)
    shoulder = neck + R_heading @ torch.tensor([x, side * y, z])
    R = wrist_of_hand(hand.R_world_body, joint, family)
    line = hand.t_world_body - R @ palm_of(joint, family) - shoulder
    far = line.norm(dim=-1, keepdim=True)
    along, reached = line / far.clamp(min=1e-6), far.clamp(0.1, 0.999 * (upper + fore).item())
    before = (upper**2 - fore**2 + reached**2) / (2 * reached)  # elbows lie on a circle about the line
    beside = (upper**2 - before**2).clamp(min=1e-6).sqrt()
    down = R_heading @ torch.tensor([0.0, 0.4 * side, -1.0])
    down = normalize(down - (down * along).sum(-1, keepdim=True) * along, dim=-1)
    swivel = torch.arange(_ELBOWS) * (2 * math.pi / _ELBOWS) - math.pi
    aside = (
        down[:, None] * swivel.cos()[:, None] + side * torch.linalg.cross(along, down)[:, None] * swivel.sin()[:, None]
    )
    elbow = (before * along)[:, None] + beside[:, None] * aside
    forearm = normalize((reached * along)[:, None] - elbow, dim=-1)  # time, elbow, 3
    thumb, fingers, back = (forearm @ R).unbind(-1)
    flexion, deviation = torch.atan2(back, side * fingers), torch.atan2(thumb, side * fingers)
    hinge = -side * normalize(torch.linalg.cross(elbow, along[:, None].expand_as(elbow)), dim=-1)
    up = R[:, None, :, 2].expand_as(hinge)
    turned = side * (torch.linalg.cross(hinge, up) * forearm).sum(-1)
    pronation = torch.atan2(turned, (hinge * up).sum(-1) - (hinge * forearm).sum(-1) * (up * forearm).sum(-1))
    nats = sum(
        -(((angle.rad2deg() - mean) / deviate) ** 2) / 2
        for angle, (mean, deviate) in (
            (flexion, FLEXION_DEG), (deviation, DEVIATION_DEG), (pronation, PRONATION_DEG), (swivel, SWIVEL_DEG)
        )
    )  # fmt: skip
    beyond = (far - reached)[:, 0].clamp(min=0) / REACH_M
    return (torch.logsumexp(nats, -1) - math.log(_ELBOWS) - beyond**2 / 2).clamp(min=LEAST_NATS)
