"""Invalid input of ECHO: each fault has its own message with the place and the expected value."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

from carried_box import MIDDLE, box_mesh, boxes, carrying, drawn_echo, scenario_of, scene_object
from wearcap.body.skeleton import WRISTS
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.mesh import Mesh
from wearcap.geometry.trajectory import Trajectory
from wearcap.recording.active_objects import ActiveSpan
from wearcap.scene.objects import Environment
from wearcap.systems.echo.features import CONTACTS
from wearcap.systems.echo.observations import Observed, batch_item_of, wrist_poses
from wearcap.tracking.head_path import head_path

RECORDING = carrying(1.0)
TIMES = RECORDING.motion.timestamps


def conditioning(scenario):
    echo = drawn_echo()
    return batch_item_of(
        scenario, head_path(scenario.recording, echo.model.skeleton, echo.fps), echo.reader()
    ).conditioning


def with_mesh(vertices=None, faces=None, category: str = "box"):
    mesh = box_mesh()
    given = Mesh(
        mesh.vertices if vertices is None else vertices.astype(np.float32),
        mesh.faces if faces is None else faces,
        mesh.color,
    )
    return replace(scenario_of(RECORDING), environment=Environment((scene_object("box_1", category, given),)))


def spoiled() -> np.ndarray:
    vertices = box_mesh().vertices.copy()
    vertices[3] = np.nan
    return vertices


def tracked(**changes):
    """Wrists from controllers, some of them changed."""
    tracks = {}
    for joint in ("left_wrist", "right_wrist"):
        T = RECORDING.motion.joint(joint)
        tracks[joint] = Trajectory(TIMES, T.R, T.t)
    return scenario_of(replace(RECORDING, tracked=tracks | changes))


def track(take=slice(None), shift: float = 0.0, broken: bool = False) -> Trajectory:
    T = RECORDING.motion.joint("left_wrist")[take]
    t = torch.where(torch.arange(len(T.t))[:, None] == 7, torch.nan, T.t) if broken else T.t
    return Trajectory(TIMES[take] + shift, T.R, t)


def swapped():
    scenario = tracked()
    left, right = (scenario.recording.tracked[joint] for joint in ("left_wrist", "right_wrist"))
    return tracked(left_wrist=right, right_wrist=left)


def observing(**seen):
    return scenario_of(RECORDING, observed=Observed(**seen))


def late_motion():
    return replace(RECORDING.motion, timestamps=TIMES + 1.0)


def broken_motion():
    return replace(RECORDING.motion, t_world_root=torch.full_like(RECORDING.motion.t_world_root, torch.nan))


BOX = RECORDING.object_motion["box_1"]
FAULTS = {
    "a mesh in millimetres": (
        lambda: with_mesh(box_mesh().vertices * 1000),
        "object 'box_1' of carry: .*looks like millimetres",
    ),
    "a mesh that is not centred": (
        lambda: with_mesh(box_mesh().vertices + 3),
        "object 'box_1' of carry: .*not centred",
    ),
    "a mesh with NaN": (lambda: with_mesh(spoiled()), "object 'box_1' of carry: 1 vertices .* NaN"),
    "a mesh without faces": (
        lambda: with_mesh(faces=np.zeros((0, 3), np.int32)),
        "object 'box_1' of carry: .*no faces",
    ),
    "an unknown class": (
        lambda: with_mesh(category="piano"),
        "object 'box_1' of carry: .*no object class 'piano'. Expected one of box, chair",
    ),
    "a span of an unknown object": (
        lambda: replace(scenario_of(RECORDING), active_objects=(ActiveSpan("ghost", 0.0, 1.0),)),
        "object 'ghost' of carry: no object 'ghost'. Expected one of box_1",
    ),
    "spans, but no objects": (
        lambda: replace(scenario_of(RECORDING), environment=None),
        "carry: spans of 'box_1', but no objects",
    ),
    "wrists swapped": (swapped, "carry: the left wrist is .* cm to the right of the right one.*Swap the two trackers"),
    "no wrists": (
        lambda: scenario_of(replace(RECORDING, motion=None)),
        "carry: this recording has no tracked wrists.*Expected `tracked` poses of left_wrist and",
    ),
    "one wrist": (
        lambda: scenario_of(replace(RECORDING, tracked={"left_wrist": track()})),
        "carry: only left_wrist is tracked. Expected `tracked` poses of left_wrist and",
    ),
    "wrists with NaN": (lambda: tracked(left_wrist=track(broken=True)), "carry: poses of wrists that are NaN"),
    "a wrist for a part of the time": (
        lambda: tracked(left_wrist=track(slice(0, 10))),
        "carry: tracking of left_wrist from 0.00 to 0.30 s. Expected all of 0.00 to 0.97 s",
    ),
    "a wrist of another clock": (lambda: tracked(left_wrist=track(shift=60.0)), "tracking of left_wrist from 60.00"),
    "a wrist at a single time": (lambda: tracked(left_wrist=track(slice(0, 1))), "tracking of left_wrist at 1 times"),
    "a wrist whose times fall": (
        lambda: tracked(left_wrist=track(torch.arange(30).flip(0))),
        "30 times that do not increase",
    ),
    "a body observed too late": (
        lambda: observing(motion=late_motion()),
        "carry: an observation at 1.* beyond the recording.*Expected times from 0.00 to 0.97",
    ),
    "an object observed too late": (
        lambda: observing(object_motion={"box_1": replace(BOX, timestamps=BOX.timestamps + 2.0)}),
        "carry: an observation at 2.* s, beyond",
    ),
    "contacts observed too early": (
        lambda: observing(contact_times=torch.tensor([-3.0]).double(), contact=torch.zeros(1, CONTACTS)),
        "carry: an observation at -3.00 s",
    ),
    "observed at no time": (
        lambda: observing(contact_times=torch.tensor([torch.nan]).double(), contact=torch.zeros(1, CONTACTS)),
        "carry: an observation at nan s",
    ),
    "an unknown object observed": (
        lambda: observing(object_motion={"ghost": BOX}),
        "carry: an observed object 'ghost'. Expected one of box_1",
    ),
    "too few contacts": (
        lambda: observing(contact_times=TIMES[:1], contact=torch.zeros(1, 4)),
        "carry: observed contacts of 4 points. Expected 64 of the body",
    ),
    "an observed body with NaN": (lambda: observing(motion=broken_motion()), "carry: observations that are NaN"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_named(fault):
    make, message = FAULTS[fault]
    with pytest.raises(WearcapError, match=message) as caught:
        conditioning(make())
    assert caught.value.expected
    assert str(copy.copy(caught.value)) == str(caught.value)


def test_a_lost_wrist_keeps_its_last_pose():
    """Short gaps are interpolated; in long gaps and after the end the last pose is kept."""
    times = torch.tensor([0.0, 0.2, 0.6, 1.4, 1.5], dtype=torch.float64)
    place = torch.stack([times.float(), torch.zeros(5), torch.zeros(5)], 1)
    at = torch.tensor([-1.0, 0.1, 0.2, 0.4, 0.6, 0.61, 1.39, 1.4, 1.45, 1.5, 9.0], dtype=torch.float64)
    found = wrist_poses(Trajectory(times, torch.eye(3).repeat(5, 1, 1), place), at).t[:, 0]
    expected = [0.0, 0.1, 0.2, 0.4, 0.6, 0.6, 0.6, 1.4, 1.45, 1.5, 1.5]
    torch.testing.assert_close(found, torch.tensor(expected), atol=1e-6, rtol=0)


def test_arms_of_a_true_motion_may_be_crossed():
    motion, R = RECORDING.motion, RECORDING.motion.R_parent_joint.clone()
    across = rotation.exp(torch.tensor([1.2, 0.0, 0.0]))
    for side, turn in (("left", across.mT), ("right", across)):
        joint = motion.skeleton.joint_names.index(f"{side}_shoulder")
        R[:, joint] = R[:, joint] @ turn
    crossed = replace(RECORDING, motion=replace(motion, R_parent_joint=R))
    assert conditioning(scenario_of(crossed)).valid.all()
    tracks = {joint: Trajectory(TIMES, T.R, T.t) for joint in WRISTS for T in [crossed.motion.joint(joint)]}
    with pytest.raises(WearcapError, match="the left wrist is 56 cm to the right"):
        conditioning(scenario_of(replace(crossed, tracked=tracks)))


def test_valid_input_passes():
    assert conditioning(tracked()).valid.all()
    assert conditioning(scenario_of(RECORDING)).has_object.any()


def test_observations_of_inactive_objects_are_ignored():
    scenario = observing(object_motion={"box_1": BOX})
    seen = conditioning(scenario)
    assert torch.equal(seen.is_observed[0, :, 1], seen.has_object[0])


def test_the_floor_is_the_recordings_else_the_paths():
    floor = replace(RECORDING.floor, height=torch.full((30,), 0.2))
    assert (conditioning(scenario_of(replace(RECORDING, floor=floor))).floor_height == 0.2).all()
    without = conditioning(scenario_of(replace(RECORDING, floor=None))).floor_height
    assert without.abs().max() < 0.2


def test_an_object_begins_where_its_environment_has_it():
    spans = (ActiveSpan("box_1", 0.1, 0.3), ActiveSpan("box_1", 0.6, 0.8))
    item = scene_object("box_1")
    turn = rotation.exp(torch.tensor([0.3, -0.2, 0.9]))
    there = Environment((replace(item, R_world_object=turn, t_world_object=torch.tensor([1.0, 2.0, 0.5])),))
    scenario = replace(scenario_of(RECORDING), active_objects=spans, environment=there, placed=True)
    seen = conditioning(scenario)
    assert seen.is_observed[0, :, 1].nonzero()[:, 0].tolist() == [3]
    torch.testing.assert_close(seen.R_world_object[0, 3], turn)
    middle = torch.tensor([1.0, 2.0, 0.5]) + turn @ torch.tensor(MIDDLE, dtype=torch.float32)
    torch.testing.assert_close(seen.t_world_object[0, 3], middle)
    elsewhere = replace(scenario, observed=Observed(object_motion={"box_1": BOX}))
    torch.testing.assert_close(
        conditioning(elsewhere).t_world_object[0, 3],
        conditioning(replace(elsewhere, placed=False)).t_world_object[0, 3],
    )


def test_objects_are_read_once_however_often_they_are_active():
    spans = (ActiveSpan("box_1", 0.0, 0.3), ActiveSpan("box_1", 0.6, 0.8))
    echo, scenario = drawn_echo(), replace(scenario_of(RECORDING), active_objects=spans, environment=boxes())
    batch_item = batch_item_of(scenario, head_path(RECORDING, echo.model.skeleton, echo.fps), echo.reader())
    assert len(batch_item.objects) == 1
    assert batch_item.conditioning.has_object[0].sum() == 9 + 6
