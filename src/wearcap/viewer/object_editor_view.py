"""The object editor's 3D view: the scan, the selection, the objects at their poses, hinges, slides and handles."""

from dataclasses import dataclass

import numpy as np
import viser
from jaxtyping import Bool, Float, Int64, UInt8
from scipy.spatial import KDTree

from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import quat_wxyz_from_matrix
from wearcap.scene.editing import points_world
from wearcap.scene.objects import SceneObject
from wearcap.scene.scan import Box, Scan, first_hit
from wearcap.viewer.page_layers import by_height

SHOWN_POINTS, SHOWN_SELECTED, SHOWN_OF_OBJECT = 250_000, 80_000, 40_000
SELECTED_COLOR, BOX_COLOR, BRUSH_COLOR, HINGE_COLOR = ((255, 120, 20), (30, 120, 240), (255, 120, 20), (220, 30, 120))
TINTS = np.array([[70, 160, 150], [90, 110, 220], [190, 110, 190], [130, 170, 60], [210, 150, 60], [90, 170, 220]])
CURRENT_TINT = np.array([230, 60, 130])
_ARROW_M = 0.5
_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)], np.float32)
_EDGES = _CORNERS[[[a, a + step] for step in (1, 2, 4) for a in range(8) if not a & step]]
"""Pairs of corners that are edges of a unit box."""


@dataclass(frozen=True, eq=False)
class _Shown:
    item: SceneObject
    tinted: tuple[int, bool]
    node: viser.PointCloudHandle | viser.MeshHandle
    label: viser.LabelHandle
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
        self.point_m = 1.9 * typical_spacing(scan.points[self._thinned])
        self._center = scan.points.mean(0, dtype=np.float64)
        self.visible = scan.points[:0]
        """Indices of the scan's points that are drawn."""
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
        self._add_cloud("/scan", self.visible, self._colors[shown], self.point_m)

    def show_selection(self, selected: Int64[np.ndarray, "selected"]) -> None:
        """Draw the selection densely, slightly larger than the scan's own points, so that it covers them."""
        shown = selected[:: max(1, -(-len(selected) // SHOWN_SELECTED))]
        colors = np.broadcast_to(np.array(SELECTED_COLOR, np.uint8), (len(shown), 3))
        self._add_cloud("/selection", self.scan.points[shown], colors, 1.8 * self.point_m)

    def _add_cloud(
        self, name: str, points: Float[np.ndarray, "shown 3"], colors: UInt8[np.ndarray, "shown 3"], size: float
    ) -> None:
        if not len(points):
            self.scene.remove_by_name(name)
            return
        # Relative to the middle: float32 in the browser is exact to less than a millimetre there only.
        self.scene.add_point_cloud(
            name,
            (points - self._center).astype(np.float32),
            colors,
            point_size=size,
            precision="float32",
            position=self._center,
            point_shape="rounded",
            point_shading="flat",
        )

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
                self._objects[name] = self._add_object(item, tinted)
            self.place(name, item.T_world_object)

    def _add_object(self, item: SceneObject, tinted: tuple[int, bool]) -> _Shown:
        node, mesh = f"/objects/{item.name}", item.mesh
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
                node,
                vertices,
                rows,
                point_size=1.2 * self.point_m,
                precision="float32",
                point_shape="rounded",
                point_shading="flat",
            )
        top = mesh.vertices[:, 2].max() + 0.1
        label = self.scene.add_label(f"{node}/name", item.name, position=(0.0, 0.0, float(top)), anchor="bottom-center")
        return _Shown(item, tinted, handle, label, points_world(item)[::every])

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
        points = points_world(item)
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


def typical_spacing(points: Float[np.ndarray, "point 3"]) -> float:
    """Median distance (m) of neighbours in a cloud, over a sample."""
    sample = points[:: max(1, len(points) // 500)]
    distance, _ = KDTree(points).query(sample, k=2)
    return float(np.clip(np.median(distance[:, -1]), 0.002, 0.2)) if len(points) > 1 else 0.02
