"""Pictures and videos show what they should, where they should."""

from dataclasses import replace

import av
import numpy as np
import pytest
import torch
from PIL import Image

from wearcap.apps.viewer.picture import SKY, contact_sheet, draw_head_path, save_png, shared_frames, write_video
from wearcap.apps.viewer.shown import GUESSED_COLOR, GUESSED_M, stick_body, vertex_colors
from wearcap.cli import render as render_verb
from wearcap.errors import WearcapError
from wearcap.geometry.mesh import Mesh
from wearcap.recording import Motion, PointCloud, Recording
from wearcap.recording.timing import at_times
from wearcap_testing import recording_of, small_dataset, swaying_motion

SKY_8BIT = np.round(255 * np.array(SKY))


def ink(image: np.ndarray) -> np.ndarray:
    """Pixels that are much darker than floor and sky."""
    return image.astype(int).sum(-1) < 330


def test_sheet_has_a_row_per_motion_and_a_body_in_every_panel():
    motion = swaying_motion(60)
    sheet = contact_sheet({"truth": motion, "capture": motion}, columns=4, size=(80, 100))
    assert sheet.shape == (200, 320, 3)
    panels = sheet.reshape(2, 100, 4, 80, 3).transpose(0, 2, 1, 3, 4).reshape(8, 100, 80, 3)
    for panel in panels:
        rows, columns = np.nonzero(ink(panel))
        assert rows.min() < 35
        assert rows.max() > 75
        assert abs(columns.mean() - 40) < 12
    assert not np.array_equal(panels[0], panels[1])


def test_frames_beyond_the_columns_continue_below():
    assert contact_sheet({"a": swaying_motion(30)}, [0, 5, 10, 15, 20], columns=2, size=(40, 50)).shape == (150, 80, 3)


def test_motions_of_two_rates_are_shown_at_the_same_moments():
    motion = swaying_motion(60)
    slow = at_times(motion, motion.timestamps[10:60:2])
    late = replace(slow, timestamps=slow.timestamps + 0.3)

    def second_row(other: Motion) -> np.ndarray:
        return contact_sheet({"a": motion, "b": other}, [25, 40, 58], size=(80, 100))[100:].astype(int)

    same, shifted = (np.abs(second_row(b) - second_row(motion))[20:].mean() for b in (slow, late))
    assert same < 0.1 * shifted
    assert shared_frames({"a": motion, "b": slow}, 4) == [10, 26, 42, 58]
    with pytest.raises(WearcapError, match="share no time"):
        shared_frames({"a": motion, "b": replace(motion, timestamps=motion.timestamps + 60)}, 4)


def test_frames_that_are_not_there_are_named():
    with pytest.raises(WearcapError, match="expected some from 0 to 29|Expected some from 0 to 29"):
        contact_sheet({"a": swaying_motion(30)}, [31])


def test_contacts_colour_the_feet():
    motion = swaying_motion(10)
    touching = torch.ones(10, 4)
    plain = contact_sheet({"a": motion}, [3], size=(120, 160)).astype(int)
    marked = contact_sheet({"a": replace(motion, contact_prob=touching)}, [3], size=(120, 160)).astype(int)
    red = (marked[..., 0] - marked[..., 2] > 70) & (np.abs(marked - plain).sum(-1) > 60)
    assert red.sum() > 10
    assert np.nonzero(red)[0].mean() > 110


def test_what_is_known_roughly_is_of_another_colour():
    motion, color = swaying_motion(3), np.array([0.4, 0.5, 0.6])
    body, left = stick_body(motion.skeleton), motion.skeleton.index("left_elbow")
    assert vertex_colors(body, motion, 0, color) is color
    std = torch.full((3, 23), GUESSED_M[0])
    std[1, [left, motion.skeleton.index("left_wrist")]] = GUESSED_M[1]
    sure = replace(motion, joint_std=std)
    np.testing.assert_allclose(vertex_colors(body, sure, 0, color), np.tile(color, (len(body.rest_vertices), 1)))
    found, bone = vertex_colors(body, sure, 1, color), body.skin_joints[:, 0].numpy()
    np.testing.assert_allclose(found[bone == left], np.tile(GUESSED_COLOR, ((bone == left).sum(), 1)))
    shoulder = found[bone == motion.skeleton.index("left_shoulder")]  # one of its ends is known
    np.testing.assert_allclose(shoulder, np.tile((color + GUESSED_COLOR) / 2, (len(shoulder), 1)))
    np.testing.assert_allclose(found[bone == 0], np.tile(color, ((bone == 0).sum(), 1)))
    sheets = [contact_sheet({"a": each}, [1], size=(80, 100)).astype(int) for each in (motion, sure)]
    assert np.abs(sheets[1] - sheets[0]).max() > 40


def test_video_has_the_frames_and_both_panels(tmp_path):
    motion = swaying_motion(60)
    write_video(tmp_path / "v.mp4", {"a": motion, "b": motion}, fps=10, size=(96, 80))
    with av.open(str(tmp_path / "v.mp4")) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(frames) == 10
    assert frames[0].shape == (80, 192, 3)
    assert ink(frames[5][:, :96]).sum() > 100
    assert ink(frames[5][:, 96:]).sum() > 100


def test_a_video_of_odd_size_is_refused_and_leaves_nothing(tmp_path):
    with pytest.raises(WearcapError, match="even sizes"):
        write_video(tmp_path / "v.mp4", {"a": swaying_motion(10)}, size=(97, 80))
    assert not list(tmp_path.iterdir())


def test_head_path_is_drawn_where_there_is_no_motion():
    recording = recording_of(swaying_motion(60), "a")
    alone = Recording("a", head=recording.head, points=PointCloud(torch.rand(500, 3) * 3))
    image = draw_head_path(alone, (160, 120))
    assert image.shape == (120, 320, 3)
    assert (np.abs(image.astype(int) - SKY_8BIT).sum(-1) > 120).sum() > 200


def test_render_verb(tmp_path):
    store = small_dataset(tmp_path / "data")
    render_verb.main(
        [f"{store.root}/r5", "--out", str(tmp_path / "s.png"), "--frames", "3", "--size", "60x80", "--sticks"]
    )
    assert Image.open(tmp_path / "s.png").size == (180, 80)
    with pytest.raises(WearcapError, match="cannot draw a .gif"):
        render_verb.main([f"{store.root}/r5", "--out", str(tmp_path / "s.gif")])
    with pytest.raises(WearcapError, match="no frames from 100"):
        render_verb.main([f"{store.root}/r5", "--start", "100"])


def test_png_is_written_whole(tmp_path):
    image = np.zeros((4, 5, 3), np.uint8)
    save_png(tmp_path / "a.png", image)
    assert np.array_equal(np.asarray(Image.open(tmp_path / "a.png")), image)


def test_the_camera_looks_past_what_would_hide_the_person():
    """A wall in the usual line of sight, farther from the person than what is cut away anyway: seen through nothing."""
    from wearcap.apps.viewer.camera_path import azimuths, smoothed
    from wearcap.apps.viewer.picture import DISTANCE_M, TILT, VIEW_RAD

    body = np.random.default_rng(0).uniform([-0.2, -0.2, 0.0], [0.2, 0.2, 1.7], (20, 3))
    toward = np.array([np.cos(VIEW_RAD), np.sin(VIEW_RAD), 0.0])
    aside = np.array([-toward[1], toward[0], 0.0])
    corners = np.stack([-0.5 * toward + s * 0.8 * aside + [0, 0, z] for s in (-1, 1) for z in (0.0, 2.5)])
    wall = Mesh(corners.astype(np.float32), np.array([[0, 1, 2], [1, 3, 2]], np.int32), np.full(3, 0.5, np.float32))
    free = azimuths([body] * 6, [[]] * 6, VIEW_RAD, TILT, DISTANCE_M)
    assert (free == VIEW_RAD).all()
    turned = azimuths([body] * 6, [[], [wall], [wall], [wall], [wall], []], VIEW_RAD, TILT, DISTANCE_M)
    assert abs(turned[2] - VIEW_RAD) > 0.7
    times = np.linspace(0, 2.5, 76)
    path = smoothed(turned, np.arange(6) * 0.5, times)
    assert np.abs(np.diff(path)).max() < 0.1


def test_videos_drawn_by_several_threads_have_their_frames_in_order():
    from wearcap.apps.viewer.picture import _in_parallel

    assert [int(x[0]) for x in _in_parallel(lambda t: np.array([t]), [float(k) for k in range(50)])] == list(range(50))


def test_an_interrupted_video_leaves_nothing_and_progress_is_printed_without_a_terminal(tmp_path, monkeypatch, capfd):
    from wearcap.apps.viewer import picture

    drawn = picture.captioned

    def interrupted(image, text):
        if capfd.readouterr().err.count("of 60 pictures"):
            raise KeyboardInterrupt
        return drawn(image, text)

    monkeypatch.setattr(picture, "captioned", interrupted)
    monkeypatch.setattr(picture, "LINE_S", 0.0)
    with pytest.raises(KeyboardInterrupt):
        write_video(tmp_path / "v.mp4", {"a": swaying_motion(120)}, size=(64, 64))
    assert not list(tmp_path.iterdir())


def test_a_body_is_only_shown_where_a_motion_has_its_joints():
    from wearcap.apps.viewer.picture import _actors
    from wearcap.body.anny_body import anny_body
    from wearcap.body.skeletons import smpl24

    motion = swaying_motion(10)
    other = replace(
        motion,
        skeleton=smpl24(),
        R_parent_joint=torch.eye(3).expand(10, 24, 3, 3),
        contact_prob=None,
        body_contact_prob=None,
    )
    people, sticks = _actors({"a": motion, "b": other}, anny_body(motion.skeleton))
    assert people.body.skeleton.joint_names == motion.skeleton.joint_names
    assert sticks.body.skeleton.joint_names == other.skeleton.joint_names


@pytest.mark.parametrize(
    ("video", "seconds"), [("auto", 60.0), (True, np.inf), (False, 0.0), (None, 0.0), (10, 10.0), (1, 1.0), (0.2, 0.2)]
)
def test_how_much_of_a_capture_is_filmed(video, seconds):
    from wearcap.cli.capture import _filmed_s

    assert _filmed_s(video) == seconds


@pytest.mark.parametrize("video", ["some", -1, np.inf, np.nan])
def test_what_video_takes_is_stated(video):
    from wearcap.cli.capture import _filmed_s

    with pytest.raises(WearcapError, match="auto"):
        _filmed_s(video)
