"""ECHO's stream when its devices send what cannot be true: it goes on as if that had not come."""

import pytest
import torch

from bad_packets import TIMES, Mutator, bad_poses, given, unchecked
from carried_box import boxes, carrying, drawn_echo
from wearcap.body.skeleton import WRISTS
from wearcap.recording import Motion
from wearcap.recording.timing import joined
from wearcap.runtime.wearer import Wearer
from wearcap.sensors import packets
from wearcap.sensors.packets import AGREEING
from wearcap.systems.echo import stream as echo_stream
from wearcap.systems.echo.stream import EchoStream

FRAMES, FAULT = 45, 21


@pytest.fixture(scope="module")
def recording():
    return carrying(FRAMES / 30)


@pytest.fixture(scope="module")
def echo():
    return drawn_echo()


def opened(echo, recording) -> EchoStream:
    head = recording.head
    wearer = Wearer(recording.skeleton, head.R_head_device, head.t_head_device, floor_m=0.0)
    return EchoStream(echo, wearer, boxes(), seed=3)


def feed(session, recording, frame: int, shift: float = 0.0, tracked: bool = True) -> list[Motion]:
    time = frame / 30 + shift
    session.head(time, recording.head.T_world_device[frame])
    for joint in WRISTS if tracked else ():
        session.wrist(joint, time, recording.motion.joint(joint)[frame])
    return given(session)


def remaining_poses(session) -> list[Motion]:
    return given(session, ended=True) + given(session, ended=True)


def whole(session, recording, happen=None) -> Motion:
    session.activate("box_1", 0.3)
    parts = []
    for frame in range(FRAMES):
        if happen is not None and frame == FAULT:
            happen(session)
        parts += feed(session, recording, frame)
    return joined(parts + remaining_poses(session))


@pytest.fixture(scope="module")
def undisturbed(echo, recording):
    return whole(opened(echo, recording), recording)


def assert_equal(motion: Motion, expected: Motion) -> None:
    for name in ("timestamps", "R_parent_joint", "t_world_root", "contact_prob"):
        assert torch.equal(getattr(motion, name), getattr(expected, name)), name
    for name, track in expected.object_motion.items():
        assert torch.equal(motion.object_motion[name].t_world_body, track.t_world_body)


@pytest.mark.parametrize("stream", ["head", "left_wrist", "box_1"])
def test_bad_packets_change_nothing(echo, recording, undisturbed, stream):
    good, before = recording.head.T_world_device[FAULT], (FAULT - 1) / 30
    bad = bad_poses(good)

    def happen(session):
        say = {
            "head": unchecked(session.head),
            "left_wrist": lambda time, pose: unchecked(session.wrist)("left_wrist", time, pose),
            "box_1": lambda time, pose: unchecked(session.see_object)("box_1", time, pose),
        }[stream]
        for time in TIMES.values():
            say(time, good)
        for number, pose in enumerate(bad.values()):
            say(before + 1e-4 * number, pose)
        for time in (*list(TIMES.values())[:4], None):
            unchecked(session.activate)(None, time)

    session = opened(echo, recording)
    assert_equal(whole(session, recording, happen), undisturbed)
    activated = 5
    counts = {
        key: sum(n for reason, n in session.refused.items() if reason.startswith(key)) for key in (stream, "activate")
    }
    assert counts == {stream: len(TIMES) + len(bad), "activate": activated}
    assert session.dropped == (counts["head"] if stream == "head" else 0)


@pytest.mark.parametrize("shift", [-1000.0, -1.2, 1000.0])
def test_where_the_clock_moves_it_goes_on(echo, recording, shift):
    """Back: as a session that is new, whose wrists come with the packet that moves the clock."""
    session, fresh = opened(echo, recording), opened(echo, recording)
    before = [motion for frame in range(40) for motion in feed(session, recording, frame)]
    late, expected = [], []
    for frame in range(FRAMES):
        late += feed(session, recording, frame, 1.2 + shift)
        expected += feed(fresh, recording, frame, 1.2 + shift, frame >= AGREEING - 1)
    late, expected = (joined(before + late + remaining_poses(session)), joined(expected + remaining_poses(fresh)))
    assert len(late) == 40 + FRAMES
    new = slice(40, None)
    assert torch.allclose(late.timestamps[new], expected.timestamps, atol=1e-6)
    assert late.R_parent_joint.isfinite().all()
    if shift < 0:
        torch.testing.assert_close(late.T_world_joint.t[new], expected.T_world_joint.t, atol=1e-4, rtol=0)


def test_the_active_object_stays_active_where_the_clock_goes_back(echo, recording):
    session = opened(echo, recording)
    session.activate("box_1", 50.1)
    parts = [motion for frame in range(FRAMES) for motion in feed(session, recording, frame, 50.0)]
    parts += [motion for frame in range(FRAMES) for motion in feed(session, recording, frame)]
    parts += remaining_poses(session)
    assert all((motion.timestamps.diff() > 0).all() for motion in parts)
    seen = torch.cat([motion.object_motion["box_1"].timestamps for motion in parts if motion.object_motion])
    assert int((seen < 10).sum()) == FRAMES


def test_what_waits_for_a_lost_head_is_bounded(echo, recording, monkeypatch):
    monkeypatch.setattr(echo_stream, "MAX_WAITING", 50)
    monkeypatch.setattr(packets, "MAX_WAITING", 50)
    monkeypatch.setattr(echo_stream, "MAX_SEEN", 20)
    session, pose = opened(echo, recording), recording.head.T_world_device[0]
    for k in range(300):
        session.head(k / 30, None)
        session.wrist("left_wrist", k / 30, pose)
        session.activate("box_1" if k % 2 else None, k / 30)
        session.see_object("box_1", k / 30, pose)
        assert session.poses() is None
    assert len(session._wrists.samples["left_wrist"]) == len(session._objects.changes) == 50
    assert len(session._objects.seen) == 20


@pytest.mark.parametrize("seed", range(3))
def test_whatever_comes_it_goes_on(echo, recording, seed):
    session, draw, motions = opened(echo, recording), Mutator(seed), []
    for k in range(120):
        pose = recording.head.T_world_device[k % FRAMES]
        unchecked(session.head)(draw.time(k / 30), draw.pose(pose))
        for joint in WRISTS:
            unchecked(session.wrist)(joint, draw.time(k / 30), draw.pose(pose))
        unchecked(session.see_object)("box_1", draw.time(k / 30), draw.pose(pose))
        if draw.bad():
            unchecked(session.activate)("box_1" if draw.bad() else None, draw.time(k / 30))
        motions.append(session.poses())
    for k in range(30):  # the devices are well again
        motions += feed(session, recording, k, 4.0)
    motions = [
        motion for motion in (*motions, *remaining_poses(session), *remaining_poses(session)) if motion is not None
    ]
    assert max(motion.timestamps[-1].item() for motion in motions) >= 4.9
    for motion in motions:
        assert motion.R_parent_joint.isfinite().all()
        assert motion.t_world_root.isfinite().all()
        for track in (motion.object_motion or {}).values():
            assert track.t_world_body.isfinite().all()
    sizes = (session._chunks, session.finished, session._track._poses, *session._wrists.samples.values())
    assert max(session.windows.pending, *map(len, sizes)) < 100
    assert len(session._objects.changes) + len(session._objects.seen) < 300
