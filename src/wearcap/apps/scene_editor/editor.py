"""The page for making an interactive environment: cut objects out of a scan, set how they move, try it, save.

The operations on objects are in `scene/editing.py`; this module maps clicks and drags to them.
"""

import threading
import time as wall
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import viser
from jaxtyping import Float

from wearcap.apps.scene_editor.view import HINTS, TOOLS, EditorView, ObjectPanel, SelectPanel
from wearcap.apps.web.page_server import ServedPage
from wearcap.apps.web.page_text import MAX_TEXT, block, escaped, fitting
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import matrix_from_quat_wxyz
from wearcap.io.formats.environment import MAX_HINGE_GAP_M, read_environment, write_environment
from wearcap.scene.editing import ObjectEditing, hinge_places, snapped
from wearcap.scene.objects import Freedom, SceneObject
from wearcap.scene.scan import Scan

SNAP_M = 0.12
SAVE_AFTER_S, TRY_AGAIN_S = 0.7, 10.0
_CEILING_M = 2.1
"""Height (m) above the floor beyond which points are hidden at first, to look into rooms from above."""
_SIDE_M = 4.0


class ObjectEditor(ServedPage):
    """The page of one scan. `run` serves until interrupted and saves what changes; `stop` saves and closes."""

    def __init__(self, scan: Scan, file: Path, title: str = "scene", host: str = "127.0.0.1", port: int = 8080):
        """`file` is the environment.json to edit or create. Raises WearcapError for one of another scene."""
        environment = read_environment(file) if file.exists() else None
        try:
            self.editing = ObjectEditing(scan, environment)
        except WearcapError as error:
            raise WearcapError(error.what, where=file, expected=error.expected, fix=error.fix) from error
        self.file, self._lock = file, threading.RLock()
        self._saved = self._shown = self.editing.revision
        self._selection = self.editing.selected
        self._changed_at, self._not_before_s, self._problem, self._stroke = 0.0, 0.0, "", 0
        super().__init__("wearcap scene", host, port, "large")
        self.view = EditorView(self.server, scan)
        self._add_controls(title)
        self._wire()
        low, high = np.quantile(scan.points[:: max(1, len(scan.points) // 100_000)], [0.02, 0.98], axis=0)
        middle = np.array([*(low + high)[:2] / 2, low[2] + 0.5])
        far = 0.75 * max(float(np.linalg.norm((high - low)[:2])), _SIDE_M)
        self.server.initial_camera.look_at = tuple(middle)
        self.server.initial_camera.position = tuple(middle + far * np.array([-0.4, -0.4, 1.0]))
        self.current: str | None = None
        self._tried: Rigid | None = None
        self._show_scan()
        self._show_box()
        self._show_objects()
        self._show_status()

    def _add_controls(self, title: str) -> None:
        gui, points = self.server.gui, self.editing.scan.points
        gui.add_html(block(f"<b>{escaped(title)}</b>"))
        self._status = gui.add_html("")
        self.tool = gui.add_dropdown("Tool", TOOLS, initial_value="look")
        self._hint = gui.add_html(_hint_html("look"))
        heights = np.quantile(points[:: max(1, len(points) // 100_000), 2], [0.01, 0.999])
        low, high = round(float(heights[0]), 2), round(max(float(heights[1]), float(heights[0]) + 0.1), 2)
        self.top = gui.add_slider("Show up to (m)", low, high, 0.05, min(low + _CEILING_M, high))
        self.undo_button = gui.add_button("Undo")
        tabs = gui.add_tab_group()
        with tabs.add_tab("Select"):
            self.select = SelectPanel(gui)
        with tabs.add_tab("Objects"):
            self.objects = ObjectPanel(gui)
        self.select.name.value = self.editing.free_name(self.select.category.value)
        middle = (np.median(points, 0) + 0.0).astype(float)
        self.box_center = (float(middle[0]), float(middle[1]), low + 0.5)
        keys = (
            ("Undo", "Z", "cmd/ctrl", self.undo),
            ("Look", "V", None, lambda: self.use("look")),
            ("Box", "B", None, lambda: self.use("box")),
            ("Brush", "P", None, lambda: self.use("brush")),
            ("Eraser", "E", None, lambda: self.use("eraser")),
            ("Hinge or slide", "H", None, lambda: self.use("hinge / slide")),
            ("Try", "T", None, lambda: self.use("try")),
        )
        for label, key, modifier, action in keys:
            gui.add_command(label, hotkey=key, modifier=modifier).on_trigger(self._acting(action))
        self.undo_button.on_click(self._acting(self.undo))
        self.tool.on_update(self._acting(lambda: self.use(self.tool.value)))
        self.top.on_update(self._acting(self._show_scan))

    def _acting(self, action: Callable[[], None]) -> Callable[..., None]:
        """Decorate a control's callback: one action at a time, only when a person caused it, with errors shown to them."""

        def act(event) -> None:
            if event.client is None:  # the editor itself set the control's value
                return
            with self._lock:
                try:
                    action()
                except WearcapError as error:
                    what = fitting(str(error), MAX_TEXT)
                    event.client.add_notification("That does not go", what, color="red", auto_close_seconds=10)
                self.refresh()

        return act

    def _wire(self) -> None:
        """Let controls and view call their actions."""
        select, objects, view, act = self.select, self.objects, self.view, self._acting
        for slider in (select.length, select.width, select.height, select.turn):
            slider.on_update(act(self._show_box))
        select.take.on_click(act(lambda: self.editing.select_box(self.box)))
        select.leave.on_click(act(lambda: self.editing.select_box(self.box, add=False)))
        select.clear.on_click(act(self.editing.clear_selection))
        select.radius.on_update(act(lambda: view.show_brush(None, select.radius.value)))
        select.category.on_update(act(self._suggest_name))
        select.cut.on_click(act(self.cut))
        objects.choice.on_update(act(lambda: self.choose(objects.current)))
        objects.rename.on_click(act(self.rename))
        objects.kind.on_update(act(lambda: self.editing.set_kind(self._item().name, objects.chosen_kind)))
        objects.next_end.on_click(act(self.next_hinge))
        objects.direction.on_update(act(self.turn_axis))
        for slider in (objects.least_deg, objects.greatest_deg, objects.least_m, objects.greatest_m):
            slider.on_update(act(self.set_limits))
        for slider in (objects.try_deg, objects.try_m):
            slider.on_update(act(self.try_value))
        objects.back.on_click(act(self.put_back))
        objects.delete.on_click(act(self.delete))

        @self.server.scene.on_click()
        def _(event: viser.SceneClickEvent) -> None:
            origin, direction = np.array(event.ray_origin), np.array(event.ray_direction)
            act(lambda: self.clicked(origin, direction))(event)

        @view.brush.on_drag
        def _(event: viser.SceneNodeDragEvent) -> None:
            if event.phase != "end":
                origin = np.asarray(event.client.camera.position, np.float64)
                direction = np.asarray(event.end_position, np.float64) - origin
                act(lambda: self.paint(origin, direction, fresh=event.phase == "start"))(event)

        @view.freedom_handle.on_update
        def _(event: viser.TransformControlsEvent) -> None:
            if event.phase == "end":
                place = np.array(view.freedom_handle.position, np.float64)
                act(lambda: self._place_freedom(place, level=False))(event)

        view.box_handle.on_update(act(self.move_box))
        view.try_handle.on_update(act(self.try_pose))

    @property
    def box(self):
        """Current selection box."""
        return self.select.box(self.box_center)

    def use(self, tool: str) -> None:
        """Change the tool."""
        self.put_back()
        self.tool.value = tool
        self._hint.content = _hint_html(tool)
        self.view.show_brush(None, self.select.radius.value)
        self._show_box()
        self._show_objects()

    def clicked(self, origin: Float[np.ndarray, "3"], direction: Float[np.ndarray, "3"]) -> None:
        """Apply the current tool to a click in the view, given as the ray from the camera."""
        tool = self.tool.value
        if tool == "look":
            if (name := self.view.picked(origin, direction)) is not None:
                self.choose(name)
        elif tool in ("brush", "eraser"):
            self.paint(origin, direction, fresh=True)
        elif tool != "try" and (place := self.view.hit(origin, direction)) is not None:
            if tool == "box":
                self.box_center = (float(place[0]), float(place[1]), float(place[2]))
                self._show_box()
            else:
                self._place_freedom(place, level=True)

    def paint(self, origin: Float[np.ndarray, "3"], direction: Float[np.ndarray, "3"], fresh: bool) -> None:
        """Apply the brush or eraser where a ray meets the scan; `fresh` begins a new stroke."""
        self._stroke += fresh
        place = self.view.hit(origin, direction)
        if place is None or self.tool.value not in ("brush", "eraser"):
            return
        radius = float(self.select.radius.value)
        self.view.show_brush(place, radius)
        self.editing.select_ball(place, radius, self.tool.value == "brush", stroke=("paint", self._stroke))

    def cut(self) -> None:
        """Cut the selection out under the name and category of the panel; it becomes the current object."""
        item = self.editing.cut(self.select.name.value.strip(), self.select.category.value)
        self.current = item.name
        self._suggest_name()

    def choose(self, name: str | None) -> None:
        self.put_back()
        self.current = name
        self._show_objects()

    def rename(self) -> None:
        new = self.objects.name.value.strip()
        self.editing.rename(self._item().name, new)
        self.current = new

    def delete(self) -> None:
        self.editing.delete(self._item().name)
        self._suggest_name()

    def undo(self) -> None:
        self.put_back()
        self.editing.undo()
        self._suggest_name()

    def next_hinge(self) -> None:
        """Place the hinge at the next likely position around the object's footprint."""
        item = self._item()
        places = hinge_places(item.points_world, float(item.t_world_object[2]))
        nearest = np.linalg.norm(places - np.array(item.freedom.pivot), axis=1).argmin()
        self._set_pivot(item, places[(nearest + 1) % len(places)])

    def try_value(self) -> None:
        """Show the current object at the slider's value, within its limits; its pose in the file stays."""
        item = self._item()
        if item.freedom.kind in ("hinge", "axis"):
            panel = self.objects
            tried = np.deg2rad(panel.try_deg.value) if item.freedom.kind == "hinge" else panel.try_m.value
            value = item.freedom.clamped(torch.tensor(float(tried)))
            self._tried = item.freedom.moved(item.T_world_object, value)
            self.view.place(item.name, self._tried)

    def put_back(self) -> None:
        """Show every object at its initial pose."""
        if self._tried is not None:
            self._tried = None
            self.objects.try_deg.value = self.objects.try_m.value = 0.0
            self._show_objects()

    def _item(self) -> SceneObject:
        if self.current is None:
            raise WearcapError("there is no object yet", fix="Select its points and cut it out first.")
        return self.editing.environment.by_name(self.current)

    def _suggest_name(self) -> None:
        self.select.name.value = self.editing.free_name(self.select.category.value)

    def set_limits(self) -> None:
        """Set the current object's limits as the sliders say."""
        item = self._item()
        limits = self.objects.limits(item.freedom.kind)
        self.editing.set_freedom(item.name, replace(item.freedom, limits=limits), stroke=("limits", item.name))

    def turn_axis(self) -> None:
        """Point the current object's slide as the slider says."""
        item, angle = self._item(), np.deg2rad(self.objects.direction.value)
        freedom = replace(item.freedom, axis=(float(np.cos(angle)), float(np.sin(angle)), 0.0))
        self.editing.set_freedom(item.name, freedom, stroke=("axis", item.name))

    def _place_freedom(self, place: Float[np.ndarray, "3"], level: bool) -> None:
        """Place the hinge at a position (snapped to a near edge of the object), or point the slide's axis toward it."""
        item = self._item()
        if item.freedom.kind == "hinge":
            places = hinge_places(item.points_world, float(item.t_world_object[2]))
            self._set_pivot(item, snapped(place, places, SNAP_M))
        elif item.freedom.kind == "axis":
            box = item.points_world
            height = (box[:, 2].min() + box[:, 2].max()) / 2
            direction = np.array([*place[:2], height if level else place[2]]) - (box.min(0) + box.max(0)) / 2
            length = float(np.linalg.norm(direction))
            if length >= 1e-3:
                x, y, z = (direction / length).tolist()
                self.editing.set_freedom(item.name, replace(item.freedom, axis=(x, y, z)))
        else:
            what = f"{item.name} {'is carried' if item.freedom.kind == 'free' else 'slides on the floor'}"
            expected = "an object with a hinge or a slide"
            raise WearcapError(what, expected=expected, fix="Choose how it moves under Objects.")
        self._show_objects()

    def _set_pivot(self, item: SceneObject, pivot: Float[np.ndarray, "3"]) -> None:
        x, y, z = pivot.tolist()
        freedom = Freedom("hinge", pivot=(x, y, z), limits=item.freedom.limits)
        gap = replace(item, freedom=freedom).hinge_gap_m
        if gap > MAX_HINGE_GAP_M:
            self._show_objects()
            what = f"the hinge would be {gap:.2f} m from {item.name}"
            raise WearcapError(what, expected=f"at most {MAX_HINGE_GAP_M} m")
        self.editing.set_freedom(item.name, freedom)

    def move_box(self) -> None:
        """Move the box to its handle."""
        x, y, z = np.asarray(self.view.box_handle.position, np.float64).tolist()
        self.box_center = x, y, z
        self.view.box.position = self.box_center

    def _show_box(self) -> None:
        self.view.show_box(self.box, self.tool.value == "box")

    def try_pose(self) -> None:
        """Pose of a dragged object: on the floor, shifted and turned about z; carried, any pose."""
        handle = self.view.try_handle
        R = matrix_from_quat_wxyz(torch.tensor(np.asarray(handle.wxyz, np.float64)))
        self._tried = Rigid(R.float(), torch.tensor(np.asarray(handle.position, np.float64)).float())
        self.view.place(self._item().name, self._tried)

    def _show_scan(self) -> None:
        self.view.show_scan(self.editing.left(), float(self.top.value))

    def refresh(self) -> None:
        """Update view and panels to the state of the editing; unchanged parts are not sent again."""
        if self.editing.selected is not self._selection:
            self._selection = self.editing.selected
            self.view.show_selection(self._selection)
        if self.editing.revision is not self._shown:
            self._shown, self._changed_at = self.editing.revision, wall.monotonic()
            self._show_scan()
            self._show_objects()
        self._show_status()

    def _show_objects(self) -> None:
        """Draw the objects at their poses, and the hinge, slide and handle of the current one."""
        items, tool = self.editing.environment.objects, self.tool.value
        if self.current not in [item.name for item in items]:
            self.current = items[-1].name if items else None
        item = self._item() if items else None
        self.view.show_objects(items, self.current)
        self.objects.show(items, item)
        self.view.show_freedom(item, handled=tool == "hinge / slide")
        by_hand = item is not None and tool == "try" and item.freedom.kind in ("plane", "free")
        self.view.show_try_handle(item if by_hand else None)

    def _show_status(self) -> None:
        state = f"saved in {escaped(self.file.name)}" if self.file.exists() else "nothing to save yet"
        if self.editing.revision is not self._saved:
            state = f"<b>{escaped(self._problem or '…')}</b>"
        count = len(self.editing.environment)
        chosen = f"{len(self.editing.selected):,} points selected"
        self._status.content = block(f"{chosen} · {count} object{'s' * (count != 1)} · {state}")

    def save(self) -> None:
        """Write the environment if it has changed. Raises WearcapError if it cannot be written."""
        with self._lock:
            revision = self.editing.revision
            if revision is not self._saved:
                write_environment(self.editing.environment, self.file)
                self._saved, self._problem = revision, ""
                self._show_status()

    def update(self, now_s: float) -> None:
        """Save changes after a moment of inactivity."""
        if now_s > max(self._not_before_s, self._changed_at + SAVE_AFTER_S):
            try:
                self.save()
            except WearcapError as error:
                self._problem, self._not_before_s = f"not saved: {error}", now_s + TRY_AGAIN_S
                self._show_status()

    def stop(self) -> None:
        """Save unsaved changes, and close. Raises WearcapError if they cannot be written."""
        self._stopped = True
        try:
            self.save()
        finally:
            super().stop()


def _hint_html(tool: str) -> str:
    return block(f"<i>{HINTS[tool]}</i>")
