"""The viewer's page: its clock, what it sends, and what a real browser draws of it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from wearcap.apps.viewer.page import CAPTURE_COLOR, Page, _Timeline
from wearcap.apps.viewer.page_layers import AIR_COLOR, CONTACT_COLOR
from wearcap.apps.viewer.shown import nearest_frame, stick_body, surface_or_sticks
from wearcap.body.skeleton import FOOT_PATCHES, Skeleton, xsens23
from wearcap.cli.view import main as view
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.io.formats.motion_npz import write_motion
from wearcap.recording import ContactTrack, HeadStream, Motion, PointCloud, Recording, RecordingStore
from wearcap.recording.store import dataset_folder
from wearcap_browser import chromium


def a_walk(frames: int = 60, sideways: float = 0.0) -> Motion:
    """Legs and arms that swing while the body moves forward at 1 m/s."""
    skeleton = xsens23()
    times = torch.arange(frames, dtype=torch.float64) / 30
    R = torch.eye(3).repeat(frames, len(skeleton), 1, 1)
    swing = 0.5 * torch.sin(6 * times).float()
    for side, sign in (("left", 1.0), ("right", -1.0)):
        R[:, skeleton.index(f"{side}_hip")] = rotation.about_axis("y", sign * swing)
        down = rotation.about_axis("x", torch.tensor(-1.3 * sign))
        R[:, skeleton.index(f"{side}_shoulder")] = rotation.about_axis("y", -sign * swing) @ down
    root = torch.stack([times, sideways + 0 * times, skeleton.root_height + 0 * times], -1).float()
    return Motion(times, skeleton, R, root)


def a_recording(**parts) -> Recording:
    motion = a_walk()
    contact = torch.zeros(60, 4, dtype=torch.bool)
    contact[:30, 0] = True
    head = motion.joint("head")
    return Recording(
        name="walk",
        motion=motion,
        activity="walking",
        head=HeadStream(motion.timestamps, head.R, head.t, torch.eye(3), torch.zeros(3)),
        contacts=ContactTrack(motion.timestamps, FOOT_PATCHES, contact),
        points=PointCloud(torch.rand(500, 3) * 4 - 2),
    )


@pytest.fixture
def page():
    page = Page(a_recording(), {"capture": a_walk(sideways=0.3)}, port=18080)
    yield page
    page.stop()


def test_timeline_plays_loops_and_stays_inside():
    clock = _Timeline(2.0, 5.0, 2.0)
    assert not clock.advance(1.0)
    clock.playing, clock.speed = True, 2.0
    assert clock.advance(1.0)
    assert clock.time == 4.0
    clock.advance(1.0)
    assert clock.time == 2.0
    clock.seek(clock.time - 9.0)
    assert clock.time == 2.0
    clock.seek(99.0)
    assert clock.time == 5.0


def test_nearest_frame():
    times = torch.tensor([0.0, 1.0, 3.0], dtype=torch.float64)
    assert [nearest_frame(times, t) for t in (-5.0, 0.4, 0.6, 1.9, 2.1, 9.0)] == [0, 0, 1, 1, 2, 2]
    assert nearest_frame(times[:1], 7.0) == 0


def test_bones_of_the_page_are_the_motions_joints(page):
    page.timeline.seek(1.0)
    page.show()
    layer = page.bodies["capture"].body
    truth = layer.motion.T_world_joint[30]
    placed = np.stack([bone.position for bone in layer.handle.bones]) + layer.handle.position
    np.testing.assert_allclose(placed, truth.t.numpy(), atol=1e-5)
    turned = torch.tensor(np.stack([bone.wxyz for bone in layer.handle.bones]))
    torch.testing.assert_close(rotation.matrix_from_quat_wxyz(turned).float(), truth.R, atol=1e-5, rtol=0)


def test_feet_are_coloured_by_contact(page):
    feet = page.bodies["truth"].feet
    assert page.bodies["capture"].feet is None
    page.timeline.seek(0.5)
    page.show()
    assert tuple(feet.balls[0].color) == CONTACT_COLOR
    page.timeline.seek(1.5)
    page.show()
    assert tuple(feet.balls[0].color) == AIR_COLOR


def test_balls_are_as_large_as_deviations_and_none_are_where_nothing_is_said(page):
    walk = a_walk(sideways=0.3)
    std = 0.01 + 0.001 * torch.arange(len(walk))[:, None] + 0.002 * torch.arange(len(walk.skeleton))
    sure = Page(a_recording(), {"capture": replace(walk, joint_std=std)}, port=18085)
    sure.timeline.seek(1.0)
    sure.show()
    balls = sure.bodies["capture"].certainty
    np.testing.assert_allclose(balls.handle.batched_scales, std[30].numpy(), rtol=1e-6)
    placed = balls.handle.batched_positions + balls.handle.position
    np.testing.assert_allclose(placed, walk.T_world_joint.t[30].numpy(), atol=1e-5)
    assert sure.bodies["truth"].certainty is None
    assert page.bodies["capture"].certainty is None
    sure.stop()


def test_layouts_and_keys(page):
    page.arrange("beside")
    truth, capture = (page.bodies[name].body.handle for name in ("truth", "capture"))
    assert truth.position[1] - capture.position[1] == pytest.approx(page.aside_m - 0.3, abs=1e-6)
    page.arrange("capture")
    assert capture.visible
    assert not truth.visible
    with pytest.raises(WearcapError, match="over, beside"):
        page.arrange("inside")
    page.jump(1.0)
    assert page.timeline.time == pytest.approx(1.0)
    page.toggle()
    page.run(0.4)
    assert 1.2 < page.timeline.time < 2.0


def test_a_frame_is_cheap_to_send(page):
    """Poses, not vertices: what the server queues for a frame stays below 100 short messages."""
    queued = []
    original = page.server.scene._queue_scene_message
    page.server.scene._queue_scene_message = lambda message: (queued.append(message), original(message))[1]
    page.timeline.seek(0.7)
    page.show()
    assert 46 < len(queued) < 120
    assert all(np.size(getattr(message, "vertices", ())) == 0 for message in queued)


def test_recordings_without_motion_and_without_anything():
    full = a_recording()
    bare = Page(Recording(name="aria", head=full.head, points=full.points), port=18090)
    assert bare.bodies == {}
    bare.jump(1.0)
    np.testing.assert_allclose(bare.layers[0].frustum.position, full.head.t_world_device[30], atol=1e-6)
    bare.stop()
    with pytest.raises(WearcapError, match="nothing to show"):
        Page(Recording(name="empty"), port=18090)


def test_the_verb_shows_a_stored_recording_with_its_scene(tmp_path, monkeypatch, capsys):
    store = RecordingStore(tmp_path)
    trimesh.creation.box((4, 4, 0.1)).export(tmp_path / "room.ply")
    store.add(replace(a_recording(), scene="room.ply"), split="test", config_hash="x")
    write_motion(a_walk(sideways=0.2), tmp_path / "motion.npz")
    pages = []
    monkeypatch.setattr(Page, "run", lambda self: pages.append(self))
    view([str(tmp_path / "walk"), "--motion", str(tmp_path / "motion.npz"), "--port", "18099"])
    assert set(pages[0].bodies) == {"truth", "capture"}
    assert "walk: open http://127.0.0.1:" in capsys.readouterr().out
    (tmp_path / "room.ply").write_text("ply")
    with pytest.raises(WearcapError, match=r"room.ply"):
        view([str(tmp_path / "walk"), "--port", "18099"])


@pytest.mark.real
def test_aria_recording_is_shown(real_data):
    from wearcap.io.devices.aria_mps import read_mps

    recording = read_mps(real_data / "aria_mps")
    page = Page(recording, port=18095)
    page.jump(5.0)
    place = recording.head.t_world_device[nearest_frame(recording.head.timestamps, page.timeline.time)]
    np.testing.assert_allclose(page.layers[0].frustum.position, place, atol=1e-6)
    page.stop()


def test_any_skeleton_gets_a_body():
    worm = Skeleton("worm", ("a", "b", "c"), (-1, 0, 1), torch.tensor([[0.0, 0, 0], [0, 0, 1], [0, 1, 0]]))
    body = surface_or_sticks(worm, {})
    assert set(body.skin_joints[:, 0].tolist()) == {0, 1}
    sticks = stick_body(xsens23())
    assert sticks.rest_vertices[:, 2].max() > xsens23().rest_joints[:, 2].max()


def test_the_verb_refuses_what_is_not_there(tmp_path):
    with pytest.raises(WearcapError, match="no recording"):
        view([str(tmp_path / "missing")])
    with pytest.raises(WearcapError, match="port"):
        view([str(tmp_path), "--port", "0"])
    (tmp_path / "manifest.json").write_text("{}")
    assert dataset_folder(tmp_path / "recordings" / "a.safetensors") == tmp_path
    assert dataset_folder(tmp_path / "a") == tmp_path


def like(picture: np.ndarray, color: tuple[int, int, int]) -> int:
    """Pixels whose hue is the colour's, in whatever light."""
    total = picture.astype(float).sum(-1, keepdims=True)
    share = picture / total.clip(1)
    return int(((np.abs(share - np.array(color) / sum(color)) < 0.035).all(-1) & (total[..., 0] > 90)).sum())


@pytest.mark.browser
@pytest.mark.slow
def test_chromium_draws_the_page(page, tmp_path):
    """Canvas, controls and the body in a real browser; it plays, and hides what is put away."""
    with chromium(tmp_path / "profile", page.url) as browser:
        browser.poll(lambda: "Truth and captures" in browser.text())
        text = browser.text()
        for label in ("walk", "Play", "Time (s)", "Speed", "Follow with the camera"):
            assert label in text, label
        assert browser.evaluate("document.querySelectorAll('canvas').length") >= 1
        browser.poll(lambda: like(browser.screenshot(), CAPTURE_COLOR) > 1000)
        page.jump(1.5)
        browser.poll(lambda: browser.evaluate("[...document.querySelectorAll('input')].some(i => i.value == '1.5')"))
        page.arrange("truth")
        browser.poll(lambda: like(browser.screenshot(), CAPTURE_COLOR) < 100)
        assert not browser.exceptions
