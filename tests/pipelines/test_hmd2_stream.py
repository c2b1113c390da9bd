"""HMD² as a stream: the same poses as in one go, whatever happens on the way, in bounded memory."""

import math
import pickle
from dataclasses import replace

import pytest
import torch

from small_hmd2 import hmd2_of
from wearcap.body.skeleton import xsens23
from wearcap.errors import WearcapError
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory
from wearcap.models.layers import TransformerSize
from wearcap.models.voxel_autoencoder import VoxelAutoencoder
from wearcap.recording import CameraStream, Motion, PointCloud, Recording
from wearcap.runtime.wearer import Wearer
from wearcap.sensors.samples import WristSample
from wearcap.systems.hmd2.features import HeadFeatures
from wearcap.systems.hmd2.model import MotionDenoiser
from wearcap.systems.hmd2.pipeline import HMD2
from wearcap.systems.hmd2.places import Memory
from wearcap.systems.hmd2.stream import HeadSample, HMD2Session
from wearcap_testing import pushed, recording_of, swaying_motion

WINDOW, IMAGE = 60, 8
STEPS, STRIDE = 3, 10
"""Of the pipelines here: network evaluations per window, and the fewest frames between windows."""


@pytest.fixture(scope="module")
def places() -> VoxelAutoencoder:
    torch.manual_seed(1)
    return VoxelAutoencoder().eval()


@pytest.fixture
def pipeline(places):
    """Makes small pipelines with random weights that do say something."""

    def make(stride: int = STRIDE, points: bool = True, seed: int = 0, hands: bool = False, **changes) -> HMD2:
        torch.manual_seed(seed)
        features = HeadFeatures(contacts=True, body=True)
        net = MotionDenoiser(
            features.motion_size,
            features.condition_size,
            WINDOW,
            TransformerSize(32, 1, 4, 64, 0.0),
            4,
            blend=5,
            conditions=({"points": places.size, "image": IMAGE} if points else {}) | ({"hands": 20} if hands else {}),
        )
        for parameter in net.parameters():
            torch.nn.init.normal_(parameter, std=0.05)
        conditions = {
            "steps": STEPS,
            "place_encoder": places,
            "image_encoder": "eyes",
            "live": True,
            "fade": 6,
            "lookahead": 0,
        } | changes
        return hmd2_of(net, features, stride=stride, **conditions)

    return make


def surrounded(frames: int, seed: int = 0) -> Recording:
    """A walk on a floor of points that are seen on the way, with embeddings at 30 Hz."""
    recording = recording_of(swaying_motion(frames, seed), f"r{seed}")
    random = torch.Generator().manual_seed(seed)
    count = 40 * frames
    points = 4 * torch.rand(count, 3, generator=random) - 2
    points[: count // 2, 2] = 0.0
    times = recording.head.timestamps
    first_seen = times[torch.randint(0, frames, (count,), generator=random)].sort().values
    first_seen[0] = times[0]
    shown = times[::2]
    camera = CameraStream(
        shown,
        Camera.pinhole(32, 32, 90.0),
        torch.eye(3),
        torch.zeros(3),
        embedding=torch.randn(len(shown), IMAGE, generator=random),
        embedding_name="eyes",
    )
    return replace(recording, points=PointCloud(points, first_seen=first_seen), camera=camera)


def moments(recording: Recording) -> list[HeadSample]:
    """A recording as it was sensed, moment by moment."""
    head, points, camera = recording.head, recording.points, recording.camera
    conditions = []
    for i, time in enumerate(head.timestamps.tolist()):
        new = points.points_world[points.first_seen == time] if points is not None else None
        shown = camera is not None and i % 2 == 0
        conditions.append(HeadSample(time, head.T_world_device[i], new, camera.embedding[i // 2] if shown else None))
    return conditions


def wearer(recording: Recording) -> Wearer:
    return Wearer(recording.skeleton, recording.head.R_head_device, recording.head.t_head_device)


def stream(session: HMD2Session, *conditions: list[HeadSample], ended: bool = True) -> list[Motion]:
    """One motion per wearer, from one moment of each per push."""
    predicted = [[] for _ in conditions]
    for i in range(max(len(part) for part in conditions)):
        for parts, motion in zip(predicted, pushed(session, [part[i : i + 1] for part in conditions])):
            parts += [] if motion is None else [motion]
    for parts, motion in zip(predicted, session.poses(ended=True) if ended else [None] * len(conditions)):
        parts += [] if motion is None else [motion]
    return [together(parts) for parts in predicted]


def together(parts: list[Motion]) -> Motion:
    return replace(
        parts[0],
        timestamps=torch.cat([part.timestamps for part in parts]),
        R_parent_joint=torch.cat([part.R_parent_joint for part in parts]),
        t_world_root=torch.cat([part.t_world_root for part in parts]),
        contact_prob=torch.cat([part.contact_prob for part in parts]),
    )


def rounding(frames: int) -> float:
    """What float32 may make of a stream that sums in another order than the capture of the whole.

    CPUs differ in the order in which they sum (AVX-512, AVX2, none), and batches of other sizes do, too. An evaluation
    sums up to 64 products, which leaves some 8 ulp of values up to 2; windows begin from those before them, so that the
    errors of all evaluations in a row may add up. (An Intel Xeon was seen 1.8e-5 off at 133 frames: 8.0e-5 allowed.)
    """
    evaluations = STEPS * math.ceil(frames / STRIDE)
    return 2 * 8 * torch.finfo(torch.float32).eps * evaluations


def assert_same(motion: Motion, other: Motion, atol: float | None = None) -> None:
    atol = rounding(len(motion)) if atol is None else atol
    assert torch.allclose(motion.timestamps, other.timestamps, atol=1e-9)
    for name in ("R_parent_joint", "t_world_root", "contact_prob"):
        torch.testing.assert_close(getattr(motion, name), getattr(other, name), atol=atol, rtol=0)


@pytest.mark.parametrize(("stride", "frames"), [(10, 133), (45, 150), (60, 121)])
@pytest.mark.parametrize("windows", [{"inpaint": True}, {}, {"lookahead": None}])
def test_streaming_equals_the_capture_of_the_whole(pipeline, stride, frames, windows):
    recording, hmd2 = surrounded(frames), pipeline(stride, **windows)
    streamed = stream(HMD2Session(hmd2, [wearer(recording)], [3]), moments(recording))[0]
    assert len(streamed) == frames
    assert_same(streamed, hmd2(recording, seed=3))


def test_hands_that_come_and_go_are_streamed_as_the_capture_of_the_whole_has_them(pipeline):
    """They are tracked with the head, so that a stream's newest pose is at the frame's time."""
    recording, hmd2 = surrounded(90), pipeline(points=False, hands=True)
    seen = {"left_wrist": [*range(20, 40), *range(60, 70)], "right_wrist": [*range(90)]}
    tracked = {}
    for joint, rows in seen.items():
        T = recording.motion.joint(joint)[rows]
        tracked[joint] = Trajectory(recording.head.timestamps[rows], T.R, T.t)
    given = replace(recording, tracked=tracked)
    whole = hmd2(given, seed=3)
    for part in (slice(25, 35), slice(62, 68)):
        other = replace(given, tracked={"right_wrist": tracked["right_wrist"]})
        assert (whole.R_parent_joint - hmd2(other, seed=3).R_parent_joint)[part].abs().max() > 1e-3
    samples = []
    for sample in moments(recording):
        here = ((joint, (track.timestamps - sample.timestamp).abs().argmin()) for joint, track in tracked.items())
        samples += [
            WristSample(joint, sample.timestamp, tracked[joint].T_world_body[row])
            for joint, row in here
            if tracked[joint].timestamps[row] == sample.timestamp
        ]
        samples.append(sample)
    session = HMD2Session(hmd2, [wearer(recording)], [3])
    assert_same(stream(session, samples)[0], whole)
    assert not session.refused[0]
    wrong = WristSample("left_wrist", 1.0, Rigid(2 * torch.eye(3), torch.zeros(3)))
    session.push([[wrong, WristSample("elbow", 1.0, wrong.T_world_joint)]])
    assert session.refused[0] == {"left_wrist: not a rotation": 1, "head: wrong type or shape": 1}


def test_shorter_windows_stream_as_the_capture_of_the_whole_has_them(pipeline):
    recording, hmd2 = surrounded(133), pipeline(window=40)
    streamed = stream(HMD2Session(hmd2, [wearer(recording)], [3]), moments(recording))[0]
    assert_same(streamed, hmd2(recording, seed=3))
    rotations = streamed.R_parent_joint, pipeline()(recording, seed=3).R_parent_joint
    torch.testing.assert_close(*(R[:40] for R in rotations), atol=rounding(40), rtol=0)
    assert (rotations[0] - rotations[1])[60:].abs().max() > 1e-3, "less of the past is seen"


def test_poses_wait_for_the_stride(pipeline):
    session = HMD2Session(pipeline(), [Wearer(xsens23())], [0])
    predicted = [pushed(session, [[moment]])[0] for moment in moments(surrounded(25))]
    assert [i for i, motion in enumerate(predicted) if motion is not None] == [9, 19]
    assert [len(motion) for motion in predicted if motion is not None] == [10, 10]
    rest = session.poses(ended=True)[0]
    assert len(rest) == 5
    assert session.poses(ended=True) == [None]


def test_poses_wait_for_what_they_look_ahead_to(pipeline):
    session = HMD2Session(pipeline(lookahead=13), [Wearer(xsens23())], [0])
    predicted = [pushed(session, [[moment]])[0] for moment in moments(surrounded(45))]
    assert [(i, len(motion)) for i, motion in enumerate(predicted) if motion is not None] == [
        (19, 7),
        (29, 10),
        (39, 10),
    ]
    rest = session.poses(ended=True)[0]
    assert len(rest) == 18
    times = torch.cat([motion.timestamps for motion in [*predicted, rest] if motion is not None])
    assert torch.allclose(times * 60, torch.arange(45, dtype=torch.float64))


def test_the_head_is_where_it_was_measured(pipeline):
    recording = surrounded(50)
    motion = stream(HMD2Session(pipeline(), [wearer(recording)], [0]), moments(recording))[0]
    assert torch.allclose(motion.joint("head").t, recording.head.T_world_head.t, atol=1e-4)
    assert torch.allclose(motion.joint("head").R, recording.head.T_world_head.R, atol=1e-4)


def test_several_wearers_are_as_alone(pipeline):
    """One starts later and has a clock of their own; they share batches where both are ready."""
    hmd2, recordings = pipeline(), [surrounded(90, 1), surrounded(80, 2)]
    late = [moment._replace(timestamp=moment.timestamp + 500.0) for moment in moments(recordings[1])]
    session = HMD2Session(hmd2, [wearer(recording) for recording in recordings], [5, 6])
    early = moments(recordings[0])
    predicted = [[], []]
    for i in range(90):
        now = pushed(session, [[early[i]], late[i - 10 : i - 9] if i >= 10 else []])
        for parts, motion in zip(predicted, now):
            parts += [] if motion is None else [motion]
    first, second = (together(parts) for parts in predicted)
    assert_same(first, hmd2(recordings[0], seed=5), 1e-4)
    assert_same(replace(second, timestamps=second.timestamps - 500.0), hmd2(recordings[1], seed=6), 1e-4)


@pytest.mark.parametrize("missing", [range(33, 37), range(20, 29), range(0)])
def test_missing_poses_within_a_chunk_are_interpolated(pipeline, missing):
    recording, hmd2 = surrounded(75), pipeline(points=False)
    conditions = [
        moment._replace(T_world_device=None) if i in missing else moment for i, moment in enumerate(moments(recording))
    ]
    keep = [i for i in range(75) if i not in missing]
    observed = replace(recording, head=head_of(recording, keep))
    assert_same(stream(HMD2Session(hmd2, [wearer(recording)], [2]), conditions)[0], hmd2(observed, seed=2), 5e-5)


def test_poses_that_are_missing_at_a_chunks_end_are_held_and_put_right(pipeline):
    recording = surrounded(70)
    conditions = moments(recording)
    conditions[38], conditions[39] = (moment._replace(T_world_device=None) for moment in conditions[38:40])
    session = HMD2Session(pipeline(), [wearer(recording)], [2])
    motion = stream(session, conditions)[0]
    head = motion.joint("head").t
    assert len(motion) == 70
    assert torch.allclose(head[38:40], head[37].expand(2, 3), atol=1e-4)
    assert torch.allclose(head[40:], recording.head.T_world_head.t[40:], atol=1e-4)
    window = session.streams[0].windows.frames.t_world_head[0]
    true = recording.head.T_world_head.t[70 - 60 : 70]
    assert torch.allclose(window[:60], true, atol=2e-4)


def test_moments_out_of_order_are_sorted_in_and_late_ones_dropped(pipeline):
    recording, hmd2 = surrounded(60), pipeline()
    conditions = moments(recording)
    mixed = [*conditions[:12], conditions[14], conditions[13], conditions[12], *conditions[15:]]
    session = HMD2Session(hmd2, [wearer(recording)], [1])
    assert_same(stream(session, mixed)[0], hmd2(recording, seed=1))
    assert session.dropped == [0]
    late = [*conditions[:15], *conditions[16:], conditions[15], conditions[59]]
    session = HMD2Session(hmd2, [wearer(recording)], [1])
    assert len(stream(session, late)[0]) == 60
    assert session.dropped == [2]


@pytest.mark.parametrize("fps", [90.0, 47.0])
def test_other_rates_are_brought_to_the_pipelines(pipeline, fps):
    motion = swaying_motion(120, fps=fps)
    recording, hmd2 = recording_of(motion, "a"), pipeline(points=False)
    assert_same(stream(HMD2Session(hmd2, [wearer(recording)], [1]), moments(recording))[0], hmd2(recording, seed=1))


@pytest.mark.parametrize("broken", ["gap", "jump"])
@pytest.mark.parametrize("lookahead", [0, 13])
def test_after_gaps_and_jumps_it_begins_anew_as_offline(pipeline, broken, lookahead):
    recording, hmd2 = surrounded(150), pipeline(points=False, lookahead=lookahead)
    hmd2.model = replace(hmd2.model, features=replace(hmd2.model.features, height="relative"))
    keep = [i for i in range(150) if broken == "jump" or not 44 <= i < 90]
    head = head_of(recording, keep)
    if broken == "jump":
        head = replace(
            head, t_world_device=head.t_world_device + torch.tensor([3.0, 0, 0]) * (head.timestamps > 0.8)[:, None]
        )
    recording = replace(recording, head=head, points=None, camera=None)
    whole = hmd2(recording, seed=7)
    motion = stream(HMD2Session(hmd2, [wearer(recording)], [7]), moments(recording))[0]
    predicted = torch.tensor([i for i in range(150) if broken == "jump" or not 44 <= i < 90])
    kept = replace(
        whole,
        timestamps=whole.timestamps[predicted],
        R_parent_joint=whole.R_parent_joint[predicted],
        t_world_root=whole.t_world_root[predicted],
        contact_prob=whole.contact_prob[predicted],
    )
    assert_same(motion, kept)


def test_what_is_not_finite_counts_as_missing(pipeline):
    recording, hmd2 = surrounded(60), pipeline()
    conditions = moments(recording)
    nan = Rigid(torch.full((3, 3), torch.nan), torch.zeros(3))
    conditions[22] = conditions[22]._replace(
        T_world_device=nan, embedding=torch.full((IMAGE,), torch.inf), floor_height=torch.nan
    )
    conditions[31] = conditions[31]._replace(points_world=torch.full((5, 3), torch.nan))
    conditions.insert(40, HeadSample(float("nan"), Rigid.identity()))
    session = HMD2Session(hmd2, [wearer(recording)], [1])
    motion = stream(session, conditions)[0]
    assert len(motion) == 60
    assert motion.R_parent_joint.isfinite().all()
    assert session.dropped == [2]


def test_embeddings_of_another_length_are_refused(pipeline):
    with pytest.raises(WearcapError, match="an embedding of 9 features at 0.500 s"):
        pushed(
            HMD2Session(pipeline(), [Wearer(xsens23())], [0]),
            [[HeadSample(0.5, Rigid.identity(), None, torch.zeros(9))]],
        )


def test_a_floor_that_is_given_is_used(pipeline):
    recording = surrounded(40)
    session = HMD2Session(pipeline(), [wearer(recording)], [0])
    stream(session, [moment._replace(floor_height=0.01 * i) for i, moment in enumerate(moments(recording))])
    assert torch.allclose(session.streams[0].windows.frames.floor_height[0, :40], 0.01 * torch.arange(40), atol=1e-5)


def test_points_beyond_the_memory_are_forgotten(pipeline):
    session = HMD2Session(pipeline(), [Wearer(xsens23())], [0], Memory(radius_m=5.0, max_points=2000))
    random = torch.Generator().manual_seed(0)
    for i in range(120):
        at = torch.tensor([0.1 * i, 0.0, 1.6])
        points = at + 8 * torch.rand(100, 3, generator=random) - 4
        pushed(session, [[HeadSample(i / 60, Rigid(torch.eye(3), at), points)]])
    places = session.streams[0].sensing.places
    kept = torch.cat([points for points, _ in places._tracked + places._new])
    assert len(kept) == len(places.map) <= 2000 + 1000
    assert (kept - at)[:, :2].norm(dim=-1).min() < 1.0


def test_a_long_stream_needs_no_more_than_a_short_one(pipeline):
    """A minute in which the map is full after a few seconds: what the wearer keeps does not grow."""
    session = HMD2Session(pipeline(60, steps=1), [Wearer(xsens23())], [0], Memory(5.0, 1000))
    conditions, sizes = moments(surrounded(120))[::6], []
    for lap in range(30):
        pushed(session, [[moment._replace(timestamp=moment.timestamp + 2 * lap) for moment in conditions]])
        if lap % 5 == 4:
            sizes.append(len(pickle.dumps(vars(session.streams[0].sensing.places) | vars(session.streams[0]._track))))
    assert max(sizes[3:]) <= 1.02 * max(sizes[:3])


def head_of(recording: Recording, take):
    head = recording.head
    return replace(
        head,
        timestamps=head.timestamps[take],
        R_world_device=head.R_world_device[take],
        t_world_device=head.t_world_device[take],
    )
