"""Other people's bones in a recorded motion: as a skeleton with these bones would move, and for a share of the windows."""

from dataclasses import asdict, replace

import pytest
import torch

from benchmarks.rivals.single_windows import bodies as before
from benchmarks.rivals.single_windows import echo_windows, head_windows, watch_windows
from benchmarks.rivals.single_windows.bodies import OtherPerson, Proportions, with_proportions
from benchmarks.rivals.single_windows.transforms import Cut
from carried_box import carrying
from drawn_windows import numbers
from wearcap.body.kinematics import forward_kinematics, site_positions
from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.data.bodies import (
    PARTS,
    OtherBodies,
    bones_in_parts,
    head_in_parts,
    places_in_parts,
    size_in_parts,
    with_bones,
)
from wearcap.data.features import body_size
from wearcap.data.windows import Source, Windows
from wearcap.errors import WearcapError
from wearcap.recording import RecordingStore
from wearcap.systems.echo.features import EchoFeatures
from wearcap.systems.echo.training_windows import EchoContent
from wearcap.systems.hmd2.training_windows import HeadContent
from wearcap.systems.mocap_every.training_windows import WatchContent
from wearcap_testing import small_dataset

TALL = torch.tensor([1.0, 1.1, 0.95, 1.05, 0.9, 1.2])
"""Factors of `PARTS`."""
CONTENTS = {
    "hmd2": (HeadContent(), {"window": 60, "stride": 20, "fps": 60.0}),
    "mocap_every": (WatchContent(), {"window": 40, "stride": 10, "fps": 30.0, "every": 2}),
    "echo": (
        EchoContent(EchoFeatures(classes=["box"], shape_size=0), None),
        {"window": 30, "stride": 10, "fps": 30.0, "every": 2},
    ),
}
BEFORE = {
    "hmd2": head_windows.HeadContent(),
    "mocap_every": watch_windows.WatchContent(),
    "echo": echo_windows.EchoContent(EchoFeatures(classes=["box"], shape_size=0), None),
}


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return small_dataset(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def recording(store):
    return store.load(store.names("train")[0])


def windows(root, system: str, bodies: OtherBodies | None = None, augmented: bool = True, free: bool = True) -> Windows:
    content, settings = CONTENTS[system]
    sources = [Source(str(root), bodies=free)]
    return Windows(sources, "train", augmented, content=content, bodies=bodies, **settings)


def weighed(parts: torch.Tensor, bones: torch.Tensor = TALL) -> torch.Tensor:
    return (bones[:, None] * parts).sum(-2)


def test_parts_that_are_weighed_and_summed_are_a_body_with_these_bones(recording):
    motion, other = recording.motion, with_proportions(recording, Proportions(*TALL[1:].tolist())).motion
    torch.testing.assert_close(weighed(bones_in_parts(motion.skeleton)), other.skeleton.t_parent_joint)
    names = motion.skeleton.joint_names
    places = weighed(places_in_parts(motion, names))
    torch.testing.assert_close(places, other.T_world_joint.t, atol=1e-5, rtol=0)
    torch.testing.assert_close(places_in_parts(motion, names).sum(2), motion.T_world_joint.t, atol=1e-5, rtol=0)
    off = 0.1 * torch.randn(len(motion), 3)  # the device sits on the head as it did
    head = weighed(head_in_parts(motion, motion.joint("head").t + off))
    torch.testing.assert_close(head, other.joint("head").t + off, atol=1e-5, rtol=0)
    torch.testing.assert_close(weighed(size_in_parts(motion.skeleton)), body_size(other.skeleton), atol=1e-5, rtol=0)
    skeleton = with_bones(motion.skeleton, TALL)
    assert skeleton.sites == other.skeleton.sites
    assert torch.equal(skeleton.t_parent_joint, other.skeleton.t_parent_joint)


@pytest.mark.parametrize("system", CONTENTS)
def test_windows_of_others_are_cut_out_of_recordings_done_by_them(store, system):
    """With the bones that were drawn, the whole recording is computed anew."""
    data, count = windows(store.root, system, OtherBodies(1.0)), 6
    index, seed = torch.arange(count) * (len(data) // count), torch.arange(count)
    cut = data.cut(index, seed)
    found, older, every = OtherBodies(1.0)(cut.read()).values, BEFORE[system], CONTENTS[system][1].get("every", 1)
    assert cut.others.all()
    for k in range(count):
        person = OtherPerson(Proportions(*cut.bones[k, 1:].tolist()))
        track = older.open(store, store.names("train")[cut.track[k]], every, person)
        same = Cut(cut.start[k].item(), cut.count, data.packed.length[cut.track[k]].item(), step=cut.step)
        for name, value in older.read(track, same, None).values.items():
            if (system, name[:5]) != ("hmd2", "floor"):  # of another path there, not the scaled one of this
                limit = 2e-3 if name.startswith(("acc", "R")) else 2e-5
                torch.testing.assert_close(found[name][k].float(), value.float(), atol=limit, rtol=1e-4)


def test_feet_stay_where_they_stand(store):
    """All that is below the hips is similar: patches of feet are in the old places times the legs' factor, as the floor."""
    data = windows(store.root, "mocap_every", OtherBodies(1.0))
    plain, other = (each.batch(numbers(0, 4), numbers(1, 2)) for each in (windows(store.root, "mocap_every"), data))
    bones, skeleton, feet = data.cut(numbers(0, 4), numbers(1, 2)).bones, store.load("r0").motion.skeleton, []
    for batch, factors in ((plain, torch.ones_like(bones)), (other, bones)):
        for k in range(2):
            own = with_bones(skeleton, factors[k])
            body = forward_kinematics(own, batch.R_parent_joint[k], batch.t_world_root[k], batch.t_parent_joint[k])
            feet.append(site_positions(own, body, FOOT_PATCHES))
    legs = bones[:, PARTS.index("legs")]
    for k in range(2):
        torch.testing.assert_close(feet[2 + k], legs[k] * feet[k], atol=1e-4, rtol=0)
    floors = [windows(store.root, "hmd2", who).batch(numbers(0, 4), numbers(1, 2)) for who in (None, OtherBodies(1.0))]
    assert floors[0].floor_from_head.abs().max() > 0.001
    torch.testing.assert_close(floors[1].floor_from_head, legs[:, None] * floors[0].floor_from_head)


@pytest.mark.parametrize("system", CONTENTS)
def test_a_share_of_the_windows_is_of_others_and_the_rest_as_recorded(store, system):
    chosen = numbers(0).repeat(60), torch.arange(60)
    varied, plain = windows(store.root, system, OtherBodies(0.7)), windows(store.root, system).batch(*chosen)
    others, batch = varied.cut(*chosen).others, varied.batch(*chosen)
    assert torch.equal(batch.R_parent_joint, plain.R_parent_joint)
    assert torch.equal((batch.size != plain.size).any(1), others)
    for name, value in plain._asdict().items():
        if value.is_floating_point():
            torch.testing.assert_close(getattr(batch, name)[~others], value[~others], atol=1e-5, rtol=0)
    many = varied.cut(numbers(0).repeat(4000), torch.arange(4000))
    assert many.others.double().mean().item() == pytest.approx(0.7, abs=0.03)
    people = [before.OtherBodies(1).proportions(seed) for seed in range(3000)]
    older = torch.tensor([list(asdict(each).values()) for each in people])
    logs = (many.bones[many.others, 1:].log(), older.log())
    torch.testing.assert_close(*(each.T.cov() for each in logs), atol=2.5e-4, rtol=0)
    assert logs[0].mean(0).abs().max() < 0.004
    assert (many.bones[~many.others] == 1).all()
    assert (many.bones[:, PARTS.index("device")] == 1).all()


def test_validation_and_sources_that_say_so_are_as_recorded(store):
    for setting in ({"augmented": False}, {"free": False}):
        size = windows(store.root, "hmd2", OtherBodies(1.0), **setting).batch(numbers(0, 0, 0), torch.arange(3)).size
        assert torch.equal(size, size[:1].expand_as(size))


def test_recordings_with_handled_objects_are_given_to_nobody_else(recording, tmp_path):
    made = RecordingStore(tmp_path)
    made.add(carrying(3.0, "handled", fps=60.0), split="train", config_hash="test")
    made.add(replace(recording, name="walked"), split="train", config_hash="test")
    data = windows(tmp_path, "hmd2", OtherBodies(1.0, arms=0.5))
    cut = data.cut(torch.arange(len(data)), torch.arange(len(data)))
    handled = data.packed.length[data.starts[:, 0]] == 180
    assert torch.equal(cut.others, ~handled)
    assert (cut.bones[handled] == 1).all()
    assert torch.equal(cut.track[handled], data.starts[handled, 0])


@pytest.mark.parametrize("share", [0.0, -0.1, 1.1])
def test_a_share_is_more_than_none(share):
    with pytest.raises(WearcapError, match="a share of the windows, from 0 to 1"):
        OtherBodies(share)


def test_climbing_on_what_was_not_captured_is_not_trained_on(recording, tmp_path):
    """Without the floor, and with a provenance that says the ground is uneven, heights over it say nothing."""
    uneven = replace(recording.motion, provenance={**recording.motion.provenance, "floor": "uneven"})
    made = RecordingStore(tmp_path)
    for name, motion in (("level", recording.motion), ("climbed", uneven)):
        made.add(replace(recording, name=name, motion=motion, floor=None), split="train", config_hash="test")
    for content, settings in CONTENTS.values():
        assert [content.usable(made, name) for name in ("level", "climbed")] == [True, False]
        data = Windows([Source(str(tmp_path))], "train", content=content, **settings)
        assert len(data.packed.length) == 1
