"""Layers of the page; each moves to a time by sending poses, without resending meshes."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import quote

import numpy as np
import torch
import trimesh
import viser
from jaxtyping import Bool, Float, Float64, UInt8
from torch import Tensor

from wearcap.apps.viewer.shown import (
    BALL_M,
    GUESSED_COLOR,
    LIT_PROB,
    by_height,
    lit_color,
    nearest_frame,
    poses_at,
    shown_mesh,
)
from wearcap.apps.web.page_text import fitting
from wearcap.body.contact_points import BODY_POINTS, contact_points
from wearcap.body.kinematics import site_positions
from wearcap.body.model import BodyModel
from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.errors import WearcapError
from wearcap.geometry.rotation import quat_wxyz_from_matrix
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.formats.scene_folder import SURFACES
from wearcap.recording.motion import Motion
from wearcap.recording.recording import ContactTrack, HeadStream, PointCloud
from wearcap.scene.objects import SceneObject

MAX_POINTS = 200_000
LABEL_ABOVE_M = 0.3
"""Height (m) of labels above the highest joint."""
CONTACT_COLOR, AIR_COLOR = (230, 60, 40), (190, 190, 190)
_R_DEVICE_CAM = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Rotation of a camera (x right, y down, z forward) that looks in the head's direction."""


class Layer(Protocol):
    """Part of the page that follows the clock."""

    def show(self, time: float) -> None: ...


class MotionLayer(Layer):
    """Layer of one motion, which can be shifted by an offset (m) and hidden; `handles` are its nodes."""

    motion: Motion

    def __init__(self, *handles: viser.SceneNodeHandle):
        self.handles, self.offset = handles, np.zeros(3)

    def place(self, offset: Float[np.ndarray, "3"], visible: bool) -> None:
        self.offset = offset
        for handle in self.handles:
            handle.visible = visible


class BodyLayer(MotionLayer):
    """One motion as a skinned mesh. The browser does the skinning: a frame is one pose per joint."""

    def __init__(
        self, server: viser.ViserServer, name: str, motion: Motion, body: BodyModel, color: tuple[int, int, int]
    ):
        self.motion, joints = motion, len(motion.skeleton)
        weights = np.zeros((len(body.rest_vertices), joints), dtype=np.float32)
        rows = np.arange(len(weights))[:, None]
        np.add.at(weights, (rows, body.skin_joints.numpy()), body.skin_weights.numpy())
        self.handle = server.scene.add_mesh_skinned(
            f"/{name}",
            body.rest_vertices.numpy(),
            body.faces.numpy().astype(np.uint32),
            bone_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (joints, 1)),
            bone_positions=motion.skeleton.rest_joints.numpy(),
            skin_weights=weights,
            color=color,
        )
        super().__init__(self.handle)

    def show(self, time: float) -> None:
        frame = nearest_frame(self.motion.timestamps, time)
        pose = self.motion.T_world_joint[frame]
        # Bones are children of the mesh's node at the root, so that the browser's culling considers the body's position.
        root = pose.t[0]
        self.handle.position = root.double().numpy() + self.offset
        quaternions = quat_wxyz_from_matrix(pose.R.double()).numpy()
        for bone, wxyz, position in zip(self.handle.bones, quaternions, (pose.t - root).double().numpy()):
            bone.wxyz, bone.position = wxyz, position


class CertaintyLayer(MotionLayer):
    """A translucent ball around every joint, as large as the distance within which its errors are expected (`joint_std`)."""

    def __init__(self, server: viser.ViserServer, name: str, motion: Motion):
        self.motion, joints = motion, len(motion.skeleton)
        ball = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
        self.handle = server.scene.add_batched_meshes_simple(
            f"/{name}",
            np.asarray(ball.vertices),
            np.asarray(ball.faces),
            batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (joints, 1)),
            batched_positions=np.zeros((joints, 3)),
            batched_scales=np.zeros(joints),
            batched_colors=tuple(int(255 * part) for part in GUESSED_COLOR),
            opacity=0.25,
            cast_shadow=False,
            lod="off",
        )
        super().__init__(self.handle)

    def show(self, time: float) -> None:
        frame = nearest_frame(self.motion.timestamps, time)
        assert self.motion.joint_std is not None
        joints = self.motion.T_world_joint.t[frame].double().numpy()
        self.handle.position = joints[0] + self.offset
        self.handle.batched_positions = (joints - joints[0]).astype(np.float32)
        self.handle.batched_scales = self.motion.joint_std[frame].float().numpy()


class FeetLayer(MotionLayer):
    """Balls at heels and toe tips, coloured by contact."""

    def __init__(
        self,
        server: viser.ViserServer,
        name: str,
        motion: Motion,
        contact: Bool[Tensor, "frame patch"],
        clock: Float64[Tensor, "frame"],
    ):
        self.motion, self.contact, self.clock = motion, contact, clock
        add = server.scene.add_icosphere
        self.balls = [add(f"/{name}/{patch}", 0.028, AIR_COLOR, subdivisions=2) for patch in FOOT_PATCHES]
        super().__init__(*self.balls)

    @classmethod
    def of(cls, server: viser.ViserServer, name: str, motion: Motion, track: ContactTrack | None) -> "FeetLayer | None":
        """The motion's own contacts, else those of a track; None without contacts, or without these sites."""
        if not set(FOOT_PATCHES) <= set(motion.skeleton.sites):
            return None
        if motion.contact_prob is not None:
            return cls(server, name, motion, motion.contact_prob > 0.5, motion.timestamps)
        if track is None or track.feet is None:
            return None
        return cls(server, name, motion, track.feet, track.timestamps)

    def show(self, time: float) -> None:
        frame = nearest_frame(self.motion.timestamps, time)
        places = site_positions(self.motion.skeleton, self.motion.T_world_joint[frame], FOOT_PATCHES)
        touching = self.contact[nearest_frame(self.clock, time)]
        for ball, place, touch in zip(self.balls, places.double().numpy(), touching.tolist()):
            ball.position = place + self.offset
            ball.color = CONTACT_COLOR if touch else AIR_COLOR


class HeadLayer:
    """The head's path and a frustum in the head's viewing direction."""

    def __init__(self, server: viser.ViserServer, head: HeadStream):
        self.head = head
        path = head.t_world_device[:: max(1, len(head.timestamps) // 2000)].double().numpy()
        if len(path) > 1:
            segments = np.stack([path[:-1], path[1:]], 1)
            server.scene.add_line_segments("/head/path", segments, (70, 110, 200), thickness=0.006)
        self.frustum = server.scene.add_camera_frustum("/head/frustum", 1.2, 1.33, scale=0.15, color=(30, 60, 160))

    def show(self, time: float) -> None:
        frame = nearest_frame(self.head.timestamps, time)
        R = self.head.R_world_device[frame] @ _R_DEVICE_CAM.to(self.head.R_world_device)
        self.frustum.wxyz = quat_wxyz_from_matrix(R.double()).numpy()
        self.frustum.position = self.head.t_world_device[frame].double().numpy()


def add_points(server: viser.ViserServer, cloud: PointCloud) -> None:
    """A point cloud coloured by height; a large one is subsampled evenly."""
    points = cloud.points_world[:: max(1, -(-len(cloud.points_world) // MAX_POINTS))].double().numpy()
    low, high = np.quantile(points[:, 2], [0.02, 0.98]) if len(points) else (0.0, 1.0)
    add_cloud(server.scene, "/surroundings/points", points, by_height(points, low, high).astype(np.uint8), 0.012)


def add_cloud(
    scene: viser.SceneApi,
    name: str,
    points: Float[np.ndarray, "point 3"],
    colors: UInt8[np.ndarray, "point 3"],
    size_m: float,
    **look: Any,
) -> None:
    """Points of a size, in place of those of this name before; `look` is viser's."""
    if not len(points):
        scene.remove_by_name(name)
        return
    # What the browser draws is exact to a millimetre only near the node, so the node is in the points' middle.
    centre = points.mean(0, dtype=np.float64)
    near = (points - centre).astype(np.float32)
    scene.add_point_cloud(name, near, colors, point_size=size_m, precision="float32", position=centre, **look)


def read_scene(path: Path) -> trimesh.Trimesh:
    """The recording's surroundings. Raises WearcapError when the file cannot be read, or has no triangles."""
    read = SURFACES.get(path.suffix.lower())
    mesh = None if read is None else read(path)
    if mesh is None or not len(mesh.faces):
        what = "not a scene of a kind that is shown" if mesh is None else "a scene without triangles"
        raise WearcapError(what, where=path, expected="a .ply, .obj or .glb mesh")
    colors = np.rint(255 * np.broadcast_to(mesh.color, mesh.vertices.shape)).astype(np.uint8)
    return trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colors, process=False)


class LabelLayer(MotionLayer):
    """A motion's name above its head."""

    def __init__(self, server: viser.ViserServer, name: str, motion: Motion):
        self.motion = motion
        self.handle = server.scene.add_label(f"/{name}_label", fitting(name), anchor="bottom-center")
        super().__init__(self.handle)

    def show(self, time: float) -> None:
        if not self.handle.visible:
            return
        joints = self.motion.T_world_joint.t[nearest_frame(self.motion.timestamps, time)].double().numpy()
        top = np.array([*joints[0, :2], joints[:, 2].max() + LABEL_ABOVE_M])
        self.handle.position = top + self.offset


class BodyPointsLayer(MotionLayer):
    """The balls of one motion on the page; a frame is their positions, sizes (0 without contact) and colours."""

    def __init__(self, server: viser.ViserServer, name: str, motion: Motion, body: BodyModel):
        self.motion, self.points = motion, contact_points(body)
        ball = trimesh.creation.icosphere(subdivisions=2, radius=BALL_M)
        self.handle = server.scene.add_batched_meshes_simple(
            f"/{name}",
            np.asarray(ball.vertices),
            np.asarray(ball.faces),
            batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (BODY_POINTS, 1)),
            batched_positions=np.zeros((BODY_POINTS, 3)),
            batched_scales=np.zeros(BODY_POINTS),
            batched_colors=np.zeros((BODY_POINTS, 3), np.uint8),
            cast_shadow=False,
            lod="off",
        )
        super().__init__(self.handle)

    def show(self, time: float) -> None:
        frame = nearest_frame(self.motion.timestamps, time)
        assert self.motion.body_contact_prob is not None
        prob = self.motion.body_contact_prob[frame]
        size = (prob > LIT_PROB).float().numpy()
        if not size.any() and not np.any(self.handle.batched_scales):
            return
        pose = self.motion.T_world_joint[frame]
        # The balls' parent node is at the root, so that the browser's culling considers the body's position.
        root = pose.t[0].double().numpy()
        self.handle.position = root + self.offset
        self.handle.batched_positions = (self.points.vertices(pose).double().numpy() - root).astype(np.float32)
        self.handle.batched_scales = size
        self.handle.batched_colors = (255 * lit_color(prob)).round().astype(np.uint8)


class ObjectsLayer(MotionLayer):
    """Objects on the page; a frame is one pose per object."""

    def __init__(
        self,
        server: viser.ViserServer,
        name: str,
        objects: Sequence[SceneObject],
        tracks: dict[str, Trajectory],
        tint: tuple[int, int, int] | None = None,
    ):
        """`tint` is the RGB colour (0…255) that the objects' own colours are mixed with equally."""
        self.objects, self.tracks, handles = tuple(objects), tracks, []
        for item in self.objects:
            mesh = shown_mesh(item)
            color = 255 * np.atleast_2d(mesh.color).mean(0)
            if tint is not None:
                color = (color + tint) / 2
            node = f"/{name}/{quote(item.name, ' ', errors='replace')}"
            faces, rgb = mesh.faces.astype(np.uint32), tuple(int(c) for c in color)
            handles.append(server.scene.add_mesh_simple(node, mesh.vertices, faces, color=rgb))
        super().__init__(*handles)

    def show(self, time: float) -> None:
        for item, handle in zip(self.objects, self.handles):
            pose = poses_at(self.tracks.get(item.name), item, torch.tensor([time], dtype=torch.float64))[0]
            handle.wxyz = quat_wxyz_from_matrix(pose.R.double()).numpy()
            handle.position = pose.t.double().numpy() + self.offset


@dataclass
class MotionLayers:
    """Layers of one motion, which are shown, hidden, shifted and removed together."""

    body: BodyLayer
    feet: FeetLayer | None = None
    label: LabelLayer | None = None
    points: MotionLayer | None = None
    objects: MotionLayer | None = None
    certainty: CertaintyLayer | None = None

    @property
    def layers(self) -> list[MotionLayer]:
        """All but the label."""
        every = (self.body, self.feet, self.points, self.objects, self.certainty)
        return [layer for layer in every if layer is not None]

    @property
    def visible(self) -> bool:
        return bool(self.body.handle.visible)

    def place(self, offset: Float[np.ndarray, "3"], visible: bool, named: bool = False) -> None:
        """`named` also shows the motion's label, if it has one."""
        for layer in self.layers:
            layer.place(offset, visible)
        if self.label is not None:
            self.label.place(offset, named)

    def show(self, time: float) -> None:
        if self.visible:
            for layer in (*self.layers, *([] if self.label is None else [self.label])):
                layer.show(time)

    def follow(self, motion: Motion) -> None:
        """Show another motion of the same skeleton from now on."""
        for layer in (self.body, self.feet, self.label):
            if layer is not None:
                layer.motion = motion
        if self.feet is not None and motion.contact_prob is not None:
            self.feet.contact, self.feet.clock = motion.contact_prob > 0.5, motion.timestamps

    def remove(self) -> None:
        """Remove the nodes."""
        for layer in (*self.layers, *([] if self.label is None else [self.label])):
            for handle in layer.handles:
                handle.remove()
