"""Seats of controllers and hand joints: what the table says, and the choice among them, of arms made by kinematics."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import WRISTS, xsens23
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.devices.hand_seats import SEATS, families_named, most_likely_seat, palm_of, wrist_of_hand

MIRROR = torch.diag(torch.tensor([1.0, -1.0, 1.0]))


@pytest.mark.parametrize("family", SEATS)
def test_a_seat_is_what_the_table_says(family):
    """The straight hand is below the device's forward axis by the seat's angle; the right hand's seat is the left one's image."""
    left, right = (wrist_of_hand(torch.eye(3)[None], joint, family)[0] for joint in WRISTS)
    assert torch.allclose(left @ left.T, torch.eye(3), atol=1e-6)
    assert torch.allclose(right, MIRROR @ left @ MIRROR, atol=1e-6)
    assert torch.allclose(palm_of("right_wrist", family), MIRROR @ palm_of("left_wrist", family))
    fingers = left[:, 1]
    assert np.degrees(np.arccos(fingers[0].clamp(-1, 1))) == pytest.approx(SEATS[family].pitch_deg, abs=0.05)
    assert fingers[2] <= 1e-6, "below, not above"
    assert left[2, 2 if SEATS[family].flat else 0] > 0, "the device's top is on the back's side, or the thumb's"


def wearer(seconds: float = 40.0, fps: float = 10.0):
    """Head and wrists of a body that moves its bent arms before it, by kinematics."""
    body, time = xsens23(), np.arange(int(seconds * fps)) / fps
    R = torch.eye(3).repeat(len(time), len(body), 1, 1)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        lift, turn = 60 + 20 * np.sin(1.1 * time + sign), 30 + 30 * np.sin(0.7 * time)
        bend, roll = 70 + 40 * np.sin(0.9 * time + 2 * sign), 35 + 30 * np.sin(0.5 * time)
        shoulder = np.stack([-sign * lift, 0 * time, -sign * turn], 1)  # down from the T-pose, then ahead
        for name, turned in (
            ("shoulder", Rotation.from_euler("xyz", shoulder, degrees=True)),
            ("elbow", Rotation.from_euler("z", (-sign * bend)[:, None], degrees=True)),
            ("wrist", Rotation.from_euler("y", (-sign * (roll - 35))[:, None], degrees=True)),
        ):
            R[:, body.index(f"{side}_{name}")] = torch.tensor(turned.as_matrix(), dtype=torch.float32)
    pose, times = forward_kinematics(body, R, torch.tensor([0.0, 0.0, 1.0]).repeat(len(time), 1)), torch.tensor(time)
    head = pose[:, body.index("head")]
    hands = {joint: Trajectory(times, pose.R[:, body.index(joint)], pose.t[:, body.index(joint)]) for joint in WRISTS}
    return Trajectory(times, head.R, head.t + torch.tensor([0.09, 0.0, 0.075])), hands


@pytest.mark.parametrize("family", ["grip", "aim", "wrist"])
def test_the_seat_of_moving_arms_is_found(family):
    """Families that are far apart; those that differ by 6 to 15 degrees may be taken for each other."""
    head, hands = wearer()
    held = {}
    for joint, hand in hands.items():
        R = hand.R_world_body @ wrist_of_hand(torch.eye(3)[None], joint, family)[0].mT
        held[joint] = Trajectory(hand.timestamps, R, hand.t_world_body + hand.R_world_body @ palm_of(joint, family))
    taken, sure = most_likely_seat(head, held)
    assert abs(SEATS[taken].pitch_deg - SEATS[family].pitch_deg) < 16
    assert SEATS[taken].flat == SEATS[family].flat
    assert 0.3 < sure <= 1
    one, _ = most_likely_seat(head, {"left_wrist": held["left_wrist"]})
    assert abs(SEATS[one].pitch_deg - SEATS[family].pitch_deg) < 16


def test_names_say_what_is_held():
    assert families_named({"left", "aim", "pos"}) == ("aim",)
    assert families_named({"lefthand", "wrist"}) == ("wrist",)
    assert "wrist" not in families_named({"left", "controller"})
    assert len(families_named({"left", "hand"})) > len(families_named({"left", "controller"})) > 1
