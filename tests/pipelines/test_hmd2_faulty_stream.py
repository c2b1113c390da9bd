"""HMD²'s stream when its devices send what cannot be true."""

import math

import pytest
import torch
from test_hmd2_stream import IMAGE, WINDOW, moments, stream, surrounded, wearer

from bad_packets import TIMES, VECTORS, Mutator, bad_poses, unchecked
from small_hmd2 import hmd2_of
from wearcap.errors import WearcapError
from wearcap.models.layers import TransformerSize
from wearcap.models.voxel_autoencoder import VoxelAutoencoder
from wearcap.recording import Motion
from wearcap.systems.hmd2.features import HeadFeatures
from wearcap.systems.hmd2.model import MotionDenoiser
from wearcap.systems.hmd2.places import Memory
from wearcap.systems.hmd2.stream import HeadSample, HMD2Session
from wearcap_testing import pushed

FRAMES, FAULT = 80, 44
EMBEDDINGS = VECTORS | {"longer": torch.zeros(IMAGE + 1), "nan": torch.full((IMAGE,), math.nan)}


@pytest.fixture(scope="module")
def hmd2():
    torch.manual_seed(1)
    places, features = VoxelAutoencoder().eval(), HeadFeatures(contacts=True, body=True)
    net = MotionDenoiser(
        features.motion_size,
        features.condition_size,
        WINDOW,
        TransformerSize(32, 1, 4, 64, 0.0),
        4,
        blend=5,
        conditions={"points": places.size, "image": IMAGE},
    )
    for parameter in net.parameters():
        torch.nn.init.normal_(parameter, std=0.05)
    given = {"place_encoder": places, "image_encoder": "eyes", "live": True, "fade": 6, "lookahead": 0}
    return hmd2_of(net, features, wearer(surrounded(4)).skeleton, stride=10, steps=2, **given)


@pytest.fixture(scope="module")
def recording():
    return surrounded(FRAMES)


@pytest.fixture(scope="module")
def undisturbed(hmd2, recording):
    return stream(opened(hmd2, recording), moments(recording), moments(recording))


def opened(hmd2, recording) -> HMD2Session:
    return HMD2Session(hmd2, [wearer(recording), wearer(recording)], [3, 4])


def push(session: HMD2Session, *conditions: list) -> list[Motion | None]:
    unchecked(session.push)(list(conditions))
    return session.poses()


def run(session: HMD2Session, conditions: list[HeadSample], shift: float = 0.0) -> list[Motion]:
    """What the first of two wearers is given, in pieces; the second one sends nothing."""
    shifted = [moment._replace(timestamp=moment.timestamp + shift) for moment in conditions]
    return [motion for moment in shifted if (motion := push(session, [moment], [])[0]) is not None]


def assert_equal(motion: Motion, expected: Motion) -> None:
    for name in ("timestamps", "R_parent_joint", "t_world_root", "contact_prob"):
        assert torch.equal(getattr(motion, name), getattr(expected, name)), name


def test_bad_packets_of_one_wearer_change_nothing_for_anybody(hmd2, recording, undisturbed):
    conditions, session = moments(recording), opened(hmd2, recording)
    good, before = recording.head.T_world_device[FAULT], conditions[FAULT - 1].timestamp
    bad = [HeadSample(time, good) for time in TIMES.values()]
    bad += [HeadSample(before + 1e-4 * k, pose) for k, pose in enumerate(bad_poses(good).values())]
    bad += [HeadSample(before, None, points_world=points) for points in VECTORS.values() if points is not None]
    bad += [
        HeadSample(before, None, floor_height=height)
        for name, height in TIMES.items()
        if height is not None and name != "ahead" and name != "far"
    ]
    bad += [HeadSample(before, None, floor_height=1e9), None, "packet", (before, good)]
    predicted = [[], []]
    for frame, moment in enumerate(conditions):
        first = [*bad, moment] if frame == FAULT else [moment]
        for parts, motion in zip(predicted, push(session, first, [moment])):
            parts += [] if motion is None else [motion]
    for motions, expected in zip(predicted, undisturbed):
        assert_equal(motions[0].sliced(0, 10), expected.sliced(0, 10))
        assert sum(map(len, motions)) == FRAMES
        for k, motion in enumerate(motions):
            assert_equal(motion, expected.sliced(10 * k, 10 * k + 10))
    first, second = session.refused
    assert sum(first.values()) == len(bad)
    assert session.dropped == [len(TIMES) + len(bad_poses(good)), 0]
    assert second == {}


def test_a_bad_picture_is_none_and_the_next_one_is_believed(hmd2, recording, undisturbed):
    conditions, session = moments(recording), opened(hmd2, recording)
    time = (FAULT - 0.5) / 60
    bad = [HeadSample(time, embedding=value) for value in EMBEDDINGS.values() if value is not None]
    predicted = stream(session, conditions[:FAULT], conditions[:FAULT], ended=False)
    push(session, bad, [])
    predicted = stream(session, conditions[FAULT:], conditions[FAULT:])
    assert_equal(predicted[0], undisturbed[0].sliced(40, FRAMES))
    assert sum(session.refused[0].values()) == len(bad)


def test_an_embedding_of_wrong_length_is_raised_at_first_and_disturbs_nothing(hmd2, recording, undisturbed):
    conditions, session = moments(recording), opened(hmd2, recording)
    wrong = conditions[0]._replace(embedding=torch.zeros(IMAGE + 1))
    for _ in range(2):
        with pytest.raises(WearcapError, match=f"an embedding of {IMAGE + 1} features at 0.000 s"):
            pushed(session, [[conditions[0]._replace(embedding=None)], [wrong]])
    for motion, expected in zip(stream(session, conditions, conditions), undisturbed):
        assert_equal(motion, expected)
    pushed(session, [[wrong], []])
    assert session.refused[0]["embedding: wrong type or shape"] == 1


@pytest.mark.parametrize("shift", [-1000.0, -1.1, 1000.0])
def test_where_the_clock_moves_it_goes_on(hmd2, recording, shift):
    """Back: exactly as a session that is new."""
    session, fresh, conditions = opened(hmd2, recording), opened(hmd2, recording), moments(recording)
    before = run(session, conditions[:75])
    left = run(session, conditions, 75 / 60 + shift) + [
        motion for motion in session.poses(ended=True)[:1] if motion is not None
    ]
    expected = run(fresh, conditions, 75 / 60 + shift) + [
        motion for motion in fresh.poses(ended=True)[:1] if motion is not None
    ]
    assert all((motion.timestamps.diff() > 0).all() for motion in before + left)
    assert sum(map(len, before + left)) == 75 + FRAMES
    late, expected = _joined(left, FRAMES), _joined(expected, FRAMES)
    if shift < 0:
        for name in ("timestamps", "R_parent_joint", "t_world_root"):
            assert torch.equal(late[name], expected[name])
    else:
        assert torch.allclose(late["timestamps"], expected["timestamps"], atol=1e-6)
        assert late["R_parent_joint"].isfinite().all()
    assert session.dropped == [0, 0]


def _joined(parts: list[Motion], count: int) -> dict[str, torch.Tensor]:
    """The last frames of several pieces."""
    names = ("timestamps", "R_parent_joint", "t_world_root")
    return {name: torch.cat([getattr(part, name) for part in parts])[-count:] for name in names}


def test_what_waits_for_a_lost_head_is_bounded(hmd2, recording, monkeypatch):
    monkeypatch.setattr("wearcap.systems.hmd2.conditions.MAX_WAITING", 30)
    session = HMD2Session(hmd2, [wearer(recording)], [0], Memory(max_points=1000))
    for k in range(200):
        pushed(session, [[HeadSample(k / 60, None, torch.rand(100, 3), torch.zeros(IMAGE), 0.0)]])
    known = session.streams[0].sensing
    places = known.places
    assert len(known.sensed["image"].values) == len(known.floors) == 30
    assert len(places.map) == sum(len(points) for points, _ in places._new) <= 4000


@pytest.mark.parametrize("seed", range(3))
def test_whatever_comes_it_goes_on(hmd2, recording, seed):
    session, draw, conditions = opened(hmd2, recording), Mutator(seed), moments(recording)
    fine = HMD2Session(hmd2, [wearer(recording)], [4])
    for k in range(240):
        good = conditions[k % FRAMES]
        bad = HeadSample(
            draw.time(k / 60),
            draw.pose(good.T_world_device),
            draw.one(VECTORS) if draw.bad() else good.points_world,
            draw.one(EMBEDDINGS) if draw.bad() and k else good.embedding,
            draw.one(TIMES) if draw.bad() else None,
        )
        neighbour = [conditions[k]] if k < FRAMES else []
        for motion in (predicted := push(session, [bad], neighbour)):
            assert motion is None or motion.R_parent_joint.isfinite().all()
            assert motion is None or motion.t_world_root.isfinite().all()
        alone = pushed(fine, [neighbour])[0]
        assert (alone is None) == (predicted[1] is None)
        assert alone is None or torch.allclose(alone.t_world_root, predicted[1].t_world_root, atol=1e-4)
    well = run(session, conditions, 4.0)
    assert max(motion.timestamps[-1].item() for motion in well) > 5.1
    state = session.streams[0]
    assert len(state.sensing.sensed["image"].values) + len(state.sensing.floors) + len(state._track._poses) < 300
