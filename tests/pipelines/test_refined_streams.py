"""Streams that refine give what whole captures give, later by the refinement's lookahead."""

from dataclasses import replace

import pytest
import torch
from test_echo_stream import TWO, activate_objects, assert_same
from test_echo_stream import streamed as echo_streamed
from test_echo_stream import wearer as echo_wearer
from test_hmd2_stream import moments, pipeline, places, surrounded, wearer
from test_hmd2_stream import stream as hmd2_stream
from test_mocap_every_stream import streamed

from carried_box import boxes, carrying, drawn_echo, scenario_of
from watched_walk import drawn_pipeline, watched_walk
from wearcap.recording import Motion
from wearcap.systems.echo.stream import EchoStream
from wearcap.systems.hmd2.stream import HMD2Session
from wearcap.tracking.foot_lock import FootLock
from wearcap.tracking.refinement import Refinement

__all__ = ["pipeline", "places"]
FEET = FootLock(
    begin_prob=0.45,
    end_prob=0.4,
    shortest=2,
    settle=3,
    fade=2,
    fastest_m_s=10.0,
    farthest_m=0.2,
    leak_s=5.0,
    floor_within_m=0.1,
    raise_m=0.2,
)
REFINEMENT = Refinement(smooth=0.8, feet=FEET, wrists=True)
NO_FEET = replace(REFINEMENT, feet=None)


def assert_near(motion: Motion, whole: Motion) -> None:
    torch.testing.assert_close(motion.timestamps, whole.timestamps, atol=1e-6, rtol=0)
    torch.testing.assert_close(motion.T_world_joint.t, whole.T_world_joint.t, atol=1e-3, rtol=0)


def assert_changed(refined: Motion, plain: Motion) -> None:
    assert (refined.T_world_joint.t - plain.T_world_joint.t).abs().max() > 0.01


def test_mocap_every_stream():
    recording, system = watched_walk(), drawn_pipeline(refinement=REFINEMENT)
    whole = system(recording)
    assert_changed(whole, drawn_pipeline(refinement=NO_FEET)(recording))
    assert_near(streamed(system, recording)[0], whole)


def test_hmd2_stream(pipeline):
    recording, system = surrounded(133), pipeline(10, lookahead=None, refinement=REFINEMENT)
    whole = system(recording, seed=3)
    assert_changed(whole, pipeline(10, lookahead=None, refinement=NO_FEET)(recording, seed=3))
    assert_near(hmd2_stream(HMD2Session(system, [wearer(recording)], [3]), moments(recording))[0], whole)


def test_hmd2_poses_wait_for_the_refinement(pipeline):
    recording, system = surrounded(60), pipeline(10, lookahead=0, refinement=REFINEMENT)
    session, count = HMD2Session(system, [wearer(recording)], [0]), 0
    for number, moment in enumerate(moments(recording)):
        session.push([[moment]])
        motion = session.poses()[0]
        count += 0 if motion is None else len(motion)
        assert count == max(0, (number + 1) // 10 * 10 - REFINEMENT.lookahead)


def test_echo_stream_with_objects_at_its_latency():
    recording, echo = carrying(1.2, carried=TWO), drawn_echo(refinement=REFINEMENT)
    scenario = scenario_of(recording, TWO)
    session = EchoStream(echo, echo_wearer(recording), boxes(TWO), seed=3)
    activate_objects(session, scenario)
    motion, counts = echo_streamed(session, recording)
    assert_same(motion, echo.capture_scenarios([scenario], [3])[0], scenario)
    latency = round(echo.latency_s * echo.fps)
    assert counts == [max(0, k - latency) + (k >= latency) for k in range(len(counts))]
    wrists = recording.motion.skeleton.indices("left_wrist", "right_wrist")
    found, true = (each.T_world_joint.R[:, wrists] for each in (motion, recording.motion))
    torch.testing.assert_close(found, true, atol=1e-4, rtol=0)


@pytest.mark.parametrize("gap", [(40, 70)])
def test_a_gap_divides_what_is_refined(gap):
    recording = watched_walk()
    keep = torch.ones(len(recording.head.timestamps), dtype=torch.bool)
    keep[slice(*gap)] = False
    head = recording.head
    fields = {name: getattr(head, name)[keep] for name in ("timestamps", "R_world_device", "t_world_device")}
    broken = replace(recording, head=replace(head, **fields))
    system = drawn_pipeline(refinement=REFINEMENT)
    whole = system(broken)
    assert len(whole) == len(keep)
    # In the gap the last refined pose goes on, below the interpolated head.
    held = whole.R_parent_joint[gap[0] + 1 : gap[1] - 1, 0]
    torch.testing.assert_close(held, whole.R_parent_joint[gap[0], 0].expand_as(held), atol=1e-5, rtol=0)
