"""The object editor's controls and its 3D view: scan, selection, objects at their poses, hinges, slides and handles."""

from dataclasses import dataclass
from urllib.parse import quote

import numpy as np
import viser
from jaxtyping import Bool, Float, Int64
from scipy.spatial import KDTree

from wearcap.apps.viewer.page_layers import add_cloud
from wearcap.apps.viewer.shown import by_height
from wearcap.apps.web.page_text import fitting
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import quat_wxyz_from_matrix
from wearcap.scene.editing import USUAL_KIND
from wearcap.scene.objects import FREEDOMS, Freedom, SceneObject
from wearcap.scene.scan import Box, Scan, first_hit

SHOWN_POINTS, SHOWN_SELECTED, SHOWN_OF_OBJECT = 250_000, 80_000, 40_000
SELECTED_COLOR, BOX_COLOR, BRUSH_COLOR, HINGE_COLOR = ((255, 120, 20), (30, 120, 240), (255, 120, 20), (220, 30, 120))
TINTS = np.array([[70, 160, 150], [90, 110, 220], [190, 110, 190], [130, 170, 60], [210, 150, 60], [90, 170, 220]])
CURRENT_TINT = np.array([230, 60, 130])
LOOK = {"point_shape": "rounded", "point_shading": "flat"}
_ARROW_M = 0.5
_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)], np.float32)
_EDGES = _CORNERS[[[a, a + step] for step in (1, 2, 4) for a in range(8) if not a & step]]
"""Pairs of corners that are edges of a unit box."""


@dataclass(frozen=True, eq=False)
class _Shown:
    item: SceneObject
    tinted: tuple[int, bool]
    node: viser.PointCloudHandle | viser.MeshHandle
    points: Float[np.ndarray, "shown 3"]
    """Points in world coordinates (m), for picking."""


class EditorView:
    """The 3D part of the page. It only draws what its methods receive."""

    def __init__(self, server: viser.ViserServer, scan: Scan):
        self.scene, self.scan = server.scene, scan
        rng = np.random.default_rng(0)
        count = min(len(scan.points), SHOWN_POINTS)
        self._thinned = np.sort(rng.choice(len(scan.points), count, replace=False))
        low, high = np.quantile(scan.points[:: max(1, len(scan.points) // 10_000), 2], [0.02, 0.98])
        colors = scan.colors
        self._colors = by_height(scan.points, low, high).astype(np.uint8) if colors is None else colors
        self.point_m = 1.9 * _typical_spacing(scan.points[self._thinned])
        self.visible = scan.points[:0]
        """The scan's points that are drawn."""
        self._objects: dict[str, _Shown] = {}
        self.box = self.scene.add_line_segments("/box", _EDGES, BOX_COLOR, thickness=0.012)
        self.box_handle = self.scene.add_transform_controls("/box_handle", scale=0.45, disable_rotations=True)
        self.brush = self.scene.add_icosphere("/brush", 1.0, BRUSH_COLOR, opacity=0.35, visible=False)
        self.freedom_handle = self.scene.add_transform_controls(
            "/freedom_handle", scale=0.5, disable_rotations=True, visible=False, depth_test=False
        )
        self.try_handle = self.scene.add_transform_controls(
            "/try_handle", scale=0.6, active_axes=(True, True, False), visible=False, depth_test=False
        )

    def show_scan(self, left: Bool[np.ndarray, "point"], top_m: float) -> None:
        """Draw the points that belong to no object, up to a height."""
        shown = self._thinned[left[self._thinned]]
        shown = shown[self.scan.points[shown, 2] <= top_m]
        self.visible = self.scan.points[shown]
        add_cloud(self.scene, "/scan", self.visible, self._colors[shown], self.point_m, **LOOK)

    def show_selection(self, selected: Int64[np.ndarray, "selected"]) -> None:
        """Draw the selection densely, slightly larger than the scan's own points, so that it covers them."""
        shown = selected[:: max(1, -(-len(selected) // SHOWN_SELECTED))]
        colors = np.broadcast_to(np.array(SELECTED_COLOR, np.uint8), (len(shown), 3))
        add_cloud(self.scene, "/selection", self.scan.points[shown], colors, 1.8 * self.point_m, **LOOK)

    def show_box(self, box: Box, visible: bool) -> None:
        self.box.visible = self.box_handle.visible = visible
        self.box.points = _EDGES * np.array(box.size, np.float32)
        self.box.wxyz = (np.cos(box.yaw / 2), 0.0, 0.0, np.sin(box.yaw / 2))
        self.box.position = self.box_handle.position = np.array(box.center)

    def show_brush(self, place: Float[np.ndarray, "3"] | None, radius_m: float) -> None:
        self.brush.visible = place is not None
        self.brush.scale = radius_m
        if place is not None:
            self.brush.position = place

    def show_objects(self, items: tuple[SceneObject, ...], current: str | None) -> None:
        """Draw each object in its own tint, the current one highlighted; objects already shown stay."""
        wanted = {item.name: (item, (k % len(TINTS), item.name == current)) for k, item in enumerate(items)}
        for name, shown in list(self._objects.items()):
            item, tinted = wanted.get(name, (None, None))
            if item is None or item.mesh is not shown.item.mesh or tinted != shown.tinted:
                shown.node.remove()
                del self._objects[name]
        for name, (item, tinted) in wanted.items():
            if name not in self._objects:
                self._objects[name] = self.added(item, tinted)
            self.place(name, item.T_world_object)

    def added(self, item: SceneObject, tinted: tuple[int, bool]) -> _Shown:
        """Draw one object, with its name above it."""
        node, mesh = f"/objects/{quote(item.name, ' ', errors='replace')}", item.mesh
        tint = CURRENT_TINT if tinted[1] else TINTS[tinted[0]]
        every = max(1, -(-len(mesh.vertices) // SHOWN_OF_OBJECT))
        own = mesh.color[::every] if len(mesh.color) == len(mesh.vertices) else np.full(3, 0.6)
        colors = 0.45 * 255 * own + 0.55 * tint
        if len(mesh.faces):
            handle = self.scene.add_mesh_simple(
                node, mesh.vertices, mesh.faces.astype(np.uint32), color=tuple(int(c) for c in tint)
            )
        else:
            vertices = mesh.vertices[::every]
            rows = np.broadcast_to(colors, vertices.shape).astype(np.uint8)
            handle = self.scene.add_point_cloud(
                node, vertices, rows, point_size=1.2 * self.point_m, precision="float32", **LOOK
            )
        top = mesh.vertices[:, 2].max() + 0.1
        place = (0.0, 0.0, float(top))
        self.scene.add_label(f"{node}/name", fitting(item.name), position=place, anchor="bottom-center")
        return _Shown(item, tinted, handle, item.points_world[::every])

    def place(self, name: str, T_world_object: Rigid) -> None:
        """Show an object at a pose (to try how it moves)."""
        node = self._objects[name].node
        node.wxyz = quat_wxyz_from_matrix(T_world_object.R.double()).numpy()
        node.position = T_world_object.t.double().numpy()

    def show_freedom(self, item: SceneObject | None, handled: bool) -> None:
        """Draw the current object's hinge as a line, or its slide as an arrow, optionally with a handle to drag."""
        self.scene.remove_by_name("/freedom")
        kind = item.freedom.kind if item is not None else None
        self.freedom_handle.visible = handled and kind in ("hinge", "axis")
        if item is None or kind not in ("hinge", "axis"):
            return
        points = item.points_world
        if item.freedom.pivot is not None:
            foot = np.array(item.freedom.pivot)
            line = np.array([[foot, [*foot[:2], points[:, 2].max() + 0.15]]])
            self.scene.add_line_segments("/freedom", line, HINGE_COLOR, thickness=0.025)
            self.freedom_handle.active_axes = (True, True, False)
            self.freedom_handle.position = foot
        else:
            middle = (points.min(0) + points.max(0)) / 2
            tip = middle + _ARROW_M * np.array(item.freedom.axis)
            self.scene.add_arrows("/freedom", np.array([[middle, tip]]), HINGE_COLOR)
            self.freedom_handle.active_axes = (True, True, True)
            self.freedom_handle.position = tip

    def show_try_handle(self, item: SceneObject | None) -> None:
        """Show a handle to move an object: on the floor, or in 3D if it is carried."""
        self.try_handle.visible = item is not None
        if item is not None:
            self.try_handle.active_axes = (True, True, item.freedom.kind == "free")
            self.try_handle.wxyz = quat_wxyz_from_matrix(item.R_world_object.double()).numpy()
            self.try_handle.position = item.t_world_object.double().numpy()

    def hit(self, origin: Float[np.ndarray, "3"], direction: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"] | None:
        """First point of the scan that a ray of the view meets."""
        number = first_hit(self.visible, origin, direction, self.point_m)
        return None if number is None else self.visible[number].astype(np.float64)

    def picked(self, origin: Float[np.ndarray, "3"], direction: Float[np.ndarray, "3"]) -> str | None:
        """First object that a ray of the view meets."""
        best, nearest = None, np.inf
        for name, shown in self._objects.items():
            number = first_hit(shown.points, origin, direction, self.point_m)
            if number is not None and (far := float(np.linalg.norm(shown.points[number] - origin))) < nearest:
                best, nearest = name, far
        return best


def _typical_spacing(points: Float[np.ndarray, "point 3"]) -> float:
    """Median distance (m) of neighbours in a cloud, over a sample."""
    sample = points[:: max(1, len(points) // 500)]
    distance, _ = KDTree(points).query(sample, k=2)
    return float(np.clip(np.median(distance[:, -1]), 0.002, 0.2)) if len(points) > 1 else 0.02


TOOLS: tuple[str, ...] = ("look", "box", "brush", "eraser", "hinge / slide", "try")
HINTS = {
    "look": "A click on an object makes it the current one.",
    "box": "A click moves the box there; its arrows move it, the sliders shape it.",
    "brush": "A click selects what is around it; drag the ball to paint on.",
    "eraser": "A click takes away from the selection; drag the ball to go on.",
    "hinge / slide": "Drag the handle of the current object's hinge or arrow, or click where it belongs.",
    "try": "Move the current object as a hand would; it goes back to its place afterwards.",
}
_NONE: str = "none yet"


class SelectPanel:
    """Shape of the box, size of the brush, and name and category of the next object to cut out."""

    def __init__(self, gui: viser.GuiApi):
        self.length = gui.add_slider("Length (m)", 0.02, 6.0, 0.01, 1.0)
        self.width = gui.add_slider("Width (m)", 0.02, 6.0, 0.01, 1.0)
        self.height = gui.add_slider("Height (m)", 0.02, 4.0, 0.01, 1.0)
        self.turn = gui.add_slider("Turn (deg)", -180, 180, 1, 0)
        self.take = gui.add_button("Select what is in the box")
        self.leave = gui.add_button("Deselect what is in the box")
        self.radius = gui.add_slider("Brush (m)", 0.02, 0.6, 0.01, 0.12)
        self.clear = gui.add_button("Clear selection")
        gui.add_divider()
        self.category = gui.add_dropdown("Category", tuple(USUAL_KIND))
        self.name = gui.add_text("Name", "")
        self.cut = gui.add_button("Cut out", color="orange")

    def box(self, center: tuple[float, float, float]) -> Box:
        """Box of this shape at a position."""
        size = (self.length.value, self.width.value, self.height.value)
        return Box(center, size, float(np.deg2rad(self.turn.value)))


class ObjectPanel:
    """Controls of the current object: its name, its degrees of freedom, its limits, and a slider to try it."""

    def __init__(self, gui: viser.GuiApi):
        self.choice: viser.GuiDropdownHandle[str] = gui.add_dropdown("Object", (_NONE,))
        self.name = gui.add_text("Name", "")
        self.rename = gui.add_button("Rename")
        self.kind = gui.add_dropdown("It", tuple(FREEDOMS.values()))
        self.next_end = gui.add_button("Hinge at another edge")
        self.direction = gui.add_slider("Direction (deg)", -180, 180, 1, 0)
        self.least_deg = gui.add_slider("Least (deg)", -180, 0, 1, 0)
        self.greatest_deg = gui.add_slider("Greatest (deg)", 0, 180, 1, 90)
        self.least_m = gui.add_slider("Least (m)", -2.0, 0.0, 0.01, 0.0)
        self.greatest_m = gui.add_slider("Greatest (m)", 0.0, 2.0, 0.01, 0.4)
        self.try_deg = gui.add_slider("Try (deg)", -180.0, 180.0, 1.0, 0.0)
        self.try_m = gui.add_slider("Try (m)", -2.0, 2.0, 0.01, 0.0)
        self.back = gui.add_button("Put it back")
        self.delete = gui.add_button("Delete", color="red")
        self.show((), None)

    @property
    def current(self) -> str | None:
        return None if self.choice.value == _NONE else self.choice.value

    @property
    def chosen_kind(self) -> str:
        return next(kind for kind, name in FREEDOMS.items() if name == self.kind.value)

    def limits(self, kind: str) -> tuple[float, float]:
        """Limits set by the sliders: rad or m."""
        if kind == "hinge":
            return float(np.deg2rad(self.least_deg.value)), float(np.deg2rad(self.greatest_deg.value))
        return float(self.least_m.value), float(self.greatest_m.value)

    def show(self, items: tuple[SceneObject, ...], current: SceneObject | None) -> None:
        """Show all objects' names, and the current one's properties."""
        names = tuple(item.name for item in items) or (_NONE,)
        if self.choice.options != names:
            self.choice.options = names
        chosen = current.name if current is not None else names[0]
        self.choice.value = chosen
        kind = current.freedom.kind if current is not None else None
        for control in (self.name, self.rename, self.kind, self.delete):
            control.visible = current is not None
        for control in (self.next_end, self.least_deg, self.greatest_deg, self.try_deg):
            control.visible = kind == "hinge"
        for control in (self.direction, self.least_m, self.greatest_m, self.try_m):
            control.visible = kind == "axis"
        self.back.visible = current is not None
        if current is None:
            return
        freedom = current.freedom
        self.name.value = current.name
        self.kind.value = FREEDOMS[freedom.kind]
        if freedom.kind == "hinge":
            low, high = np.rad2deg(_limits(freedom, np.pi))
            self.least_deg.value = round(low)
            self.greatest_deg.value = round(high)
            self.try_deg.min, self.try_deg.max = float(low), float(max(high, low + 1.0))
        if freedom.axis is not None:
            low, high = _limits(freedom, 2.0)
            self.least_m.value = round(low, 3)
            self.greatest_m.value = round(high, 3)
            self.direction.value = round(float(np.rad2deg(np.arctan2(freedom.axis[1], freedom.axis[0]))))
            self.try_m.min, self.try_m.max = float(low), float(max(high, low + 0.01))


def _limits(freedom: Freedom, widest: float) -> tuple[float, float]:
    return (-widest, widest) if freedom.limits is None else freedom.limits
