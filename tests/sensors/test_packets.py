"""What a packet may be, and which times are believed."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from bad_packets import ROTATIONS, VECTORS, bad_poses, broken
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.sensors import packets
from wearcap.sensors.packets import AGREEING, HeadInput, PacketClock


@pytest.mark.parametrize("name", VECTORS)
def test_bad_vectors_are_reported(name):
    assert packets.values_fault(VECTORS[name], (3,), 1000.0)


@pytest.mark.parametrize("name", ROTATIONS)
def test_bad_rotations_are_reported(name):
    assert packets.rotation_fault(ROTATIONS[name])


@given(st.lists(st.floats(-3, 3), min_size=3, max_size=3))
def test_rotations_of_little_precision_are_fine(rotvec):
    R = rotation.exp(torch.tensor(rotvec))
    for each in (R, R.double(), R.half(), (100 * R).round() / 100):
        assert packets.rotation_fault(each) is None
    assert packets.rotation_fault(R[None], (1, 3, 3)) is None
    assert packets.rotation_fault(1.1 * R) == packets.rotation_fault(1.1 * R[None], (1, 3, 3)) == packets.NOT_A_ROTATION


@pytest.mark.parametrize(
    ("value", "fault"),
    [
        (0.5, None),
        (3, None),
        (np.float32(2.0), None),
        (-1e9, None),
        (math.nan, "not finite"),
        (-math.inf, "not finite"),
        (1e18, "out of range"),
        (10**400, "out of range"),
        (None, "wrong type or shape"),
        ("1", "wrong type or shape"),
        (1j, "wrong type or shape"),
        (torch.zeros(2), "wrong type or shape"),
    ],
)
def test_times(value, fault):
    assert packets.time_fault(value) == fault


def test_points_that_can_be_used_are_kept():
    points = torch.tensor([[1.0, 2.0, 3.0], [math.nan, 0.0, 0.0], [0.0, 1e30, 0.0]])
    head_input = HeadInput()
    kept = head_input.points(points)
    assert kept is not None
    assert kept.tolist() == [[1.0, 2.0, 3.0]]
    assert head_input.refused == {"points: not finite": 1}
    for bad in (torch.zeros(3), torch.zeros(2, 4), torch.zeros(2, 3, dtype=torch.int32), np.zeros((2, 3)), [1]):
        assert head_input.points(bad) is None
    assert head_input.refused["points: wrong type or shape"] == 5


@pytest.mark.parametrize("name", bad_poses(Rigid.identity()))
def test_bad_poses_are_counted_and_good_ones_copied(name):
    head_input, good = HeadInput(), Rigid.identity()
    assert head_input.pose(bad_poses(good)[name]) is None
    assert head_input.dropped == sum(head_input.refused.values()) == 1
    copy = head_input.pose(broken(good, t=torch.zeros(3)))
    assert copy is not None
    assert copy.t.tolist() == [0.0, 0.0, 0.0]


def test_a_lone_pose_far_away_is_refused_and_several_are_believed():
    head_input = HeadInput()
    here, there = Rigid.identity(), Rigid(torch.eye(3), torch.tensor([500.0, 0.0, 0.0]))
    found = [head_input.pose(pose) is not None for pose in (here, there, here, *[there] * (AGREEING + 1), here)]
    assert found == [True, False, True, *[False] * (AGREEING - 1), True, True, False]


def run(clock: PacketClock, times: list[float]) -> tuple[list[float], int, list[bool]]:
    """Times that are taken, how many are refused, and where the clock begins."""
    admitted = [clock.admit(time, None) for time in times]
    taken = [time for part in admitted for time, _ in part.packets]
    return taken, sum(part.refused for part in admitted), [part.begins for part in admitted]


STEADY = [k / 30 for k in range(30)]


@pytest.mark.parametrize("odd", [1e9, 5.0, 2.0])
def test_a_lone_packet_ahead_is_refused(odd):
    clock = PacketClock()
    taken, refused, begins = run(clock, [*STEADY, odd, *(1 + time for time in STEADY)])
    assert (taken, refused) == ([*STEADY, *(1 + time for time in STEADY)], 1)
    assert begins == [True] + 60 * [False]


def test_a_late_packet_is_passed_on_as_late():
    taken, refused, begins = run(PacketClock(), [*(5 + time for time in STEADY), 1.0, 6.0])
    assert (taken[-2:], refused, sum(begins)) == ([1.0, 6.0], 0, 1)


@pytest.mark.parametrize(("step", "anew"), [(-100.0, True), (-3.0, True), (100.0, False)])
def test_several_that_agree_have_moved_the_clock(step, anew):
    clock, later = PacketClock(), [time + 10 + step for time in STEADY]
    taken, refused, begins = run(clock, [*(9 + time for time in STEADY), *later])
    assert (taken[30:], refused) == (later, 0)
    assert begins[30:] == [k == AGREEING - 1 and anew for k in range(30)]
    assert clock.waiting == []


def test_a_beginning_at_a_wrong_time_is_not_believed():
    clock = PacketClock()
    last = [clock.admit(time, None) for time in [1e9, *STEADY]][AGREEING]
    assert last.begins
    assert not last.again
    assert last.refused == 1


def test_who_does_not_lead_goes_back_only_where_the_leader_is():
    for leader, believed in ((100.0, 0), (0.1, AGREEING)):
        clock = PacketClock(leads=False)
        for k in range(30):
            clock.admit(99 + k / 30, None, 99 + k / 30)
        admitted = [clock.admit(time, None, leader) for time in STEADY[:AGREEING]]
        assert sum(len(part.packets) for part in admitted) == believed
        assert sum(part.refused for part in admitted) == AGREEING - believed


@given(st.lists(st.floats(-1e9, 1e9) | st.floats(0, 3), max_size=60))
def test_a_clock_never_holds_many_and_loses_none(times):
    clock, taken, refused = PacketClock(), 0, 0
    for time in times:
        admitted = clock.admit(time, None)
        taken, refused = taken + len(admitted.packets), refused + admitted.refused
        assert len(clock.waiting) < AGREEING
    late, left = clock.dismiss()
    assert len(times) <= taken + refused + len(late) + left <= len(times) + AGREEING * len(times)


def test_what_is_connected_is_kept():
    times = [0.0, 1.0, 2.0, 50.0, 55.0, 60.0, 1e9]
    assert packets.connected(times, 54.0) == slice(3, 6)
    assert packets.connected(times, 0.5) == slice(0, 3)
    assert packets.connected(times, 1e6) == slice(6, 6)
