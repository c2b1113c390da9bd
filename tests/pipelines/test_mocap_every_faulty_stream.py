"""MocapEvery's stream when its devices send what cannot be true: it goes on as if that had not come."""

import math
from dataclasses import replace

import pytest
import torch

from bad_packets import ROTATIONS, TIMES, VECTORS, Mutator, bad_poses, given, unchecked
from watched_walk import drawn_pipeline, watched_walk
from wearcap.body.skeleton import WRISTS
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.recording import Motion
from wearcap.recording.timing import joined
from wearcap.runtime.wearer import Wearer
from wearcap.sensors import packets
from wearcap.sensors.packets import AGREEING
from wearcap.systems.mocap_every import stream as mocap_every_stream
from wearcap.systems.mocap_every.stream import MocapEveryStream, WatchSample

FRAMES, FAULT = 60, 33


@pytest.fixture(scope="module")
def recording():
    return watched_walk(FRAMES / 30)


@pytest.fixture(scope="module")
def pipeline():
    return drawn_pipeline(stride=8)


def opened(pipeline, recording) -> MocapEveryStream:
    head, mounts = recording.head, {joint: stream.R_joint_imu for joint, stream in recording.imu.items()}
    return MocapEveryStream(pipeline, Wearer(recording.skeleton, head.R_head_device, head.t_head_device, mounts, 0.0))


def feed(session, recording, frame: int, shift: float = 0.0, watched: bool = True) -> list[Motion]:
    """One frame of the head, then all that the watches say up to it."""
    head, time = recording.head, frame / 30
    session.head(time + shift, head.T_world_device[frame])
    for joint, stream in recording.imu.items():
        new = (stream.timestamps <= time + 1e-6) & (stream.timestamps > time - 1 / 30 + 1e-6)
        if watched:
            rows = zip((stream.timestamps[new] + shift).tolist(), stream.R_world_imu[new], stream.acc_world[new])
            session.watch(joint, [WatchSample(*row) for row in rows])
    return given(session)


def whole(session, recording, happen=None, frames=range(FRAMES)) -> Motion:
    parts = []
    for frame in frames:
        if happen is not None and frame == FAULT:
            happen(session)
        parts += feed(session, recording, frame)
    return joined(parts + given(session, ended=True) + given(session, ended=True))


@pytest.fixture(scope="module")
def undisturbed(pipeline, recording):
    return whole(opened(pipeline, recording), recording)


def assert_equal(motion: Motion, expected: Motion) -> None:
    for name in ("timestamps", "R_parent_joint", "t_world_root", "contact_prob"):
        assert torch.equal(getattr(motion, name), getattr(expected, name)), name


def disturbed(pipeline, recording, undisturbed, happen, streams) -> MocapEveryStream:
    session = opened(pipeline, recording)
    assert_equal(whole(session, recording, happen), undisturbed)
    assert {reason.split(":")[0] for reason in session.refused} == set(streams)
    return session


def test_bad_head_packets_change_nothing(pipeline, recording, undisturbed):
    good = recording.head.T_world_device[FAULT]
    bad = bad_poses(good)

    def happen(session):
        for time in TIMES.values():
            unchecked(session.head)(time, good)
        for number, pose in enumerate(bad.values()):
            unchecked(session.head)((FAULT - 1) / 30 + 1e-4 * number, pose)

    session = disturbed(pipeline, recording, undisturbed, happen, ["head"])
    assert sum(session.refused.values()) == session.dropped == len(TIMES) + len(bad)


def test_bad_watch_samples_change_nothing(pipeline, recording, undisturbed):
    time = (FAULT - 1) / 30 - 0.004
    good = WatchSample(time, torch.eye(3), torch.zeros(3))
    bad = [good._replace(timestamp=value) for value in TIMES.values()]
    bad += [good._replace(R_world_imu=value) for value in ROTATIONS.values()]
    bad += [good._replace(acc_world=value) for value in VECTORS.values()]
    bad += [None, "sample", (time, torch.eye(3), torch.zeros(3))]
    session = disturbed(
        pipeline, recording, undisturbed, lambda session: unchecked(session.watch)("left_wrist", bad), ["left_wrist"]
    )
    assert sum(session.refused.values()) == len(bad)
    assert session.dropped == session.silent == 0


def test_bad_points_are_left_out(pipeline, recording, undisturbed):
    def happen(session):
        for points in (*VECTORS.values(), torch.full((4, 3), math.nan), torch.full((4, 3), 1e30), torch.zeros(4, 2)):
            unchecked(session.head)((FAULT - 1) / 30, None, points)

    disturbed(pipeline, recording, undisturbed, happen, ["points"])


def test_a_sample_that_comes_twice_is_left_out_however_late(pipeline, recording, undisturbed):
    stream = recording.imu["left_wrist"]
    late = [WatchSample(*row) for row in zip(stream.timestamps.tolist(), stream.R_world_imu, stream.acc_world)][:105]
    disturbed(pipeline, recording, undisturbed, lambda session: session.watch("left_wrist", late[95:]), [])


def test_buffers_may_be_used_again(pipeline, recording, undisturbed):
    session, parts, buffer = opened(pipeline, recording), [], Rigid(torch.eye(3), torch.zeros(3))
    plain = session.head

    def head(timestamp, T_world_device):
        buffer.R.copy_(T_world_device.R)
        buffer.t.copy_(T_world_device.t)
        plain(timestamp, buffer)

    session.head = head
    for frame in range(FRAMES):
        parts += feed(session, recording, frame)
        buffer.t.fill_(torch.nan)
    parts.append(session.poses(ended=True))
    assert_equal(joined(parts), undisturbed)


@pytest.mark.parametrize("shift", [-1000.0, -1.5, 1000.0])
def test_where_the_clock_moves_it_goes_on(pipeline, recording, shift):
    """Back: as a session that is new, whose watches come with the packet that moves the clock."""
    session, fresh, back = opened(pipeline, recording), opened(pipeline, recording), shift < 0
    for frame in range(45):
        feed(session, recording, frame)
    late, expected = [], []
    for frame in range(FRAMES):
        late += feed(session, recording, frame, 1.5 + shift)
        expected += feed(fresh, recording, frame, 1.5 + shift, frame >= AGREEING - 1)
    ends = (session.poses(ended=True), session.poses(ended=True), fresh.poses(ended=True))
    late, expected = joined([*late, *(m for m in ends[:2] if m is not None)]), joined([*expected, ends[2]])
    new = slice(len(late) - FRAMES, None)
    assert torch.allclose(late.timestamps[new], expected.timestamps, atol=1e-6)
    assert late.R_parent_joint.isfinite().all()
    if back:
        torch.testing.assert_close(late.T_world_joint.t[new], expected.T_world_joint.t, atol=1e-4, rtol=0)


def test_poses_of_two_clocks_never_come_together(pipeline, recording):
    session = opened(pipeline, recording)
    parts = [motion for frame in range(45) for motion in feed(session, recording, frame, 50.0)]
    parts += [motion for frame in range(FRAMES) for motion in feed(session, recording, frame)]
    parts.append(session.poses(ended=True))
    assert all((motion.timestamps.diff() > 0).all() for motion in parts)
    assert sum(map(len, parts)) == 45 + FRAMES


def test_a_wrong_time_at_the_beginning_is_forgotten(pipeline, recording, undisturbed):
    session = opened(pipeline, recording)
    session.head(1e9, recording.head.T_world_device[0])
    session.watch("left_wrist", [WatchSample(1e9, torch.eye(3), torch.zeros(3))])
    motion = whole(session, recording)
    assert torch.equal(motion.timestamps, undisturbed.timestamps)
    assert motion.R_parent_joint.isfinite().all()


def test_an_unknown_watch_is_the_callers_mistake(pipeline, recording):
    with pytest.raises(WearcapError, match="no watch on 'nose'. Expected left_wrist or right_wrist"):
        opened(pipeline, recording).watch("nose", [])


def test_what_waits_for_a_lost_head_is_bounded(pipeline, recording, monkeypatch):
    monkeypatch.setattr(packets, "MAX_WAITING", 50)
    monkeypatch.setattr(mocap_every_stream, "MAX_POINTS", 100)
    session = opened(pipeline, recording)
    for k in range(1500):
        session.head(k / 30, None, torch.zeros(1, 3))
        session.watch("left_wrist", [WatchSample(k / 30, torch.eye(3), torch.zeros(3))])
        assert session.poses() is None
    assert len(session._wrists.samples["left_wrist"]) == 50
    assert sum(len(points) for points, _ in session._points) <= 1100


@pytest.mark.parametrize("seed", range(3))
def test_whatever_comes_it_goes_on(pipeline, recording, seed):
    session, draw, motions = opened(pipeline, recording), Mutator(seed), []
    points, head = recording.points.points_world, recording.head
    for k in range(150):
        pose = head.T_world_device[k % FRAMES]
        cloud = draw.one(VECTORS | {"good": points[:50], "none": None})
        unchecked(session.head)(draw.time(k / 30), draw.pose(pose), cloud)
        for joint in WRISTS:
            good = WatchSample(draw.time(k / 30), pose.R, torch.ones(3))
            if draw.bad():
                good = good._replace(acc_world=draw.one(VECTORS), R_world_imu=draw.one(ROTATIONS))
            unchecked(session.watch)(joint, [good])
        motions.append(session.poses())
    for k in range(30):  # the devices are well again
        feed(session, recording, k, 5.0)
    motions += [session.poses(ended=True) for _ in range(9)]
    motions = [motion for motion in motions if motion is not None]
    assert max(motion.timestamps[-1].item() for motion in motions) >= 5.9
    for motion in motions:
        assert motion.R_parent_joint.isfinite().all()
        assert motion.t_world_root.isfinite().all()
    assert len(session._chunks) + len(session.finished) + len(session._track._poses) < 20
    assert max(map(len, session._wrists.samples.values())) < 300
    assert replace(motions[0]).skeleton == recording.skeleton
