"""A capture that was suspended, or whose engine was slow: it catches up with what happens now, but loses nothing of a replay.

The clock is the test's, and turns of the capture are made by the test.
"""

import time
from dataclasses import replace

import pytest
import torch
from test_live_capture import Kept, small_hmd2, swaying

from wearcap.apps.live.capture import CATCH_UP_S, LiveCapture
from wearcap.apps.live.packets import HEAD, Packet
from wearcap.apps.live.setup import Known
from wearcap.apps.live.sources.replay import ReplaySource
from wearcap.apps.live.wearer import LEFT_OUT_S
from wearcap.sensors.samples import HeadSample
from wearcap.systems.hmd2.stream import HMD2Session

FPS, BEGIN_S, DEVICE_S = 60.0, 1000.0, 7000.0
"""Rate of the head's packets (Hz), our time (s) at the beginning, and that of the head's own clock."""


class Turns:
    """A capture of one wearer, whose packets and turns come as the test says."""

    def __init__(self, monkeypatch, sources=()):
        self.now_s = BEGIN_S
        monkeypatch.setattr(time, "monotonic", lambda: self.now_s)
        self.kept, self.recording = Kept(), swaying(240)
        setup = ReplaySource(self.recording, HMD2Session).setup
        self.capture = LiveCapture(small_hmd2(), sources, [self.kept], known=Known(setup=setup))
        self.capture.sinks[0].start()

    def deliver(self, first_s: float, stop_s: float, arrived_s: float | None = None) -> None:
        """Deliver what is measured within a span of time (s since the beginning), as it is measured or all at a time (s)."""
        poses = self.recording.head.T_world_device
        for k in range(round(first_s * FPS), round(stop_s * FPS)):
            arrives_s = BEGIN_S + (k / FPS if arrived_s is None else arrived_s)
            sample = HeadSample(DEVICE_S + k / FPS, poses[k % len(poses.t)])
            self.capture.inbox.deliver([Packet("", HEAD, "device", sample.timestamp, arrives_s, sample)])

    def turn(self, at_s: float) -> None:
        """One turn of the capture at a time (s since the beginning)."""
        self.now_s = BEGIN_S + at_s
        self.capture._step()

    def go_on(self, first_s: float, stop_s: float, step_s: float = 0.2) -> None:
        """Capture in time from then to then."""
        for k in range(round((stop_s - first_s) / step_s)):
            self.deliver(first_s + k * step_s, first_s + (k + 1) * step_s)
            self.turn(first_s + (k + 1) * step_s)

    def end(self) -> tuple[torch.Tensor, dict]:
        """Times of all poses (s since the beginning), and what is reported of the wearer."""
        wearer = self.capture.wearers[""]
        self.capture._send(wearer, wearer.leave())
        self.capture.sinks[0].close()
        return self.kept.motion().timestamps - DEVICE_S, self.capture.report()["wearers"]["wearer"]


def check_caught_up(times: torch.Tensor, about: dict, before_s: float, after_s: float, left_out: int) -> None:
    """All poses up to a time (s) and from another one on are there, and none between."""
    assert not ((times > before_s) & (times < after_s - 1e-6)).any()
    assert len(times) == about["frames"] == round(before_s * FPS) + round((times[-1].item() - after_s) * FPS) + 1
    assert (about["sessions"], about["gaps"], about["dropped"]) == (2, 1, left_out)
    assert len([note for note in about["notes"] if "began anew" in note]) == 1
    assert about["clock_restarts"] == 0


def test_a_capture_whose_engine_was_slow_catches_up(monkeypatch):
    turns = Turns(monkeypatch)
    turns.go_on(0.0, 2.0)
    turns.deliver(2.0, 22.0)
    turns.turn(22.0)
    assert turns.capture.wearers[""].stage == "away"
    turns.go_on(22.0, 24.0)
    times, about = turns.end()
    assert turns.kept.left == ["", ""], "at the stall and at the end"
    check_caught_up(times, about, 2.0, 22.0, left_out=20 * 60)


def test_a_process_that_was_suspended_leaves_out_what_its_sockets_held(monkeypatch):
    """Of a minute the socket holds the first four seconds, which arrive when the process goes on."""
    turns = Turns(monkeypatch)
    turns.go_on(0.0, 2.0)
    turns.turn(62.0)
    turns.deliver(2.0, 6.0, arrived_s=62.0)
    turns.turn(62.02)
    assert turns.capture.wearers[""].stage == "away"
    turns.go_on(62.0, 64.0)
    times, about = turns.end()
    check_caught_up(times, about, 2.0, 62.0, left_out=4 * 60)


def test_a_clock_that_was_set_back_meanwhile_does_not_silence_its_wearer(monkeypatch):
    turns = Turns(monkeypatch)
    turns.go_on(0.0, 2.0)
    turns.turn(62.0)
    for k in range(20):  # as of a device that was started again: what is new seems old
        turns.deliver(k, k + 1, arrived_s=62.0 + k)
        turns.turn(62.0 + k)
    assert turns.capture.wearers[""].stage == "live"
    assert turns.end()[1]["dropped"] == pytest.approx(LEFT_OUT_S * FPS, abs=2 * FPS)


def test_a_short_stall_loses_nothing(monkeypatch):
    turns = Turns(monkeypatch)
    turns.go_on(0.0, 1.0)
    turns.deliver(1.0, 0.9 * CATCH_UP_S)
    turns.turn(0.9 * CATCH_UP_S)
    times, about = turns.end()
    torch.testing.assert_close(times, torch.arange(round(0.9 * CATCH_UP_S * FPS)).double() / FPS, atol=1e-6, rtol=0)
    assert (about["sessions"], about["gaps"]) == (1, 0)


def test_a_replay_loses_nothing(monkeypatch):
    turns = Turns(monkeypatch, [ReplaySource(swaying(2), HMD2Session)])
    turns.go_on(0.0, 1.0)
    turns.deliver(1.0, 7.0)
    turns.turn(7.0)
    times, about = turns.end()
    torch.testing.assert_close(times, torch.arange(7 * 60).double() / FPS, atol=1e-6, rtol=0)
    assert (about["sessions"], about["gaps"]) == (1, 0)


def test_a_session_whose_beginning_takes_long_is_not_begun_again_and_again(monkeypatch):
    turns = Turns(monkeypatch)
    opener = turns.capture.opener

    def slowly(wearer):
        turns.now_s += 2 * CATCH_UP_S
        return opener.session(wearer)

    turns.capture.opener = replace(opener, session=slowly)
    turns.deliver(0.0, 0.2)
    turns.turn(0.2)
    turns.deliver(0.2, 0.2 + 2 * CATCH_UP_S)
    turns.turn(0.2 + 2 * CATCH_UP_S)
    assert len(turns.end()[0]) == round((0.2 + 2 * CATCH_UP_S) * FPS)
