"""Layers of the page; each moves to a time by sending poses, without resending meshes. Objects and contacts for pictures, too."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import quote

import numpy as np
import torch
import trimesh
import viser
from jaxtyping import Bool, Float, Float64, UInt8
from torch import Tensor

from wearcap.apps.web.page_text import fitting
from wearcap.body.anny_body import anny_body
from wearcap.body.contact_points import BODY_POINTS, TOUCH_M, contact_points
from wearcap.body.kinematics import site_positions
from wearcap.body.model import BodyModel
from wearcap.body.skeleton import FOOT_PATCHES, Skeleton
from wearcap.errors import WearcapError
from wearcap.geometry.mesh import Mesh, capsules
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import quat_wxyz_from_matrix
from wearcap.geometry.trajectory import Trajectory, nearest_frames
from wearcap.io.formats.scene_folder import SURFACES
from wearcap.recording.active_objects import NO_OBJECT, active_at, true_spans
from wearcap.recording.motion import Motion
from wearcap.recording.recording import ContactTrack, HeadStream, PointCloud, Recording
from wearcap.scene.objects import Environment, SceneObject

MAX_POINTS = 200_000
LABEL_ABOVE_M = 0.3
"""Height (m) of labels above the highest joint."""
GUESSED_M, GUESSED_COLOR = (0.03, 0.15), np.array([0.93, 0.80, 0.42])
"""Deviations (m) of a bone of the motion's own colour and of one that is all of the other colour, and that (RGB, 0…1)."""
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


def nearest_frame(timestamps: Float64[Tensor, "time"], time: float) -> int:
    """Index of the frame nearest in time."""
    return int(nearest_frames(timestamps, torch.tensor([time], dtype=torch.float64))[0])


def stick_body(skeleton: Skeleton) -> BodyModel:
    """Capsules along the bones and a ball for the head: a body for any skeleton."""
    rest = skeleton.rest_joints.double().numpy()
    joints = [joint for joint in range(1, len(skeleton)) if np.linalg.norm(skeleton.t_parent_joint[joint]) > 1e-4]
    bones = [skeleton.parents[joint] for joint in joints]
    radius = np.clip([0.12 * float(skeleton.t_parent_joint[j].norm()) for j in joints], 0.012, 0.05)
    start, end = rest[bones], rest[joints]
    if "head" in skeleton:
        head = skeleton.index("head")
        start, end = (np.concatenate([points, rest[[head]] + [0.02, 0.0, 0.09]]) for points in (start, end))
        radius, bones = np.append(radius, 0.10), [*bones, head]
    mesh = capsules(start, end, radius, radius, np.zeros((len(bones), 3)), segments=12)
    bone_of_vertex = torch.tensor(bones).repeat_interleave(len(mesh.vertices) // len(bones))
    weights = torch.zeros(len(bone_of_vertex), 4)
    weights[:, 0] = 1
    vertices, faces = torch.from_numpy(mesh.vertices), torch.from_numpy(mesh.faces).long()
    return BodyModel(skeleton, vertices, faces, bone_of_vertex[:, None].repeat(1, 4), weights)


def surface_or_sticks(skeleton: Skeleton, shape: dict[str, float]) -> BodyModel:
    """The default human, or sticks where the skeleton is no human's."""
    try:
        return anny_body(skeleton, shape)
    except WearcapError:
        return stick_body(skeleton)


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


def vertex_colors(
    body: BodyModel, motion: Motion, frame: int, color: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "vertex 3"] | Float[np.ndarray, "3"]:
    """Colours (RGB, 0…1) of a body's vertices: the farther bones are known only roughly (`joint_std`, of both ends), the more
    of `GUESSED_COLOR`; the one colour of a motion that does not say."""
    if motion.joint_std is None:
        return color
    ends = motion.joint_std[frame].double().numpy()
    bones = np.stack([ends, ends])  # a joint's bone reaches to its children
    for joint, parent in enumerate(motion.skeleton.parents):
        if parent >= 0:
            bones[1, parent] = max(bones[1, parent], ends[joint])
    known, guessed = GUESSED_M
    share = ((bones.mean(0) - known) / (guessed - known)).clip(0.0, 1.0)
    weights = body.skin_weights.double().numpy()
    share = (share[body.skin_joints.numpy()] * weights).sum(-1, keepdims=True) / weights.sum(-1, keepdims=True)
    return color + share * (GUESSED_COLOR - color)


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


def by_height(
    points: Float[np.ndarray, "point 3"],
    low: float,
    high: float,
    colors: Sequence[Sequence[float]] = ((60, 90, 130), (220, 170, 90)),
) -> Float[np.ndarray, "point 3"]:
    """Colours of points without colours: from blue at the height `low` (m) to sand at `high`."""
    share = np.clip((points[:, 2:] - low) / max(high - low, 1e-6), 0, 1)
    return (1 - share) * np.array(colors[0]) + share * np.array(colors[1])


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


CLOUD_BALLS, CLOUD_BALL_M = 1500, 0.012
"""Number and radius (m) of small balls that show a cloud without faces."""
LIT_PROB = 0.5
"""Probability of contact above which points are shown."""
BALL_M = 0.018
"""Radius of a ball (m)."""
DIM, BRIGHT = np.array([0.55, 0.16, 0.02]), np.array([1.0, 0.86, 0.10])
"""Colours (RGB) at the threshold and at probability 1."""


def poses_at(track: Trajectory | None, item: SceneObject, times: Float64[Tensor, "time"]) -> Rigid:
    """Displayed poses of an object at times (s): of the nearest frames of its track, or the initial one without a track."""
    if track is None or not len(track):
        T = item.T_world_object
        return Rigid(T.R.expand(len(times), 3, 3), T.t.expand(len(times), 3))
    return track.T_world_body[nearest_frames(track.timestamps, times)]


@lru_cache(maxsize=1024)
def _shown_mesh(item: SceneObject) -> Mesh:
    """An object's triangles in its own axes; small balls at the points of a cloud."""
    if len(item.mesh.faces):
        return item.mesh
    points = item.mesh.vertices[:: max(1, len(item.mesh.vertices) // CLOUD_BALLS)].astype(np.float64)
    size = np.full(len(points), CLOUD_BALL_M)
    return capsules(points, points, size, size, np.full((len(points), 3), 0.6), 4)


def posed_meshes(environment: Environment, tracks: dict[str, Trajectory], time_s: float) -> list[Mesh]:
    """Meshes of all objects at a time (s), in the world."""
    meshes, times = [], torch.tensor([time_s], dtype=torch.float64)
    for item in environment.objects:
        T = poses_at(tracks.get(item.name), item, times)[0]
        R, t, mesh = T.R.double().numpy(), T.t.double().numpy(), _shown_mesh(item)
        meshes.append(replace(mesh, vertices=(mesh.vertices @ R.T + t).astype(np.float32)))
    return meshes


def with_objects(recording: Recording, environment: Environment | None = None) -> Motion | None:
    """The true motion with the true objects, hand contacts and contact points, for viewers of single motions."""
    truth = recording.motion
    if truth is None:
        return None
    labels = recording.interactions
    hands = None if labels is None else labels.hand_contact(truth.timestamps).to(truth.t_world_root.dtype)
    points = None if environment is None else _true_body_contact(recording, truth, environment)
    objects = recording.object_motion or None
    return replace(truth, object_motion=objects, hand_contact_prob=hands, body_contact_prob=points)


def _true_body_contact(
    recording: Recording, truth: Motion, environment: Environment
) -> Float[Tensor, "time point"] | None:
    """1 where a contact point of the body is within `TOUCH_M` of the active object's surface, else 0.

    None if the recording does not state which object is active, and for bodies that are not human.
    """
    if recording.interactions is None and len(recording.object_motion) != 1:
        return None
    try:
        points = contact_points(anny_body(truth.skeleton, recording.shape))
    except WearcapError:
        return None
    touches = torch.zeros(len(truth), len(points.rest_vertices))
    names = [item.name for item in environment.objects]
    spans = [span for span in true_spans(recording) if span.object in names]
    active = active_at(spans, names, truth.timestamps)
    for number in active.unique().tolist():
        if number == NO_OBJECT:
            continue
        item, take = environment.objects[number], (active == number).nonzero()[:, 0]
        T = poses_at(recording.object_motion.get(item.name), item, truth.timestamps[take])
        places = points.vertices(truth.T_world_joint[take])
        low, high = torch.from_numpy(np.stack([item.mesh.vertices.min(0), item.mesh.vertices.max(0)]))
        middle = T.R @ ((low + high) / 2).to(T.R) + T.t
        near = (places - middle[:, None]).norm(dim=-1) <= (high - low).norm() / 2 + TOUCH_M  # others cannot touch it
        distance, _ = environment.distance(item.name, places[near], T[near.nonzero()[:, 0]])
        touching = torch.zeros_like(near)
        touching[near] = distance <= TOUCH_M
        touches[take] = touching.to(touches.dtype)
    return touches


def _lit_color(prob: Float[Tensor, "point"]) -> Float[np.ndarray, "point 3"]:
    """Colours (RGB, 0…1) of points by their probability of contact."""
    share = ((prob.double().numpy() - LIT_PROB) / (1 - LIT_PROB)).clip(0.0, 1.0)
    return DIM + share[:, None] * (BRIGHT - DIM)


def lit_points(points: BodyModel, motion: Motion, frame: int) -> Mesh | None:
    """Balls at the contact points of one frame; None if there are none. `points` is a body of contact points alone."""
    if motion.body_contact_prob is None:
        return None
    prob = motion.body_contact_prob[frame]
    lit = prob > LIT_PROB
    if not lit.any():
        return None
    places = points.vertices(motion.T_world_joint[frame])[lit].double().numpy()
    size = np.full(len(places), BALL_M)
    return capsules(places, places, size, size, _lit_color(prob[lit]), 8)


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
        self.handle.batched_colors = (255 * _lit_color(prob)).round().astype(np.uint8)


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
            mesh = _shown_mesh(item)
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
