"""The live page: even playing, what it draws and shows, and its buttons in a real browser."""

import urllib.error
import urllib.request
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from carried_box import boxes
from live_show import FPS, PIECE, Show, walking
from wearcap.apps.live.pacing import BEHIND_S, Playout
from wearcap.apps.live.page import MAX_WEARERS, LivePage
from wearcap.apps.live.page_devices import Devices
from wearcap.apps.live.page_panel import sinks_html, wearer_html
from wearcap.apps.live.status import DeviceStatus, Latency, LiveStatus, SinkStatus, WearerStatus
from wearcap.apps.viewer.page import COLORS
from wearcap.body.skeleton import skeleton_of_height
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory
from wearcap_browser import chromium

NASTY = "<img src=x onerror=\"document.title='broken'\">"


def pieces(motion, size=PIECE):
    return [motion.sliced(start, start + size) for start in range(0, len(motion) - size + 1, size)]


@pytest.fixture
def show():
    return Show({"anna": walking(60.0), "ben": walking(60.0, 1.3)})


@pytest.fixture
def page(show):
    page = LivePage(show, port=18180)
    yield page
    show.stopped.set()
    page.stop()


# --- playing -------------------------------------------------------------------------------------------------------


def test_pieces_are_played_evenly():
    """Ten frames at once, 33 ms late or early: what is shown moves on by about the screen's step every time."""
    playout, parts, shown, random = Playout(), pieces(walking(8.0)), [], np.random.default_rng(2)
    due = [part.timestamps[-1].item() + 0.033 * random.uniform(-1, 1) for part in parts]
    for now_s in np.arange(0.5, 7.5, 1 / 30):
        while parts and due[0] <= now_s:
            playout.put(parts.pop(0))
            due.pop(0)
        if (found := playout.step(now_s)) is not None:
            motion, shown_s = found
            assert motion.timestamps[0] - 1.01 / FPS <= shown_s <= motion.timestamps[-1]
            shown.append(shown_s)
    steps = np.diff(shown)[30:]
    assert steps.min() > 0.6 / 30
    assert steps.max() < 1.4 / 30
    assert playout.behind_s < 0.35


def test_what_a_slow_screen_misses_is_dropped():
    playout = Playout()
    for part in pieces(walking(4.0)):
        playout.put(part)
    playout.step(0.0)
    for part in pieces(replace(walking(9.0), timestamps=walking(9.0).timestamps + 4.0)):
        playout.put(part)
    _, shown_s = playout.step(0.1)
    assert shown_s > 12.0
    assert playout.behind_s < BEHIND_S


def test_a_clock_that_is_set_anew_and_no_frames():
    playout, parts = Playout(), pieces(walking(2.0))
    assert playout.step(1.0) is None
    playout.put(parts[8])
    playout.step(1.0)
    playout.put(parts[0])
    assert playout.step(1.1)[1] <= parts[0].timestamps[-1]
    playout.put(parts[0].sliced(0, 0))
    playout.clear()
    assert playout.step(1.2) is None


# --- drawing -------------------------------------------------------------------------------------------------------


def test_bones_are_the_joints_of_the_frame_that_is_shown(page, show):
    motion = show.persons["anna"]
    page.begin("anna", motion.skeleton, FPS)
    page.take("anna", motion.sliced(0, 40))
    page.draw(1.0)
    person = page._persons["anna"]
    shown_s = person.playout.step(1.0)[1]
    truth = motion.T_world_joint[round(shown_s * FPS)]
    handle = person.layers.body.handle
    placed = np.stack([bone.position for bone in handle.bones]) + handle.position
    np.testing.assert_allclose(placed, truth.t.numpy(), atol=1e-5)
    turned = torch.tensor(np.stack([bone.wxyz for bone in handle.bones]))
    torch.testing.assert_close(rotation.matrix_from_quat_wxyz(turned).float(), truth.R, atol=1e-5, rtol=0)
    assert person.layers.feet is not None


def test_objects_are_where_the_motion_has_them_and_stay_there(show):
    page = LivePage(show, port=18180, objects=boxes().objects)
    try:
        motion = show.persons["anna"].sliced(0, 40)
        track = Trajectory(motion.timestamps, *(getattr(motion.joint("left_wrist"), name) for name in ("R", "t")))
        page.take("anna", motion)
        page.draw(1.0)
        person = page._persons["anna"]
        assert not person.objects
        page.take("anna", replace(motion, timestamps=later(track).timestamps, object_motion={"box_1": later(track)}))
        page.draw(1.13)
        motion, shown_s = person.playout.step(1.13)
        assert motion.object_motion
        (handle,) = person.objects["box_1"].handles
        truth = track.t_world_body[max(0, round(shown_s * FPS) - 40)]
        np.testing.assert_allclose(handle.position, truth, atol=1e-5)
        page.take(
            "anna", replace(motion, timestamps=motion.timestamps + 40 / FPS, object_motion={"box_7": later(track)})
        )
        page.draw(3.0)
        np.testing.assert_allclose(handle.position, track.t_world_body[-1], atol=1e-5)
        assert list(person.objects) == ["box_1"]
        page.end("anna")
        page.draw(3.1)
        assert not handle.visible
    finally:
        page.stop()


def later(track: Trajectory) -> Trajectory:
    return replace(track, timestamps=track.timestamps + 40 / FPS)


def test_devices_are_where_they_are_and_watches_at_their_wrists(page, show):
    page.take("anna", show.persons["anna"].sliced(0, 1))
    page.draw(1.0)
    page.draw(1.1)
    person = page._persons["anna"]
    head, watch = (person.devices.known[name].frame for name in ("head", "watch-7"))
    motion, status = show.persons["anna"], show.status().wearers[0]
    np.testing.assert_allclose(head.position, status.devices[0].T_world_device.t.numpy(), atol=1e-5)
    np.testing.assert_allclose(watch.position, motion.joint("left_wrist").t[0].numpy(), atol=1e-5)
    assert person.devices.known["watch-7"].label.text == "left wrist"
    page._panel.devices.value = False
    page.draw(1.2)
    assert not head.visible


def test_a_device_gets_its_joints_name_once_that_is_known(page):
    devices, pose = Devices("/world/devices_of_test"), Rigid(torch.eye(3), torch.zeros(3))
    devices.see(page.server, (DeviceStatus("serial_4", 99.0, pose),), 1.0)
    assert devices.known["serial_4"].label.text == "serial 4"
    devices.see(page.server, (DeviceStatus("serial_4", 99.0, pose, joint="right_wrist"),), 1.1)
    assert devices.known["serial_4"].label.text == "right wrist"


def test_devices_are_as_late_as_the_body(page):
    devices = Devices("/world/devices_of_test")
    for step in range(11):
        pose = Rigid(rotation.about_axis("z", torch.tensor(0.2 * step)), torch.tensor([0.1 * step, 0.0, 1.0]))
        devices.see(page.server, (DeviceStatus("head", 72.0, pose),), 50.0 + 0.1 * step)
    devices.show(51.0, 0.25, True, None)
    frame = devices.known["head"].frame
    np.testing.assert_allclose(frame.position, [0.75, 0.0, 1.0], atol=1e-5)
    assert 2 * np.arctan2(frame.wxyz[3], frame.wxyz[0]) == pytest.approx(1.5, abs=0.01)
    devices.see(page.server, (), 51.1)
    devices.show(51.1, 0.0, True, None)
    assert not frame.visible
    for number in range(100):
        devices.see(page.server, (DeviceStatus(f"serial {number}", 1.0, pose),), 52.0)
    assert len(devices.known) == 16


def test_persons_have_their_own_colours_leave_and_come_back(page, show):
    for name, motion in show.persons.items():
        page.begin(name, motion.skeleton, FPS)
        page.take(name, motion.sliced(0, 10))
    page.draw(1.0)
    anna, ben = page._persons["anna"], page._persons["ben"]
    assert tuple(anna.layers.body.handle.color) == COLORS[0]
    assert tuple(ben.layers.body.handle.color) == COLORS[1]
    assert ben.layers.body.handle.position[0] - anna.layers.body.handle.position[0] == pytest.approx(1.3, abs=1e-5)
    page.end("anna")
    page.draw(1.1)
    assert not anna.layers.body.handle.visible
    assert ben.layers.body.handle.visible
    taller = replace(show.persons["anna"].sliced(0, 10), skeleton=skeleton_of_height(1.95))
    page.begin("anna", taller.skeleton, FPS)
    page.take("anna", taller)
    page.draw(1.2)
    assert anna.layers.body.handle.visible
    assert anna.layers.body.motion.skeleton is taller.skeleton
    page._panel.wearers["ben"].shown.value = False
    page.draw(1.3)
    assert not ben.layers.body.handle.visible


def test_take_only_stores_and_keeps_a_bounded_number(page, show):
    """Without a thread that draws, as when the page stalls."""
    parts = pieces(show.persons["anna"])
    for number in range(2000):
        page.take(f"wearer {number % 40}", parts[number % len(parts)])
    assert len(page._persons) == MAX_WEARERS
    assert all(len(person.playout._pieces) <= 200 for person in page._persons.values())


def test_what_goes_wrong_does_not_end_the_page(page, show):
    original, calls = show.status, []

    def status():
        calls.append(1)
        if len(calls) < 3:
            raise RuntimeError("no status")
        return original()

    show.status = status
    page.run(1.8)
    assert page.errors == 2
    assert page.last_error == "RuntimeError: no status"
    assert page._panel.wearers.keys() == {"anna", "ben"}


def test_the_floor_and_the_points_follow_the_status(page, show):
    page._status = show.status()
    page._show_points()
    sent = page._points
    page._show_points()
    assert page._points is sent
    show.points = show.points[:100].clone()
    page._status = show.status()
    page._show_points()
    assert page._points is not sent
    lower = replace(show.status().wearers[0], floor_m=-0.4)
    page._status = LiveStatus((lower,))
    page._show_status()
    assert page._floor.position[2] == pytest.approx(-0.4)


def test_names_and_errors_from_the_network_are_text():
    wearer = WearerStatus(NASTY, "live", latency=Latency(1.0), notes=(NASTY,))
    sink = SinkStatus(NASTY, last_error=NASTY, failed=1)
    for shown in (wearer_html(wearer, 0.1), sinks_html([sink])):
        assert "<img" not in shown
    assert "–" in wearer_html(WearerStatus("", "waiting"), 0.0)


def test_the_page_answers_only_with_its_token(page):
    bare = page.url.partition("?")[0]
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(bare, timeout=10)
    assert urllib.request.urlopen(page.url, timeout=10).status == 200


# --- in a browser --------------------------------------------------------------------------------------------------


def like(picture: np.ndarray, color: tuple[int, int, int]) -> int:
    """Pixels whose hue is the colour's, in whatever light, left of the panel."""
    picture = picture[:, :760].astype(float)
    total = picture.sum(-1, keepdims=True)
    share = picture / total.clip(1)
    return int(((np.abs(share - np.array(color) / sum(color)) < 0.035).all(-1) & (total[..., 0] > 90)).sum())


@pytest.mark.browser
@pytest.mark.slow
def test_chromium_shows_a_walking_person_and_its_buttons_work(tmp_path: Path):
    show = Show({"anna": walking(240.0), NASTY: walking(240.0, 40.0)})
    page = LivePage(show, port=18181)
    page.open()
    show.play(page)
    try:
        with chromium(tmp_path / "profile", page.url) as browser:
            browser.poll(lambda: "Not recording" in browser.text())
            browser.poll(lambda: NASTY[:30] in browser.text())
            boxes = (
                "[...document.querySelectorAll('input[type=checkbox]')].filter(e => e.getBoundingClientRect().width)"
            )
            shown = page._panel.wearers[NASTY].shown
            browser.click_until(lambda: browser.element(f"{boxes}.at(-1)"), lambda: not shown.value)  # 40 m away
            browser.poll(lambda: like(browser.screenshot(), COLORS[0]) > 1500)
            text = browser.text()
            for part in (
                "anna",
                NASTY[:30],
                "● live",
                "72 Hz",
                "left wrist (watch-7)",
                "4.2 s ago",
                "41",
                "63",
                "88",
                "the disk is full",
            ):
                assert part in text, part
            before = browser.screenshot()
            browser.poll(
                lambda: (np.abs(browser.screenshot()[:, :760].astype(int) - before[:, :760]) > 40).sum() > 3000
            )
            assert like(browser.screenshot(), COLORS[0]) > 1500  # followed by the camera

            browser.press("Record", lambda: ("record", True) in show.asked)
            browser.poll(lambda: "Recording to walk" in browser.text())
            browser.press("Stop recording", lambda: ("record", False) in show.asked)
            browser.press("Guide me", lambda: ("guide", "anna") in show.asked)
            browser.poll(lambda: "Stand still and look straight ahead." in browser.text())
            browser.press("Skip", lambda: ("skip", "anna") in show.asked)
            browser.poll(lambda: "The left watch still moves." in browser.text())
            browser.press("Redo", lambda: ("redo", "anna") in show.asked)
            browser.press("Stop the capture", lambda: ("stop",) in show.asked)
            assert browser.evaluate("document.title") != "broken"
            assert browser.evaluate("document.querySelectorAll('img[src=x]').length") == 0
            assert not browser.exceptions
    finally:
        show.stopped.set()
        page.stop()
    assert page.errors == 0, page.last_error
