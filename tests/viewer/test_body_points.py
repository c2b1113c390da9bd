"""Contact points on the skin, objects that move with a body, and several motions beside each other."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from boxes import box_mesh
from wearcap.apps.viewer.page import FLESH_M, Page, _spacing_m
from wearcap.apps.viewer.picture import _actors, contact_sheet
from wearcap.apps.viewer.shown import (
    BALL_M,
    BRIGHT,
    DIM,
    _true_body_contact,
    lit_color,
    lit_points,
    poses_at,
    stick_body,
    with_objects,
)
from wearcap.body.anny_body import anny_body
from wearcap.body.contact_points import BODY_POINTS, HAND_POINTS, TOUCH_M, contact_points
from wearcap.cli import render as render_verb
from wearcap.cli.view import main as view
from wearcap.cli.view import read_motions
from wearcap.errors import WearcapError
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.formats.environment import write_environment
from wearcap.io.formats.motion_npz import write_motion
from wearcap.recording import Motion, Recording, RecordingStore
from wearcap.recording.motion import Interactions
from wearcap.scene.objects import Environment, Freedom, SceneObject
from wearcap_testing import swaying_motion

FRAMES = 30


def crate(name: str, size: float = 0.3) -> SceneObject:
    mesh = box_mesh((-size / 2,) * 3, (size / 2,) * 3)
    return SceneObject(name, "box", mesh, torch.eye(3), torch.tensor([3.0, 3.0, 0.2]), Freedom("free"))


HOUSE = Environment((crate("carried"), crate("left alone")))


def carrying(sideways: float = 0.0, motion: Motion | None = None) -> Motion:
    """A body whose left wrist is in the middle of a crate."""
    motion = motion or swaying_motion(FRAMES)
    motion = replace(motion, t_world_root=motion.t_world_root + torch.tensor([0.0, sideways, 0.0]))
    wrist = motion.joint("left_wrist")
    return replace(motion, object_motion={"carried": Trajectory(motion.timestamps, wrist.R, wrist.t)})


def a_recording() -> Recording:
    """The crate is held throughout; the other one stands on the floor."""
    motion = carrying()
    held = Interactions(
        motion.timestamps[:1], motion.timestamps[-1:] + 1.0, torch.tensor([[True, False]]), ("carried",), ("sliding",)
    )
    assert motion.object_motion is not None
    return Recording(
        "walk",
        motion=replace(motion, object_motion=None),
        object_motion=motion.object_motion,
        interactions=held,
        skeleton=motion.skeleton,
        license="MIT",
    )


def touching(motion: Motion, prob: float = 0.9, count: int = 20) -> Motion:
    """The first `count` points in contact with a probability, the others just below the threshold."""
    padded = torch.full((len(motion), BODY_POINTS), 0.49)
    padded[:, :count] = prob
    return replace(motion, body_contact_prob=padded)


@pytest.fixture
def page():
    captures = {f"sample-{k}": touching(carrying(0.1 * k)) for k in range(2)}
    page = Page(a_recording(), captures, port=18070, environment=HOUSE)
    yield page
    page.stop()


@pytest.mark.parametrize("body", [None, stick_body], ids=["surface", "sticks"])
def test_lit_points_are_on_the_skin(body):
    motion = touching(swaying_motion(5))
    skin = anny_body(motion.skeleton) if body is None else body(motion.skeleton)
    balls = lit_points(contact_points(skin), motion, 3)
    centres = balls.vertices.reshape(20, -1, 3).mean(1)
    surface = skin.vertices(motion.T_world_joint[3]).numpy()
    assert np.linalg.norm(centres[:, None] - surface, axis=-1).min(1).max() < 0.01
    assert np.linalg.norm(balls.vertices.reshape(20, -1, 3) - centres[:, None], axis=-1).max() < 1.01 * BALL_M


def test_only_what_is_likelier_than_not_is_lit_and_the_surer_the_brighter():
    motion = touching(swaying_motion(2), count=7)
    points = contact_points(anny_body(motion.skeleton))
    assert len(lit_points(points, motion, 0).vertices) % 7 == 0
    assert lit_points(points, touching(motion, prob=0.5), 0) is None
    assert lit_points(points, swaying_motion(2), 0) is None
    colors = lit_color(torch.tensor([0.5, 0.75, 1.0]))
    np.testing.assert_allclose(colors, [DIM, (DIM + BRIGHT) / 2, BRIGHT])


def test_pictures_light_the_points_instead_of_the_palms():
    motion = replace(swaying_motion(5), hand_contact_prob=torch.ones(5, 2))
    lit = touching(motion, prob=1.0, count=BODY_POINTS)

    def picture(shown: Motion) -> np.ndarray:
        return contact_sheet({"a": shown}, [3], size=(160, 200), body=anny_body(motion.skeleton)).astype(int)

    def yellow(image: np.ndarray) -> int:
        return int(((image[..., 0] > 150) & (image[..., 1] > 120) & (image[..., 2] < 90)).sum())

    def green(image: np.ndarray) -> int:
        return int((image[..., 1] - image[..., 0] > 40).sum())

    assert yellow(picture(lit)) > 40 > 5 > yellow(picture(motion))
    assert green(picture(motion)) > 10 > green(picture(lit))


def test_truth_touches_what_it_holds():
    recording = a_recording()
    truth = with_objects(recording, HOUSE)
    points = contact_points(anny_body(truth.skeleton))
    places = points.vertices(truth.T_world_joint[12])
    T = poses_at(recording.object_motion["carried"], HOUSE.objects[0], truth.timestamps[12:13])[0]
    local = (T.inverse() @ places).abs() - 0.15
    distance = torch.where(
        (local < 0).all(-1), -local.amax(-1), local.clamp_min(0).norm(dim=-1)
    )  # inside a box: to its nearest side
    assert torch.equal(truth.body_contact_prob[12] > 0.5, distance <= TOUCH_M)
    left, right = (slice(first, first + HAND_POINTS) for first in (0, BODY_POINTS // 2))
    assert (truth.body_contact_prob[12] > 0.5)[left].any()
    assert not (truth.body_contact_prob > 0.5)[:, right].any()
    assert with_objects(recording).body_contact_prob is None
    untold = replace(recording, interactions=None, object_motion={})
    assert _true_body_contact(untold, truth, HOUSE) is None
    held = replace(recording.interactions, objects=("left alone",))
    assert not _true_body_contact(replace(recording, interactions=held), truth, HOUSE).any()
    elsewhere = Environment((crate("another"),))
    assert not _true_body_contact(recording, truth, elsewhere).any()


def test_an_object_has_the_pose_of_the_nearest_moment():
    times = torch.arange(5, dtype=torch.float64)
    track = Trajectory(times, torch.eye(3).repeat(5, 1, 1), times.float()[:, None].repeat(1, 3))
    poses = poses_at(track, HOUSE.objects[0], torch.tensor([-9.0, 0.4, 0.6, 3.1, 99.0], dtype=torch.float64))
    assert poses.t[:, 0].tolist() == [0.0, 0.0, 1.0, 3.0, 4.0]
    assert poses_at(None, HOUSE.objects[0], times).t.shape == (5, 3)


def test_the_page_lights_points_on_the_body_that_is_shown(page):
    page.jump(0.2)
    placed = page.bodies["sample-1"]
    handle = placed.points.handle
    lit = np.asarray(handle.batched_scales) > 0
    assert lit.sum() == 20
    shown = np.asarray(handle.batched_positions)[lit] + handle.position - placed.body.offset
    skin = anny_body(placed.body.motion.skeleton).vertices(placed.body.motion.T_world_joint[12]).numpy()
    assert np.linalg.norm(shown[:, None] - skin, axis=-1).min(1).max() < 0.01
    assert page.bodies["truth"].points is not None


def test_objects_go_with_the_motion_that_moves_them(page):
    page.jump(0.2)
    for name, placed in page.bodies.items():
        wrist = placed.body.motion.joint("left_wrist").t[12].double().numpy()
        assert [item.name for item in placed.objects.objects] == ["carried"], name
        np.testing.assert_allclose(
            placed.objects.handles[0].position, wrist + placed.body.offset, atol=1e-5, err_msg=name
        )
    still = page.layers[-1]
    assert [item.name for item in still.objects] == ["left alone"]


def test_motions_beside_each_other_cover_none(page):
    """Surfaces with all that they carry, at every frame."""
    assert page.layout == "beside"
    names = list(page.bodies)
    assert names == ["truth", "sample-0", "sample-1"]
    for frame in range(0, FRAMES, 5):
        lows, highs = [], []
        for name in names:
            placed = page.bodies[name]
            motion, offset = placed.body.motion, placed.body.offset[1]
            skin = anny_body(motion.skeleton).vertices(motion.T_world_joint[frame])[:, 1]
            box = motion.object_motion["carried"].T_world_body[frame] @ torch.from_numpy(HOUSE.objects[0].mesh.vertices)
            y = torch.cat([skin, box[:, 1]]) + offset
            lows.append(float(y.min()))
            highs.append(float(y.max()))
        assert all(low > high for low, high in zip(lows[:-1], highs[1:], strict=True))
    page.arrange("over")
    assert not any(placed.body.offset.any() or placed.label.handle.visible for placed in page.bodies.values())
    page.arrange("sample-1")
    assert [name for name in names if page.bodies[name].objects.handles[0].visible] == ["sample-1"]


def test_wide_motions_stand_further_apart():
    """A drift of 3 m towards the neighbour, on another clock."""
    first, second = carrying(), carrying(3.0)
    late = replace(second, timestamps=second.timestamps + 0.2)
    assert _spacing_m([first, second]) > 3.0 + 2 * FLESH_M
    assert _spacing_m([first, late]) > 3.0
    assert _spacing_m([second, first]) < _spacing_m([first, first]) + 0.1


def test_a_row_of_the_sheet_has_its_own_objects():
    motion = carrying()
    away = replace(motion, object_motion=None)
    first, second = _actors({"a": motion, "b": away}, anny_body(motion.skeleton), HOUSE)
    places = [actor.objects(12)[-2].vertices.mean(0) for actor in (first, second)]
    np.testing.assert_allclose(places[0], motion.joint("left_wrist").t[12], atol=1e-4)
    np.testing.assert_allclose(places[1], [3.0, 3.0, 0.2], atol=1e-4)


def test_verbs_take_several_motions(tmp_path, monkeypatch):
    store = RecordingStore(tmp_path / "data")
    write_environment(HOUSE, tmp_path / "data" / "house")
    store.add(replace(a_recording(), environment="house/environment.json"), split="test", config_hash="x")
    for k in range(2):
        write_motion(touching(carrying(0.1 * k)), tmp_path / f"sample-{k}.npz")
    files = [str(tmp_path / f"sample-{k}.npz") for k in range(2)]
    pages = []
    monkeypatch.setattr(Page, "run", lambda self: pages.append(self))
    view([f"{store.root}/walk", "--motion", *files, "--port", "18075"])
    assert list(pages[0].bodies) == ["truth", "sample-0", "sample-1"]
    render_verb.main(
        [
            f"{store.root}/walk",
            "--motion",
            files[0],
            "--motion",
            files[1],
            "--frames",
            "2",
            "--size",
            "60x80",
            "--out",
            str(tmp_path / "s.png"),
        ]
    )
    assert Image.open(tmp_path / "s.png").size == (120, 240)


def test_motions_have_names_of_their_own(tmp_path):
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        write_motion(swaying_motion(3), tmp_path / folder / "motion.npz")
    files = [str(tmp_path / folder / "motion.npz") for folder in ("a", "b")]
    assert list(read_motions(files)) == ["a motion", "b motion"]
    assert list(read_motions(files[:1])) == ["capture"]
    assert read_motions([]) == {}
    with pytest.raises(WearcapError, match="given twice"):
        read_motions([files[0], files[0]])
