"""Windows of three points, body, object and contacts: functions of their seed, and mirrored consistently."""

from dataclasses import replace

import pytest
import torch

from carried_box import WINDOW, boxes, carried_dataset, carrying, scene_object, small_features
from wearcap.body.anny_body import anny_body
from wearcap.body.contact_points import BODY_POINTS, contact_points
from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import FOOT_PATCHES, xsens23
from wearcap.data.transforms import EarlyEnd, Mirror, Shift, TimeStretch
from wearcap.data.windows import Source, Windows
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import about_axis, geodesic, yaw_of
from wearcap.recording import RecordingStore
from wearcap.systems.echo.features import POINTS
from wearcap.systems.echo.observations import ObjectReader, ObjectShape
from wearcap.systems.echo.scores import body_contact
from wearcap.systems.echo.training_windows import ASKEW_DEG, CANONICAL, EchoContent, echo_track, found_objects
from wearcap_testing import AlwaysMirrored, seeded, small_dataset, window_of

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
    return dataset(root, mirror=AlwaysMirrored())


def track_of(recording, environment=None, every: int = 1):
    return echo_track(recording, environment, ObjectReader(small_features(), None), every, 0.05).values


def posed(values, name: str = "object") -> Rigid:
    return Rigid(values[f"R_world_{name}"], values[f"t_world_{name}"])


def shapes_of(recording, environment) -> list[ObjectShape]:
    reader, take = ObjectReader(small_features(), None), torch.arange(len(recording.motion))
    return found_objects(recording, environment, reader, take, 0.05).shapes


@pytest.fixture(scope="module")
def shape() -> ObjectShape:
    return shapes_of(carrying(2.0), boxes())[0]


def test_a_window_is_what_the_recording_was(root, shape):
    windows, recording = dataset(root), carrying(2.0)
    window, start = window_of(windows, 3), int(windows.starts[3, 1])
    truth = recording.motion.sliced(start, start + WINDOW)
    torch.testing.assert_close(window.R_parent_joint, truth.R_parent_joint, atol=1e-4, rtol=0)
    at = truth.T_world_joint[:, SKELETON.indices(*POINTS)]
    torch.testing.assert_close(window.t_world_point, at.t, atol=1e-5, rtol=0)
    torch.testing.assert_close(window.R_world_point, at.R, atol=1e-4, rtol=0)
    box = shape.centred(recording.object_motion["box_1"].T_world_body[start : start + WINDOW])
    torch.testing.assert_close(window.t_world_object, box.t, atol=1e-5, rtol=0)
    contacts = recording.contacts.contact[start : start + WINDOW].float()
    assert torch.equal(window.contact[:, BODY_POINTS:], contacts)
    assert window.has_object.all()
    assert window.valid.all()
    assert window.contact[:, :BODY_POINTS].any()


def test_in_a_mirror_the_points_are_still_those_of_the_body(root):
    window = window_of(mirror_images(root), 2)
    body = forward_kinematics(SKELETON, *window.body, window.t_parent_joint[None])
    at = body[:, SKELETON.indices(*POINTS)]
    torch.testing.assert_close(at.R, window.R_world_point, atol=1e-4, rtol=0)
    torch.testing.assert_close(at.t, window.t_world_point, atol=1e-4, rtol=0)


def mirrored_shape(shape: ObjectShape) -> ObjectShape:
    """The object whose mesh is the mirror image."""
    vertices = (shape.mesh.vertices * [1, -1, 1]).astype("float32")
    mesh = replace(shape.mesh, vertices=vertices, faces=shape.mesh.faces[:, ::-1].copy())
    return ObjectReader(small_features(), None)(scene_object(shape.name, shape.category, mesh))


def test_contacts_in_a_mirror_are_those_of_the_mirrored_geometry(root, shape):
    windows = dataset(root)
    shape = mirrored_shape(shape)
    surface, images = contact_points(anny_body(SKELETON)), mirror_images(root)
    same = total = touching = 0
    for k in range(len(windows)):
        window = window_of(images, k)
        body = forward_kinematics(SKELETON, *window.body, window.t_parent_joint[None])
        touches = body_contact(surface.vertices(body), shape, window.T_world_object, 0.05)
        labels = window.contact[:, :BODY_POINTS] > 0
        same, total, touching = same + (touches == labels).sum(), total + labels.numel(), touching + labels.sum()
        assert (touches != labels).any(1).sum() <= WINDOW
    assert touching > 200
    assert (total - same) < 0.15 * touching, "twins are mirror images to within some millimetres"


def test_the_mirrored_box_is_where_the_mirrored_window_has_it(root, shape):
    """Points of the object's surface, through the mirror: moments, code and pose belong together."""
    plain, flipped = window_of(dataset(root), 1), window_of(mirror_images(root), 1)
    flip = torch.tensor([1.0, -1.0, 1.0])
    world = (plain.T_world_object[:, None] @ shape.cloud) * flip
    torch.testing.assert_close(flipped.T_world_object[:, None] @ (shape.cloud * flip), world, atol=1e-4, rtol=0)
    mirrored = shape.cloud * flip
    torch.testing.assert_close(flipped.object_mean[0], mirrored.mean(0), atol=1e-6, rtol=0)
    torch.testing.assert_close(flipped.object_spread[0], mirrored.T @ mirrored / len(mirrored), atol=1e-5, rtol=0)


def test_windows_are_functions_of_their_seed(root):
    windows = dataset(root, shift=Shift(), mirror=Mirror(), ending=EarlyEnd(0.5, 6))
    for one, two in zip(window_of(windows, 1, 7), seeded(windows, 1, 9)):
        assert torch.equal(one, two[7])
    several = seeded(windows, 1, 12)
    assert not torch.equal(several.noise[7], several.noise[8])
    assert len({*several.t_world_root[:, 0, 1].tolist()}) > 3
    plain = seeded(dataset(root), 1, 9)
    assert torch.equal(plain.t_world_root[7], plain.t_world_root[8])


def test_a_mirrored_windows_code_is_the_mirror_images(root, shape):
    for windows, code in ((dataset(root), shape.code), (mirror_images(root), shape.code_mirrored)):
        assert torch.equal(window_of(windows).object_code[0], code)


def test_what_ends_before_it_is_full_is_padded(root):
    windows = dataset(root, ending=EarlyEnd(1.0, 6))
    for k in range(8):
        window = window_of(windows, 0, k)
        count = int(window.valid.sum())
        assert window.valid[:count].all()
        assert 6 <= count <= WINDOW
        assert (window.t_world_root[count:] == window.t_world_root[count - 1]).all()


def test_recordings_without_objects_are_of_humans_alone(people):
    windows = dataset(people)
    batch = windows.batch(torch.arange(4), torch.arange(4))
    assert not batch.has_object.any()
    assert not batch.contact[..., :BODY_POINTS].any()
    assert (batch.object_code == 0).all()


def test_objects_can_be_left_out(root):
    assert not window_of(dataset(root, objects=False)).has_object.any()


def test_data_sets_of_several_rates_stand_side_by_side(root, people):
    windows = dataset(root, people)
    last, start = window_of(windows, len(windows) - 1), int(windows.starts[-1, 1])
    motions = [RecordingStore(people).load(name).motion for name in RecordingStore(people).names("train")]
    seen = [motion.t_world_root[::2][start : start + WINDOW] for motion in motions]
    assert any(torch.equal(last.t_world_root, each) for each in seen)


def test_poses_are_the_recordings_or_the_environments():
    """An object whose trajectory is missing stays at its pose in the environment."""
    recording = carrying(2.0, carried=TWO)
    moved = {"box_1": recording.object_motion["box_1"]}
    recording = replace(recording, object_motion=moved)
    track = track_of(recording, boxes(TWO))
    for number, shape in enumerate(shapes_of(recording, boxes(TWO))):
        rows = (track["object"] == number).nonzero()[:, 0]
        expected = shape.middle.expand(len(rows), 3)
        if number == 0:
            expected = moved["box_1"].T_world_body[rows] @ shape.middle
        assert len(rows)
        torch.testing.assert_close(track["t_world_object"][rows], expected)


def test_an_object_may_change_within_a_window(tmp_path):
    recording = carrying(2.0, carried=TWO)
    windows = dataset(carried_dataset(tmp_path, carried=TWO), stretch=TimeStretch(1.0))
    shapes = shapes_of(recording, boxes(TWO))
    change = int((track_of(recording, boxes(TWO))["object"] == 1).nonzero()[0])
    index = next(k for k, start in enumerate(windows.starts[:, 1]) if 0 < change - start < WINDOW - 1)
    window, start = window_of(windows, index), int(windows.starts[index, 1])
    for frame, shape in ((change - 1, shapes[0]), (change, shapes[1])):
        k = frame - start
        assert torch.equal(window.object_code[k], shape.code)
        torch.testing.assert_close(window.object_mean[k], sum(shape.cloud) / len(shape.cloud))
        outer = sum(torch.outer(point, point) for point in shape.cloud) / len(shape.cloud)
        torch.testing.assert_close(window.object_spread[k], outer, atol=1e-5, rtol=1e-4)
        truth = shape.centred(recording.object_motion[shape.name].T_world_body[frame : frame + 1])
        torch.testing.assert_close(window.t_world_object[k], truth.t[0], atol=1e-5, rtol=0)


def test_a_track_without_an_active_object_has_index_minus_one():
    recording = carrying(4.0, carried=(("box_1", "left", 3.5, 3.8),))
    track = track_of(recording, boxes())
    assert (track["object"][:40] == -1).all()
    assert not track["contact"][:40, :BODY_POINTS].any()
    assert torch.equal(track["R_world_object"][:40], torch.eye(3).expand(40, 3, 3))
    assert (track["object"][-15:] == 0).all()


@pytest.mark.parametrize("fps", [45.0, 25.0, 120.0])
def test_rates_that_are_no_multiple_are_refused(tmp_path, fps):
    root = small_dataset(tmp_path).root
    with pytest.raises(WearcapError, match="recordings of 60 frames per second. Expected one rate that is a whole"):
        dataset(str(root), fps=fps)


def test_recordings_without_foot_contacts_are_refused():
    with pytest.raises(WearcapError, match=f"carry: no foot contacts.*Expected contacts of {FOOT_PATCHES[0]}"):
        track_of(replace(carrying(0.5), contacts=None))


def test_the_measured_head_is_the_condition_and_not_the_true_one():
    recording = carrying(0.5)
    head = replace(recording.head, t_world_device=recording.head.t_world_device + 0.1)
    track = track_of(replace(recording, head=head))
    true = recording.motion.joint("head").t
    torch.testing.assert_close(track["t_world_point"].sum(2)[:, 0], true + 0.1, atol=1e-4, rtol=0)
    short = replace(
        head,
        timestamps=head.timestamps[:3],
        R_world_device=head.R_world_device[:3],
        t_world_device=head.t_world_device[:3],
    )
    track = track_of(replace(recording, head=short))
    torch.testing.assert_close(track["t_world_point"].sum(2)[:, 0], true, atol=1e-4, rtol=0)


def test_poses_in_a_window_are_rigid(root):
    window = seeded(dataset(root), 0, 1)
    assert isinstance(window.T_world_object, Rigid)
    turned = window.R_world_object.mT @ window.R_world_object
    torch.testing.assert_close(turned, torch.eye(3).expand_as(turned), atol=1e-5, rtol=0)


def test_canonical_poses_look_the_same_whichever_side_was_up(shape):
    """The surface is where it was, and windows of the box turned by half a turn in its own axes ask for the same pose."""
    recording = carrying(2.0)
    track = track_of(recording, boxes())
    for name in CANONICAL:
        error = shape.symmetry.vertex_error_cm(
            shape.of_mesh(posed(track, name)), shape.of_mesh(posed(track)), shape.cloud + shape.middle
        )
        assert error.max() < 0.5
    half = Rigid(torch.diag(torch.tensor([-1.0, -1.0, 1.0])), torch.zeros(3))
    about = Rigid(torch.eye(3), shape.middle) @ half @ Rigid(torch.eye(3), -shape.middle)
    poses = recording.object_motion["box_1"]
    T = poses.T_world_body @ about
    turned = replace(recording, object_motion={"box_1": replace(poses, R_world_body=T.R, t_world_body=T.t)})
    other_track = track_of(turned, boxes())
    for one, other in ((posed(track, name), posed(other_track, name)) for name in CANONICAL):
        torch.testing.assert_close(one.R, other.R, atol=1e-3, rtol=0)
        torch.testing.assert_close(one.t, other.t, atol=1e-3, rtol=0)


def test_in_a_mirror_the_canonical_pose_is_that_of_the_mirrored_recording(root, shape):
    """What a mirrored window asks for is near the heading turned to the same side as in windows as they are."""
    plain, images = dataset(root), mirror_images(root)
    shape = mirrored_shape(shape)
    touched = int(track_of(carrying(2.0), boxes())["contact"][:, :BODY_POINTS].any(1).float().argmax())
    for k in range(4):
        window = window_of(images, k)
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
    windows = Windows([Source(root)], "train", content=content, window=WINDOW, stride=4, fps=30.0, every=None)
    window = window_of(windows, 1)
    assert torch.equal(window.R_world_canonical, window.R_world_object)
    assert torch.equal(window.t_world_canonical, window.t_world_object)
