"""Other people's bones in a recorded motion: feet stay where they stand, the head device sits as it did, samples repeat."""

from dataclasses import replace

import pytest
import torch

from wearcap.body.kinematics import site_positions
from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.data.bodies import OtherBodies, Proportions, with_proportions
from wearcap.data.features import body_size
from wearcap.data.windows import Content, Source, Windows
from wearcap.errors import WearcapError
from wearcap.geometry.trajectory import Trajectory
from wearcap.recording import RecordingStore
from wearcap.systems.echo.features import EchoFeatures
from wearcap.systems.echo.training_windows import EchoContent
from wearcap.systems.hmd2.training_windows import HeadContent
from wearcap.systems.mocap_every.training_windows import WatchContent
from wearcap_testing import small_dataset

TALL = Proportions(legs=1.1, trunk=0.95, shoulders=1.05, upper_arms=0.9, forearms=1.2)


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return small_dataset(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def recording(store):
    return store.load(store.names("train")[0])


def test_limbs_have_the_drawn_lengths_and_joints_turn_as_before(recording):
    other = with_proportions(recording, TALL)
    before, after = body_size(recording.motion.skeleton), body_size(other.motion.skeleton)
    assert after[1] / before[1] == pytest.approx(1.1)
    assert after[3] / before[3] == pytest.approx(0.95)
    arms = recording.motion.skeleton.indices("left_elbow", "left_wrist")
    upper, lower = recording.motion.skeleton.t_parent_joint[arms].norm(dim=1)
    assert after[2] == pytest.approx((0.9 * upper + 1.2 * lower).item())
    assert torch.equal(other.motion.R_parent_joint, recording.motion.R_parent_joint)
    assert other.skeleton == other.motion.skeleton


def test_feet_stay_where_they_stand(recording):
    """All that is below the hips is similar: patches of feet are in the old places times the legs' factor."""
    other = with_proportions(recording, TALL)
    patches = [
        site_positions(each.motion.skeleton, each.motion.T_world_joint, FOOT_PATCHES) for each in (recording, other)
    ]
    torch.testing.assert_close(patches[1], 1.1 * patches[0], atol=1e-4, rtol=0)


def test_the_device_sits_on_the_head_as_it_did(recording):
    other = with_proportions(recording, TALL)
    seats = [each.head.t_world_device - each.motion.joint("head").t for each in (recording, other)]
    torch.testing.assert_close(seats[1], seats[0], atol=1e-5, rtol=0)
    assert not torch.allclose(other.head.t_world_device, recording.head.t_world_device, atol=0.01)
    assert other.points is None
    assert not other.imu


def test_handled_objects_are_refused(recording):
    handled = replace(
        recording,
        object_motion={
            "box": Trajectory(recording.head.timestamps, recording.head.R_world_device, recording.head.t_world_device)
        },
    )
    with pytest.raises(WearcapError, match="objects are handled"):
        with_proportions(handled, TALL)


def test_people_are_a_function_of_the_seed_and_spread_as_people_do():
    bodies = OtherBodies(4)
    assert bodies.proportions(7) == bodies.proportions(7)
    legs = torch.tensor([bodies.proportions(seed).legs for seed in range(2000)]).log()
    assert legs.std().item() == pytest.approx((0.05**2 + 0.03**2) ** 0.5, rel=0.1)
    with pytest.raises(WearcapError, match="1 or more"):
        OtherBodies(0)


CONTENTS = {
    "hmd2": (HeadContent(), {"window": 60, "stride": 20, "fps": 60.0}),
    "mocap_every": (WatchContent(), {"window": 40, "stride": 10, "fps": 30.0, "every": 2}),
    "echo": (
        EchoContent(EchoFeatures(classes=["box"], shape_size=0), None),
        {"window": 30, "stride": 10, "fps": 30.0, "every": 2},
    ),
}


@pytest.mark.parametrize("system", CONTENTS)
def test_windows_are_of_the_wearer_and_of_others_in_turn(store, system):
    content, settings = CONTENTS[system]
    assert isinstance(content, Content)
    sources = [Source(str(store.root))]
    varied = Windows(sources, "train", True, content=content, bodies=OtherBodies(3), **settings)
    plain = Windows(sources, "train", True, content=content, **settings)
    for person in range(4):
        window, own = varied[0, 4 * 5 + person], plain[0, 4 * 5 + person]
        assert torch.equal(window.R_parent_joint, own.R_parent_joint)
        assert torch.equal(window.size, own.size) == (person == 0)
    head = [
        each.t_world_head if system != "echo" else each.t_world_point[:, 0] for each in (varied[0, 21], plain[0, 21])
    ]
    assert not torch.allclose(*head)


def test_validation_and_sources_that_say_so_are_as_recorded(store):
    content, settings = CONTENTS["hmd2"]
    for windows in (
        Windows([Source(str(store.root))], "train", False, content=content, bodies=OtherBodies(3), **settings),
        Windows(
            [Source(str(store.root), bodies=False)], "train", True, content=content, bodies=OtherBodies(3), **settings
        ),
    ):
        sizes = [windows[0, seed].size for seed in range(4)]
        assert all(torch.equal(size, sizes[0]) for size in sizes)


def test_climbing_on_what_was_not_captured_is_not_trained_on(store, recording, tmp_path):
    """Without the floor, and with a provenance that says the ground is uneven, heights over it say nothing."""
    uneven = replace(recording.motion, provenance={**recording.motion.provenance, "floor": "uneven"})
    for name, motion in (("level", recording.motion), ("climbed", uneven)):
        made = RecordingStore(tmp_path)
        made.add(replace(recording, name=name, motion=motion, floor=None), split="train", config_hash="test")
    for content, settings in CONTENTS.values():
        windows = Windows([Source(str(tmp_path))], "train", content=content, **settings)
        assert {windows.recordings[number][1] for number in windows.starts[:, 0].tolist()} == {"level"}
