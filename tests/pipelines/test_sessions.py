"""Sessions of several wearers: each as alone.

Bit for bit but for ECHO, whose batched plans are sums in another order.
"""

import pytest
import torch
from test_echo_stream import TWO, WRISTS
from test_echo_stream import wearer as echo_wearer
from test_mocap_every_stream import wearing

from carried_box import boxes, carrying, drawn_echo
from watched_walk import drawn_pipeline, watched_walk
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.recording import Motion, Recording
from wearcap.recording.timing import joined
from wearcap.runtime.session import Session
from wearcap.sensors.samples import ActiveObject, HeadSample, ObjectSample, WatchSample, WristSample
from wearcap.systems.echo.contacts import Guidance
from wearcap.systems.echo.stream import EchoSession, EchoStream
from wearcap.systems.mocap_every.stream import MocapEverySession

ROUNDED = 2e-3
"""What an untrained network and almost straight limbs make of plans in another order: 4e-4 of a rotation was seen."""


def watch_samples(recording: Recording) -> list[list]:
    """Samples of the head camera and both watches, frame by frame."""
    head, frames = recording.head, []
    watches = [
        WatchSample(*row, joint)
        for joint, imu in recording.imu.items()
        for row in zip(imu.timestamps.tolist(), imu.R_world_imu, imu.acc_world)
    ]
    last = -1.0
    for number, time in enumerate(head.timestamps.tolist()):
        points = recording.points.points_world if number == 0 else None
        ready = [sample for sample in watches if last < sample.timestamp <= time]
        frames.append([HeadSample(time, head.T_world_device[number], points), *ready])
        last = time
    return [*frames, [sample for sample in watches if sample.timestamp > last]]


def echo_samples(recording: Recording) -> list[list]:
    """Samples of head, wrists and objects, frame by frame."""
    head, frames = recording.head, []
    for number, time in enumerate(head.timestamps.tolist()):
        wrists = [WristSample(joint, time, recording.motion.joint(joint)[number]) for joint in WRISTS]
        frames.append([HeadSample(time, head.T_world_device[number]), *wrists])
    for name, _, start, stop in TWO:
        begin, end = (int(share * len(frames)) for share in (start, stop))
        frames[begin].append(ActiveObject(name, head.timestamps[begin].item()))
        frames[end].append(ActiveObject(None, head.timestamps[end].item()))
    seen = Rigid(torch.eye(3), torch.tensor([0.3, 0.2, 1.0]))
    frames[len(frames) // 3].append(ObjectSample("box_1", head.timestamps[len(frames) // 3].item(), seen))
    return frames


def run(session: Session, frames: list[list[list]]) -> list[list[Motion]]:
    """Poses of each wearer after each frame's samples."""
    motions = [[] for _ in session.streams]
    for samples in frames:
        session.push(samples)
        for mine, motion in zip(motions, session.poses()):
            mine += [] if motion is None else [motion]
    return motions


def ended(session: Session, motions: list[list[Motion]]) -> list[Motion]:
    for mine, motion in zip(motions, session.poses(ended=True)):
        mine += [] if motion is None else [motion]
    return [joined(mine) for mine in motions]


def assert_equal(motion: Motion, other: Motion, atol: float = 0.0) -> None:
    for name in ("timestamps", "R_parent_joint", "t_world_root"):
        torch.testing.assert_close(getattr(motion, name), getattr(other, name), atol=atol, rtol=0)
    for name, track in (other.object_motion or {}).items():
        torch.testing.assert_close(motion.object_motion[name].t_world_body, track.t_world_body, atol=atol, rtol=0)


@pytest.mark.parametrize("floor", ["follow", "update", "fixed"])
def test_two_wearers_of_mocap_every_are_as_alone(floor):
    recording, pipeline = watched_walk(), drawn_pipeline(floor=floor)
    samples = watch_samples(recording)
    late = [[], [], [], *samples][: len(samples)] + samples[len(samples) - 3 :]
    frames = [[a, b] for a, b in zip([*samples, [], [], []], late)]
    both = MocapEverySession(pipeline, [wearing(recording), wearing(recording)])
    first, second = ended(both, run(both, frames))
    alone = MocapEverySession(pipeline, [wearing(recording)])
    assert_equal(first, ended(alone, run(alone, [[part] for part in samples]))[0])
    assert len(second) == len(first)


AVERAGED = {"rewindow": 3, "rewindow_steps": 1, "average": True}


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"guidance": Guidance(object=2.0)},
        AVERAGED,
        AVERAGED | {"mirror_average": True, "guidance": Guidance(object=2.0)},
    ],
)
def test_two_wearers_of_echo_are_as_alone(settings):
    recording, echo = carrying(1.2, carried=TWO), drawn_echo(**settings)
    samples = echo_samples(recording)
    frames = [[part, part[:3]] for part in samples]
    who = [echo_wearer(recording), echo_wearer(recording)]
    both = EchoSession(echo, who, [3, 4], boxes(TWO))
    first = ended(both, run(both, frames))[0]
    stream = EchoStream(echo, who[0], boxes(TWO), 3)
    alone = EchoSession(echo, who[:1], [3], boxes(TWO))
    motion = ended(alone, run(alone, [[part] for part in samples]))[0]
    parts = []
    for part in samples:
        for sample in part:
            stream.take(sample)
        parts.append(stream.poses())
    parts.append(stream.poses(ended=True))
    assert_equal(motion, joined([part for part in parts if part is not None]), ROUNDED)
    assert_equal(first, motion, ROUNDED)


def test_samples_of_another_kind_are_refused_and_of_other_wearers_raise():
    recording = watched_walk()
    session = MocapEverySession(drawn_pipeline(), [wearing(recording)])
    session.push([["a", None, 3, WatchSample(0.0, torch.eye(3), torch.zeros(3), "head")]])
    assert session.refused == [{"sample: wrong type or shape": 4}]
    with pytest.raises(WearcapError, match="samples of 2 wearers"):
        session.push([[], []])
