"""Windows of three points, body, object and contacts: functions of their seed, and mirrored consistently."""

from dataclasses import replace

import pytest
import torch
from torch.utils.data import DataLoader

from carried_box import WINDOW, boxes, carried_dataset, carrying, scene_object, small_features
from wearcap.body.anny_body import anny_body
from wearcap.body.contact_points import BODY_POINTS, contact_points
from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import FOOT_PATCHES, xsens23
from wearcap.data.transforms import Cut, Draws, EarlyEnd, Mirror, Shift, mirrored
from wearcap.data.windows import Source, Windows, collate
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import about_axis, geodesic, yaw_of
from wearcap.systems.echo.features import POINTS
from wearcap.systems.echo.observations import ObjectReader, ObjectShape
from wearcap.systems.echo.scores import body_contact
from wearcap.systems.echo.training_windows import ASKEW_DEG, EchoContent, EchoTrack
from wearcap_testing import small_dataset

SKELETON = xsens23()
TWO = (("box_1", "left", 0.0, 0.5), ("box_2", "right", 0.9, 1.5))


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return carried_dataset(tmp_path_factory.mktemp("carried"))


@pytest.fixture(scope="module")
def people(tmp_path_factory):
    """At 60 Hz, without objects."""
    return str(small_dataset(tmp_path_factory.mktemp("people"), (200,) * 6).root)


def dataset(*roots: str, fps: float = 30.0, objects: bool = True, **transforms) -> Windows:
    content = EchoContent(small_features(fps=fps), None, objects=objects)
    settings = {"window": WINDOW, "stride": 4, "fps": fps, "every": None, "transforms": transforms}
    return Windows([Source(root) for root in roots], "train", True, content=content, **settings)


def mirror_images(root: str) -> Windows:
    return dataset(root, mirror=lambda window, _: mirrored(window))


def track_of(recording, environment=None, every: int = 1):
    return EchoTrack.read(recording, environment, ObjectReader(small_features(), None), every, 0.05)


def test_a_window_is_what_the_recording_was(root):
    windows, recording = dataset(root), carrying(2.0)
    window, start = windows[3], int(windows.starts[3, 1])
    truth = recording.motion.sliced(start, start + WINDOW)
    assert torch.equal(window.R_parent_joint, truth.R_parent_joint)
    at = truth.T_world_joint[:, SKELETON.indices(*POINTS)]
    torch.testing.assert_close(window.t_world_point, at.t, atol=1e-5, rtol=0)
    torch.testing.assert_close(window.R_world_point, at.R, atol=1e-5, rtol=0)
    shape = windows.track(0).objects[0]
    box = shape.centred(recording.object_motion["box_1"].T_world_body[start : start + WINDOW])
    torch.testing.assert_close(window.t_world_object, box.t, atol=1e-5, rtol=0)
    contacts = recording.contacts.contact[start : start + WINDOW].float()
    assert torch.equal(window.contact[:, BODY_POINTS:], contacts)
    assert window.has_object.all()
    assert window.valid.all()
    assert window.contact[:, :BODY_POINTS].any()


def test_a_mirror_seen_twice_shows_what_was_there(root):
    twice = dataset(root, mirror=lambda window, _: mirrored(mirrored(window)))
    for part, back in zip(dataset(root)[0], twice[0]):
        torch.testing.assert_close(part, back, atol=1e-6, rtol=0)


def test_in_a_mirror_the_points_are_still_those_of_the_body(root):
    window = mirror_images(root)[2]
    body = forward_kinematics(SKELETON, *window.body, window.t_parent_joint[None])
    at = body[:, SKELETON.indices(*POINTS)]
    torch.testing.assert_close(at.R, window.R_world_point, atol=1e-4, rtol=0)
    torch.testing.assert_close(at.t, window.t_world_point, atol=1e-4, rtol=0)


def mirrored_shape(shape: ObjectShape) -> ObjectShape:
    """The object whose mesh is the mirror image."""
    vertices = (shape.mesh.vertices * [1, -1, 1]).astype("float32")
    mesh = replace(shape.mesh, vertices=vertices, faces=shape.mesh.faces[:, ::-1].copy())
    return ObjectReader(small_features(), None)(scene_object(shape.name, shape.category, mesh))


def test_contacts_in_a_mirror_are_those_of_the_mirrored_geometry(root):
    windows = dataset(root)
    shape = mirrored_shape(windows.track(0).objects[0])
    surface, images = contact_points(anny_body(SKELETON)), mirror_images(root)
    same = total = touching = 0
    for k in range(len(windows)):
        window = images[k]
        body = forward_kinematics(SKELETON, *window.body, window.t_parent_joint[None])
        touches = body_contact(surface.vertices(body), shape, window.T_world_object, 0.05)
        labels = window.contact[:, :BODY_POINTS] > 0
        same, total, touching = same + (touches == labels).sum(), total + labels.numel(), touching + labels.sum()
        assert (touches != labels).any(1).sum() <= WINDOW
    assert touching > 200
    assert (total - same) < 0.15 * touching, "twins are mirror images to within some millimetres"


def test_the_mirrored_box_is_where_the_mirrored_window_has_it(root):
    """Points of the object's surface, through the mirror: moments, code and pose belong together."""
    windows = dataset(root)
    plain = windows[1]
    flipped = mirror_images(root)[1]
    shape = windows.track(0).objects[0]
    flip = torch.tensor([1.0, -1.0, 1.0])
    world = (plain.T_world_object[:, None] @ shape.cloud) * flip
    torch.testing.assert_close(flipped.T_world_object[:, None] @ (shape.cloud * flip), world, atol=1e-5, rtol=0)
    mirrored = shape.cloud * flip
    torch.testing.assert_close(flipped.object_mean[0], mirrored.mean(0), atol=1e-6, rtol=0)
    torch.testing.assert_close(flipped.object_spread[0], mirrored.T @ mirrored / len(mirrored), atol=1e-5, rtol=0)


def test_windows_are_functions_of_their_seed(root):
    windows = dataset(root, shift=Shift(), mirror=Mirror(), ending=EarlyEnd(0.5, 6))
    for one, two in zip(windows[(1, 7)], windows[(1, 7)]):
        assert torch.equal(one, two)
    assert not torch.equal(windows[(1, 7)].noise, windows[(1, 8)].noise)
    assert len({window.t_world_root[0, 1].item() for window in (windows[(1, k)] for k in range(12))}) > 3
    plain = dataset(root)
    assert torch.equal(plain[(1, 7)].t_world_root, plain[(1, 8)].t_world_root)


def test_a_mirrored_windows_code_is_the_mirror_images(root):
    windows = dataset(root, mirror=Mirror())
    shape = windows.track(0).objects[0]
    object.__setattr__(shape, "code_mirrored", shape.code + 5.0)
    codes = {windows[(0, k)].object_code[0, 0].item() for k in range(12)}
    assert codes == {shape.code[0].item(), shape.code[0].item() + 5.0}


def test_what_ends_before_it_is_full_is_padded(root):
    windows = dataset(root, ending=EarlyEnd(1.0, 6))
    for k in range(8):
        window = windows[(0, k)]
        count = int(window.valid.sum())
        assert window.valid[:count].all()
        assert 6 <= count <= WINDOW
        assert (window.t_world_root[count:] == window.t_world_root[count - 1]).all()


def test_recordings_without_objects_are_of_humans_alone(people):
    windows = dataset(people)
    batch = collate([windows[(k, k)] for k in range(4)])
    assert not batch.has_object.any()
    assert not batch.contact[..., :BODY_POINTS].any()
    assert (batch.object_code == 0).all()


def test_objects_can_be_left_out(root):
    assert not dataset(root, objects=False)[0].has_object.any()


def test_data_sets_of_several_rates_stand_side_by_side(root, people):
    windows = dataset(root, people)
    assert {every for *_, every in windows.recordings} == {1, 2}
    last = windows[len(windows) - 1]
    store, name, every = windows.recordings[-1]
    motion, start = store.load(name).motion, int(windows.starts[-1, 1]) // every
    assert torch.equal(last.t_world_root, motion.t_world_root[::every][start : start + WINDOW])


def test_poses_are_the_recordings_or_the_environments():
    """An object whose trajectory is missing stays at its pose in the environment."""
    recording = carrying(2.0, carried=TWO)
    moved = {"box_1": recording.object_motion["box_1"]}
    track = track_of(replace(recording, object_motion=moved), boxes(TWO))
    for number, shape in enumerate(track.objects):
        rows = (track.active == number).nonzero()[:, 0]
        expected = shape.middle.expand(len(rows), 3)
        if number == 0:
            expected = moved["box_1"].T_world_body[rows] @ shape.middle
        assert len(rows)
        torch.testing.assert_close(track.T_world_object.t[rows], expected)


def test_an_object_may_change_within_a_window():
    recording = carrying(2.0, carried=TWO)
    track = track_of(recording, boxes(TWO))
    change = int((track.active == 1).nonzero()[0])
    assert (track.active[change - 1 : change + 1] == torch.tensor([0, 1])).all()
    content, cut = EchoContent(small_features(), None), Cut(change - 5, WINDOW, len(track.floor_height))
    window = content.item(track, cut, content.read(track, cut, Draws(0)), Draws(0))
    first, second = track.objects
    for k, shape in ((4, first), (5, second)):
        assert torch.equal(window.object_code[k], shape.code)
        torch.testing.assert_close(window.object_mean[k], sum(shape.cloud) / len(shape.cloud))
        outer = sum(torch.outer(point, point) for point in shape.cloud) / len(shape.cloud)
        torch.testing.assert_close(window.object_spread[k], outer, atol=1e-5, rtol=1e-4)
        truth = shape.centred(recording.object_motion[shape.name].T_world_body[change - 5 + k : change - 4 + k])
        torch.testing.assert_close(window.t_world_object[k], truth.t[0], atol=1e-5, rtol=0)
    assert not torch.equal(window.object_spread[4], window.object_spread[5])


def test_a_track_without_an_active_object_has_index_minus_one():
    recording = carrying(4.0, carried=(("box_1", "left", 3.5, 3.8),))
    track = track_of(recording, boxes())
    assert (track.active[:40] == -1).all()
    assert not track.contact[:40, :BODY_POINTS].any()
    assert torch.equal(track.T_world_object.R[:40], torch.eye(3).expand(40, 3, 3))
    assert (track.active[-15:] == 0).all()


@pytest.mark.parametrize("fps", [45.0, 25.0, 120.0])
def test_rates_that_are_no_multiple_are_refused(tmp_path, fps):
    root = small_dataset(tmp_path).root
    with pytest.raises(WearcapError, match="recordings of 60 frames per second. Expected one rate that is a whole"):
        dataset(str(root), fps=fps)


def test_recordings_without_foot_contacts_are_refused():
    with pytest.raises(WearcapError, match=f"carry: no foot contacts.*Expected contacts of {FOOT_PATCHES[0]}"):
        track_of(replace(carrying(0.5), contacts=None))


def test_windows_travel_to_other_processes(root):
    """Workers are forkserver's."""
    windows = dataset(root)
    loader = DataLoader(windows, num_workers=1, multiprocessing_context="forkserver", collate_fn=list)
    assert torch.equal(next(iter(loader))[0].t_world_root, windows[0].t_world_root)


def test_the_measured_head_is_the_condition_and_not_the_true_one():
    recording = carrying(0.5)
    head = replace(recording.head, t_world_device=recording.head.t_world_device + 0.1)
    track = track_of(replace(recording, head=head))
    true = recording.motion.joint("head").t
    torch.testing.assert_close(track.points.t_world_point[:, 0], true + 0.1, atol=1e-4, rtol=0)
    short = replace(
        head,
        timestamps=head.timestamps[:3],
        R_world_device=head.R_world_device[:3],
        t_world_device=head.t_world_device[:3],
    )
    track = track_of(replace(recording, head=short))
    torch.testing.assert_close(track.points.t_world_point[:, 0], true, atol=1e-4, rtol=0)


def test_poses_in_a_window_are_rigid(root):
    window = collate([dataset(root)[0]])
    assert isinstance(window.T_world_object, Rigid)
    turned = window.R_world_object.mT @ window.R_world_object
    torch.testing.assert_close(turned, torch.eye(3).expand_as(turned), atol=1e-5, rtol=0)


def test_canonical_poses_look_the_same_whichever_side_was_up(root):
    """The surface is where it was, and windows of the box turned by half a turn in its own axes ask for the same pose."""
    recording, shape = carrying(2.0), dataset(root).track(0).objects[0]
    track = track_of(recording, boxes())
    for T in track.T_world_canonical:
        error = shape.symmetry.vertex_error_cm(
            shape.of_mesh(T), shape.of_mesh(track.T_world_object), shape.cloud + shape.middle
        )
        assert error.max() < 0.5
    half = Rigid(torch.diag(torch.tensor([-1.0, -1.0, 1.0])), torch.zeros(3))
    about = Rigid(torch.eye(3), shape.middle) @ half @ Rigid(torch.eye(3), -shape.middle)
    poses = recording.object_motion["box_1"]
    T = poses.T_world_body @ about
    turned = replace(recording, object_motion={"box_1": replace(poses, R_world_body=T.R, t_world_body=T.t)})
    for one, other in zip(track.T_world_canonical, track_of(turned, boxes()).T_world_canonical):
        torch.testing.assert_close(one.R, other.R, atol=1e-3, rtol=0)
        torch.testing.assert_close(one.t, other.t, atol=1e-3, rtol=0)


def test_in_a_mirror_the_canonical_pose_is_that_of_the_mirrored_recording(root):
    """What a mirrored window asks for is near the heading turned to the same side as in windows as they are."""
    plain, images = dataset(root), mirror_images(root)
    shape = mirrored_shape(plain.track(0).objects[0])
    touched = int((plain.track(0).contact[:, :BODY_POINTS] > 0).any(1).float().argmax())
    for k in range(4):
        window = images[k]
        first = touched - int(plain.starts[k, 1])
        if not 0 <= first < WINDOW:
            continue
        heading = yaw_of(window.R_world_point[first, 0]) + torch.tensor(ASKEW_DEG).deg2rad()
        alike = shape.symmetry.alike(
            Rigid(window.R_world_object[first], window.t_world_object[first]), about_axis("z", heading)
        )
        away = geodesic(alike.R, about_axis("z", heading).double().expand_as(alike.R))
        mine = geodesic(window.R_world_canonical[first], about_axis("z", heading))
        assert mine.item() == pytest.approx(away.min().item(), abs=0.02)
        return
    pytest.fail("no window in which the box is touched first")


def test_without_canonical_poses_the_true_ones_are_asked_for(root):
    content = EchoContent(small_features(), None, canonical=False)
    window = Windows([Source(root)], "train", content=content, window=WINDOW, stride=4, fps=30.0, every=None)[1]
    assert torch.equal(window.R_world_canonical, window.R_world_object)
    assert torch.equal(window.t_world_canonical, window.t_world_object)
