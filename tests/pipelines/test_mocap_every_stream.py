"""MocapEvery as a stream: the same motion as in one go, whatever order samples come in."""

import pytest
import torch

from watched_walk import drawn_pipeline, watched_walk
from wearcap.geometry.rigid import Rigid
from wearcap.recording import Motion
from wearcap.runtime.wearer import Wearer
from wearcap.systems.mocap_every.stream import MocapEveryStream, WatchSample


@pytest.fixture(scope="module")
def recording():
    return watched_walk()


def wearing(recording) -> Wearer:
    head, mounts = recording.head, {joint: stream.R_joint_imu for joint, stream in recording.imu.items()}
    return Wearer(recording.skeleton, head.R_head_device, head.t_head_device, mounts, floor_m=0.0)


def samples(stream):
    return [WatchSample(*row) for row in zip(stream.timestamps.tolist(), stream.R_world_imu, stream.acc_world)]


def streamed(pipeline, recording, late_s: float = 0.0, without: str | None = None) -> tuple[Motion, MocapEveryStream]:
    """Poses of a session that is fed moment by moment, the watches `late_s` behind the camera."""
    session, head = MocapEveryStream(pipeline, wearing(recording)), recording.head
    waiting = {joint: samples(stream) for joint, stream in recording.imu.items()}
    given = []
    for number, time in enumerate(head.timestamps.tolist()):
        points = recording.points.points_world if number == 0 else None
        session.head(time, Rigid(head.R_world_device[number], head.t_world_device[number]), points)
        for joint, left in waiting.items():
            ready = [sample for sample in left if sample.timestamp <= time - late_s]
            waiting[joint] = left[len(ready) :]
            if joint != without:
                session.watch(joint, ready)
        given.append(session.poses())
    for joint, left in waiting.items():
        if joint != without:
            session.watch(joint, left)
    given.append(session.poses(ended=True))
    parts = [motion for motion in given if motion is not None]
    R, t = (torch.cat([getattr(part, name) for part in parts]) for name in ("R_parent_joint", "t_world_root"))
    return Motion(torch.cat([part.timestamps for part in parts]), recording.skeleton, R, t), session


@pytest.mark.parametrize(("stride", "lookahead"), [(1, 0), (1, 5), (4, 8)])
@pytest.mark.parametrize("floor", ["follow", "update"])
def test_a_stream_gives_what_a_whole_capture_gives(recording, stride, lookahead, floor):
    pipeline = drawn_pipeline(stride=stride, lookahead=lookahead, floor=floor)
    motion, session = streamed(pipeline, recording)
    whole = pipeline(recording)
    torch.testing.assert_close(motion.timestamps, whole.timestamps)
    torch.testing.assert_close(motion.T_world_joint.t, whole.T_world_joint.t, atol=2e-4, rtol=0)
    assert session.dropped == session.silent == 0


def test_late_watches_change_nothing(recording):
    pipeline = drawn_pipeline()
    motion, session = streamed(pipeline, recording, late_s=0.3)
    torch.testing.assert_close(motion.T_world_joint.t, pipeline(recording).T_world_joint.t, atol=2e-4, rtol=0)
    assert session.silent == 0


def test_a_silent_watch_is_counted_and_holds_nothing_up(recording):
    motion, session = streamed(drawn_pipeline(), recording, without="right_wrist")
    assert len(motion) == len(recording.head.timestamps)
    assert session.silent == len(motion)
    assert motion.R_parent_joint.isfinite().all()


def test_samples_that_are_not_finite_are_left_out(recording):
    session = MocapEveryStream(drawn_pipeline(), wearing(recording))
    broken = WatchSample(0.1, torch.eye(3), torch.tensor([0.0, torch.nan, 0.0]))
    session.watch("left_wrist", [broken, WatchSample(0.2, torch.eye(3), torch.zeros(3))])
    assert [sample.timestamp for sample in session._wrists.samples["left_wrist"]] == [0.2]
