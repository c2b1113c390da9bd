"""Clocks of live devices: offset, drift and restarts are recovered from delayed packets."""

import random

import pytest

from wearcap.apps.live.clocks import AGREEING, Clocks, DeviceClock


def packets(seconds: float, hz: float, offset_s: float, drift: float, jitter_s: float, seed: int = 0):
    """(device time, arrival) of packets whose device clock is `offset_s` behind ours and drifts."""
    draw = random.Random(seed)
    for k in range(round(seconds * hz)):
        ours = 1000.0 + k / hz
        yield (ours - offset_s) * (1 + drift) - 1000.0 * drift, ours + 0.004 + jitter_s * draw.random() ** 2


@pytest.mark.parametrize("drift", [0.0, 1e-4, -1e-4])
@pytest.mark.parametrize("jitter_s", [0.0, 0.02])
def test_time_follows_the_smallest_delay_and_the_drift(drift: float, jitter_s: float):
    clock = DeviceClock()
    for sent_s, arrived_s in packets(300, 60, 777.0, drift, jitter_s):
        clock.see(sent_s, arrived_s)
        last = sent_s
    truly = (last + 1000.0 * drift) / (1 + drift) + 777.0
    assert clock.ours(last) == pytest.approx(truly + 0.004, abs=0.002)
    assert clock.theirs(clock.ours(last)) == pytest.approx(last, abs=1e-6)


def test_a_late_packet_changes_nothing_and_an_earlier_one_counts_at_once():
    clock = DeviceClock()
    clock.see(10.0, 20.05)
    clock.see(10.1, 20.9)
    assert clock.ours(10.1) == pytest.approx(20.15)
    clock.see(10.2, 20.21)
    assert clock.ours(10.2) == pytest.approx(20.21)


def test_a_clock_set_anew_is_followed_after_some_packets():
    clock = DeviceClock()
    for k in range(100):
        clock.see(50.0 + k / 60, 500.0 + k / 60)
    for k in range(AGREEING):
        assert clock.restarts == 0
        clock.see(3.0 + k / 60, 502.0 + k / 60)
    assert clock.restarts == 1
    assert clock.ours(3.0) == pytest.approx(502.0)


@pytest.mark.parametrize("batch_s", [1.2, 3.0])
def test_packets_that_are_sent_some_seconds_at_once_are_of_one_clock(batch_s: float):
    clock = DeviceClock()
    for k in range(6000):
        sent_s = k / 100
        arrived_s = 1000.0 + batch_s * (sent_s // batch_s + 1)
        clock.see(sent_s, arrived_s)
    assert clock.restarts == 0
    assert clock.ours(60.0) == pytest.approx(1060.0, abs=0.02)


def test_a_clock_set_back_by_a_little_is_followed_after_some_seconds():
    clock = DeviceClock()
    for k in range(600):
        clock.see(50.0 + k / 60, 500.0 + k / 60)
    for k in range(600):
        clock.see(57.0 + k / 60, 510.0 + k / 60)
    assert clock.restarts == 1
    assert clock.ours(57.0) == pytest.approx(510.0, abs=0.02)


def test_three_clocks_meet_on_the_heads():
    """Two watches and a head with unrelated times: one moment has one time."""
    clocks = Clocks()
    clocks.leader = "head"
    offsets = {"head": 3.0, "left": -50.0, "right": 1.7e9}
    for number, (name, offset) in enumerate(offsets.items()):
        for sent_s, arrived_s in packets(60, 50, offset, 0.0, 0.02, number):
            clocks.see(name, sent_s, arrived_s)
    moment = 1055.0
    for name, offset in offsets.items():
        assert clocks.on_leader(name, moment - offset) == pytest.approx(moment - 3.0, abs=0.002)
    clocks.shift("left_wrist", "left", 0.25)
    assert clocks.on_leader("left", moment + 50.0, "left_wrist") == pytest.approx(moment - 3.0 + 0.25, abs=0.002)
    assert clocks.on_leader("left", moment + 50.0, "phone") == pytest.approx(moment - 3.0, abs=0.002)
    clocks.shift("left_wrist", "left", -0.5)  # found of samples that count the first one
    assert clocks.on_leader("left", moment + 50.0, "left_wrist") == pytest.approx(moment - 3.0 - 0.25, abs=0.002)
    assert clocks.on_leader("right", moment - 1.7e9, "left_wrist") == pytest.approx(moment - 3.0, abs=0.002)
    assert clocks.on_leader("head", 12.345) == 12.345


@pytest.mark.parametrize(("anew", "void"), [("left", ["left_wrist"]), ("head", ["left_wrist", "right_wrist"])])
def test_a_clock_set_anew_voids_shifts(anew: str, void: list[str]):
    """Of the devices that count on it; the leading clock's restart those of all."""
    clocks = Clocks()
    clocks.leader = "head"
    for k in range(100):
        for name in ("head", "left", "right"):
            assert clocks.see(name, 50.0 + k / 60, 500.0 + k / 60) == []
    for joint in ("left_wrist", "right_wrist"):
        clocks.shift(joint, joint.split("_")[0], -1.7)
    found = [each for k in range(AGREEING + 3) for each in clocks.see(anew, 3.0 + k / 60, 502.0 + k / 60)]
    assert found == void
    for joint in ("left_wrist", "right_wrist"):
        ours = 502.0
        time_s = clocks.on_leader(joint.split("_")[0], 3.0 if anew == joint.split("_")[0] else 52.0, joint)
        truly = 3.0 if anew == "head" else ours - 450.0
        assert time_s == pytest.approx(truly - (0.0 if joint in void else 1.7))


def test_a_sender_that_invents_clocks_gets_no_memory():
    clocks = Clocks()
    clocks.leader = "head"
    clocks.see("head", 1.0, 2.0)
    for k in range(1000):
        clocks.see(f"clock {k}", 1.0, 2.0)
    assert clocks.on_leader("clock 999", 5.0) == 5.0
