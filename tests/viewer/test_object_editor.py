"""The page of `wearcap scene edit`: its verbs, its file, and a real browser in which a door is cut out and gets a hinge."""

import json
import re
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scanned_room import CHAIR, DOOR_X, DOOR_Y, SOFA, scanned_room

from wearcap.apps.scene_editor.editor import ObjectEditor
from wearcap.apps.scene_editor.view import HINTS, TOOLS, _typical_spacing
from wearcap.apps.viewer.shown import by_height
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.io.formats.environment import read_environment, write_environment
from wearcap.scene.editing import hinge_places
from wearcap.scene.objects import Environment
from wearcap.scene.scan import Box, Scan
from wearcap_browser import CONTROL, Chromium, chromium

DOOR = Box((DOOR_X, DOOR_Y, 1.03), (0.94, 0.1, 2.0))


@pytest.fixture(scope="module")
def scan() -> Scan:
    return scanned_room()


@pytest.fixture
def page(scan, tmp_path):
    page = ObjectEditor(scan, tmp_path / "environment.json", "room", port=18310)
    yield page
    page.stop()


def cut_door(page: ObjectEditor) -> None:
    page.editing.select_box(DOOR)
    page.select.name.value = "door_1"
    page.cut()
    page.refresh()


def ray(aim, eye=(2.0, 1.5, 6.0)) -> tuple[np.ndarray, np.ndarray]:
    return np.array(eye), np.array(aim) - np.array(eye)


def test_a_cut_object_leaves_the_scan_and_is_saved(page, scan):
    shown = len(page.view.visible)
    cut_door(page)
    assert page.current == "door_1"
    assert len(page.view.visible) < shown
    assert page.select.name.value == "door_2"
    assert page.objects.greatest_deg.visible
    assert not page.objects.greatest_m.visible
    page.run(1.2)
    saved = read_environment(page.file).by_name("door_1")
    assert saved.freedom.kind == "hinge"
    assert len(saved.mesh.vertices) == (~page.editing.left()).sum()
    again = ObjectEditor(scan, page.file, "room", port=18320)
    assert again.current == "door_1"
    np.testing.assert_array_equal(again.editing.left(), page.editing.left())
    before = page.file.stat().st_mtime_ns
    again.stop()
    assert page.file.stat().st_mtime_ns == before, "nothing has changed, nothing is written"


def test_tools_do_what_they_say(page):
    assert set(HINTS) == set(TOOLS)
    page.use("brush")
    page.clicked(*ray((SOFA[0], SOFA[1], 0.4)))
    painted = len(page.editing.selected)
    assert painted > 20
    assert page.view.brush.visible
    page.use("eraser")
    page.clicked(*ray((SOFA[0], SOFA[1], 0.4)))
    assert len(page.editing.selected) < painted
    page.use("box")
    page.clicked(*ray((1.0, 2.0, 0.0)))
    assert page.box.center == pytest.approx((1.0, 2.0, 0.0), abs=0.05)
    assert page.view.box.visible
    assert not page.view.brush.visible
    page.clicked(*ray((1.0, 2.0, 20.0)))
    assert page.box.center == pytest.approx((1.0, 2.0, 0.0), abs=0.05), "nothing is there"
    page.use("look")
    cut_door(page)
    page.editing.select_box(Box((SOFA[0], SOFA[1], 0.5), (2.2, 1.0, 0.8)))
    page.select.name.value = "sofa_1"
    page.select.category.value = "sofa"
    page.cut()
    page.refresh()
    assert page.current == "sofa_1"
    page.clicked(*ray((DOOR_X, DOOR_Y - 0.02, 1.6), eye=(1.4, 0.5, 1.8)))
    assert page.current == "door_1"


def test_a_hinge_snaps_to_the_leafs_edge_and_never_lies_far_away(page):
    cut_door(page)
    page._place_freedom(np.array([DOOR_X + 0.40, DOOR_Y + 0.05, 0.9]), level=False)
    pivot = page._item().freedom.pivot
    assert pivot == pytest.approx((DOOR_X + 0.43, DOOR_Y, 0.0), abs=0.03)
    page.next_hinge()
    assert page._item().freedom.pivot != pivot
    before = page._item().freedom
    with pytest.raises(WearcapError, match="from door_1"):
        page._place_freedom(np.array([DOOR_X + 2.0, DOOR_Y, 0.0]), level=False)
    assert page._item().freedom == before
    page.use("hinge / slide")
    assert page.view.freedom_handle.visible
    np.testing.assert_allclose(page.view.freedom_handle.position, before.pivot, atol=1e-6)


def test_trying_moves_the_object_within_its_limits_and_not_in_the_file(page):
    cut_door(page)
    item = page._item()
    page.objects.try_deg.value = 60.0
    page.try_value()
    node = page.view._objects["door_1"].node
    turned = rotation.matrix_from_quat_wxyz(torch.tensor(node.wxyz)).float()
    torch.testing.assert_close(turned, rotation.about_axis("z", torch.tensor(np.pi / 3)), atol=1e-6, rtol=0)
    page.objects.try_deg.value = 150.0
    page.try_value()
    limited = rotation.matrix_from_quat_wxyz(torch.tensor(node.wxyz)).float()
    torch.testing.assert_close(limited, rotation.about_axis("z", torch.tensor(np.pi / 2)), atol=1e-6, rtol=0)
    page.put_back()
    np.testing.assert_allclose(node.position, item.t_world_object.numpy(), atol=1e-6)
    assert page._item() is item
    page.editing.set_kind("door_1", "plane")
    page.use("try")
    assert page.view.try_handle.visible
    page.view.try_handle.position = np.array([2.0, 2.0, 0.0])
    page.try_pose()
    assert node.position[0] == pytest.approx(2.0)
    page.use("look")
    np.testing.assert_allclose(node.position, item.t_world_object.numpy(), atol=1e-6)
    with pytest.raises(WearcapError, match="a hinge or a slide"):
        page._place_freedom(np.zeros(3), level=True)


def test_slides_limits_and_undo(page):
    cut_door(page)
    page.editing.set_kind("door_1", "axis")
    page.refresh()
    page.objects.direction.value = 90
    page.turn_axis()
    assert page._item().freedom.axis == pytest.approx((0.0, 1.0, 0.0))
    page.objects.greatest_m.value = 0.75
    page.set_limits()
    assert page._item().freedom.limits == (0.0, 0.75)
    page._place_freedom(np.array([DOOR_X - 2.0, DOOR_Y, 0.0]), level=True)
    assert page._item().freedom.axis == pytest.approx((-1.0, 0.0, 0.0), abs=0.02)
    page.objects.name.value = "hatch"
    page.rename()
    page.refresh()
    assert page.objects.current == "hatch"
    page.delete()
    page.refresh()
    assert page.current is None
    assert not page.objects.delete.visible
    page.undo()
    page.undo()
    page.undo()
    page.refresh()
    assert page._item().freedom.axis == pytest.approx((0.0, 1.0, 0.0))
    page.view.show_freedom(page._item(), handled=True)


def test_what_cannot_be_saved_is_reported_and_kept(page):
    cut_door(page)
    page.file.mkdir()
    page.run(1.2)
    assert "not saved" in page._status.content
    page.file.rmdir()
    page.save()
    assert "saved in environment.json" in page._status.content


def test_an_environment_of_another_scene_is_refused(page, scan):
    cut_door(page)
    far = replace(page._item(), t_world_object=torch.tensor([30.0, 0.0, 0.0]))
    far = replace(far, freedom=replace(far.freedom, pivot=(30.0, 0.0, 0.0)))
    other = page.file.with_name("other.json")
    write_environment(Environment((far,)), other)
    with pytest.raises(WearcapError, match=r"other.json: the object 'door_1' stands 25.* m outside the scan"):
        ObjectEditor(scan, other, port=18320)


def test_a_scan_without_colour_is_coloured_by_height(scan):
    colors = by_height(scan.points, 0.0, 2.4).astype(np.uint8)
    low, high = colors[scan.points[:, 2] < 0.02].mean(0), colors[scan.points[:, 2] > 2.0].mean(0)
    assert low[2] > low[0]
    assert high[0] > high[2]
    assert 0.005 < _typical_spacing(scan.points) < 0.04
    assert _typical_spacing(scan.points[:1]) == 0.02


def field(browser: Chromium, label: str) -> tuple[float, float]:
    """Place of the text field that belongs to a label of the panel."""
    return browser.element(f"""(() => {{
        const label = [...document.querySelectorAll('label')]
            .find(e => e.innerText.trim() === {json.dumps(label)} && e.offsetParent);
        let box = label; while (box && !box.querySelector('input[type=text], input:not([type])')) box = box.parentElement;
        return box && [...box.querySelectorAll('input[type=text], input:not([type])')].pop(); }})()""")


def choose(browser: Chromium, label: str, option: str) -> None:
    browser.click(*field(browser, label))
    browser.click(*browser.labelled(option, "[role=option]"))


def selected(browser: Chromium) -> int:
    found = re.search(r"([\d,]+) points selected", browser.text())
    return int(found.group(1).replace(",", ""))


def on_screen(page: ObjectEditor, point, size: tuple[int, int]) -> tuple[float, float]:
    """Pixel at which the browser shows a point of the world."""
    camera = next(iter(page.server.get_clients().values())).camera
    R_world_cam = rotation.matrix_from_quat_wxyz(torch.tensor(np.array(camera.wxyz))).numpy()
    x, y, z = R_world_cam.T @ (np.array(point) - camera.position)
    focal = size[1] / 2 / np.tan(camera.fov / 2)
    return size[0] / 2 + focal * x / z, size[1] / 2 + focal * y / z


def looks_from(page: ObjectEditor, place) -> bool:
    """Whether the browser has sent its camera."""
    camera = next(iter(page.server.get_clients().values())).camera
    return camera.update_timestamp > 0 and bool(np.allclose(camera.position, place, atol=0.01))


def box_at_door(browser: Chromium, page: ObjectEditor, size: tuple[int, int]) -> bool:
    """Click on the door's middle; whether the box now stands there (the first click may meet a camera still moving)."""
    browser.click(*on_screen(page, (DOOR_X, DOOR_Y - 0.02, 1.02), size))
    time.sleep(0.5)
    return bool(np.allclose(page.box_center[:2], (DOOR_X, DOOR_Y), atol=0.06))


def box_measures(browser: Chromium, page: ObjectEditor, length: float, width: float, height: float) -> bool:
    """Type the three measures; whether all have arrived."""
    for label, value in (("Length (m)", length), ("Width (m)", width), ("Height (m)", height)):
        browser.fill(*field(browser, label), str(value))
    time.sleep(0.5)
    return tuple(page.box.size) == (length, width, height)


@pytest.mark.browser
@pytest.mark.slow
def test_a_door_is_cut_out_and_gets_a_hinge_in_chromium(page, tmp_path):
    size = (1000, 700)
    threading.Thread(target=page.run, daemon=True).start()
    with chromium(tmp_path / "profile", page.url, size) as browser:
        browser.poll(lambda: "Cut out" in browser.text() and page.server.get_clients())
        browser.poll(lambda: looks_from(page, page.server.initial_camera.position))
        browser.key("b")
        browser.poll(lambda: page.tool.value == "box")
        browser.poll(lambda: box_at_door(browser, page, size))
        browser.poll(lambda: box_measures(browser, page, 0.92, 0.14, 2.2))
        browser.click(*browser.labelled("Select what is in the box"))
        browser.poll(lambda: selected(browser) > 300)
        choose(browser, "Category", "cupboard")
        browser.poll(lambda: page.select.name.value == "cupboard_1")
        browser.fill(*field(browser, "Name"), "front-door")
        browser.click(*browser.labelled("Cut out"))
        browser.poll(lambda: selected(browser) == 0 and "1 object" in browser.text())
        browser.click(*browser.labelled("Objects", "[role=tab]"))
        choose(browser, "It", "turns about a hinge")
        browser.fill(*field(browser, "Greatest (deg)"), "120")
        browser.poll(lambda: page._item().freedom.limits[1] > 2.0)
        browser.fill(*field(browser, "Try (deg)"), "60")
        browser.poll(lambda: page._tried is not None)
        browser.click(*browser.labelled("Put it back"))
        browser.poll(lambda: page._tried is None)
        browser.poll(lambda: "saved in environment.json" in browser.text())
        check_door(page.file)
        drag_hinge(browser, page, size)
        paint_in(browser, page, size)
        assert not browser.exceptions


def check_door(file: Path) -> None:
    door = read_environment(file).by_name("front-door")
    assert door.category == "cupboard"
    assert door.freedom.limits == pytest.approx((0.0, np.deg2rad(120)))
    assert abs(abs(door.freedom.pivot[0] - DOOR_X) - 0.43) < 0.13, "at one end of the leaf"
    assert door.freedom.pivot[1] == pytest.approx(DOOR_Y, abs=0.08)
    points = door.points_world
    leaf = (abs(points - [DOOR_X, DOOR_Y, 1.02]) < [0.44, 0.03, 1.01]).all(1)
    assert leaf.mean() > 0.8
    assert points[leaf].max(0) - points[leaf].min(0) == pytest.approx([0.86, 0.04, 2.0], abs=0.08)


def drag_hinge(browser: Chromium, page: ObjectEditor, size: tuple[int, int]) -> None:
    """The handle at the hinge's foot, pulled by its arrow toward the leaf's other end, where it snaps."""
    before = page._item().freedom.pivot
    to_the_other_end = np.sign(DOOR_X - before[0])
    browser.key("h")
    browser.poll(lambda: page.view.freedom_handle.visible)
    browser.screenshot()  # waits until the handle is drawn
    grip = np.add(before, [0.28, 0.0, 0.0])
    goal = np.add(grip, [0.9 * to_the_other_end, 0.0, 0.0])
    path = [on_screen(page, grip + share * (goal - grip), size) for share in np.linspace(0, 1, 8)]
    browser.drag(path, pause_s=0.3)
    browser.poll(lambda: page._item().freedom.pivot != before)
    assert page._item().freedom.pivot[0] == pytest.approx(before[0] + 0.9 * to_the_other_end, abs=0.06)
    places = hinge_places(page._item().points_world, 0.0)
    assert np.linalg.norm(places[:, :2] - page._item().freedom.pivot[:2], axis=1).min() < 1e-6, "snapped"


def paint_in(browser: Chromium, page: ObjectEditor, size: tuple[int, int]) -> None:
    """The brush on the chair: a click, a drag of its ball over the floor, and both back by keyboard."""
    browser.key("p")
    browser.poll(lambda: page.tool.value == "brush")
    start = on_screen(page, (*CHAIR[:2], 0.45), size)
    stop = on_screen(page, (CHAIR[0] + 0.4, CHAIR[1] + 1.2, 0.0), size)
    browser.click(*start)
    browser.poll(lambda: selected(browser) > 20)
    dab = selected(browser)
    browser.drag([start, *(tuple(np.array(start) + k / 10 * (np.array(stop) - start)) for k in range(1, 11))])
    browser.poll(lambda: selected(browser) > 2 * dab)
    browser.key("z", CONTROL)
    browser.poll(lambda: selected(browser) == dab)
    browser.key("z", CONTROL)
    browser.poll(lambda: selected(browser) == 0)
