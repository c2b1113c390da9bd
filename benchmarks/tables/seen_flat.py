"""The flat of a simulated recording as it is at any time, and what the head camera is turned to in it."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int32
from torch import Tensor

from wearcap.body.anny_body import anny_body
from wearcap.body.model import BodyModel
from wearcap.geometry.camera import Camera
from wearcap.geometry.mesh import Mesh
from wearcap.geometry.render import render
from wearcap.geometry.rigid import Rigid
from wearcap.recording import Motion, Recording
from wearcap.recording.timing import at_times
from wearcap.systems.ireplica.object_tracker import PALMS
from wearcap.systems.ireplica.scores import poses_at
from wearsim.places.interactive_flat import InteractiveFlat
from wearsim.places.world import World
from wearsim.recordings.interaction_session import flat_of

SAME_M = 1e-3
"""Largest distance of an object from its true place for a flat to be the recording's."""
SKIN = np.array([0.8, 0.6, 0.5], np.float32)


@dataclass(frozen=True, eq=False)
class SeenFlat:
    """A recording, and its flat with everything at its initial pose."""

    recording: Recording
    motion: Motion
    """The true one."""
    flat: InteractiveFlat

    @classmethod
    def of(cls, recording: Recording) -> "SeenFlat | None":
        """None for a recording that was not simulated in one of the flats as they are built now."""
        prefix, _, number = recording.location.rpartition("-interactive_flat-")
        if recording.motion is None or recording.camera is None or not prefix.startswith("sim-"):
            return None
        flat = flat_of(prefix.removeprefix("sim-"), int(number))
        initial = {item.name: item.t_world_object for item in flat.environment.objects}
        true = {name: track.t_world_body[0] for name, track in recording.object_motion.items()}
        same = set(initial) == set(true) and all((initial[n] - true[n]).norm() < SAME_M for n in initial)
        return cls(recording, recording.motion, flat) if same else None

    def poses(self, times: Float64[Tensor, "time"]) -> dict[str, Rigid]:
        """True poses of all objects."""
        found = self.flat.environment.objects
        return {item.name: poses_at(self.recording.object_motion.get(item.name), item, times) for item in found}

    def world(self, poses: dict[str, Rigid], frame: int) -> World:
        """The world with the objects at one frame's poses."""

        def moved(item):
            T = poses[item.name][frame]
            return replace(item, object=replace(item.object, R_world_object=T.R, t_world_object=T.t))

        flat = self.flat
        return InteractiveFlat(flat.static, tuple(map(moved, flat.movables)), tuple(map(moved, flat.openables))).world

    def mesh_at(self, name: str, T_world_object: Rigid) -> Mesh:
        """One object's mesh at a pose."""
        mesh = self.flat.environment.by_name(name).mesh
        R, t = T_world_object.R.numpy(), T_world_object.t.numpy()
        return replace(mesh, vertices=(mesh.vertices @ R.T + t).astype(np.float32))

    def T_world_cam(self, motion: Motion) -> Rigid:
        """Poses of the head camera on a motion's head, by its nominal mount."""
        camera = self.recording.camera
        assert camera is not None
        return motion.joint("head") @ Rigid(camera.R_head_cam, camera.t_head_cam)[None]

    @cached_property
    def body(self) -> BodyModel:
        return anny_body(self.motion.skeleton, self.recording.shape or None)

    @cached_property
    def carried_by(self) -> Float32[np.ndarray, "vertex"]:
        """Joint that moves each of the body's vertices most."""
        body = self.body
        return body.skin_joints.gather(1, body.skin_weights.argmax(1, keepdim=True))[:, 0].numpy()

    @cached_property
    def in_view_faces(self) -> Int32[np.ndarray, "face 3"]:
        """Faces of the body that a camera on the forehead can see: without head and neck."""
        above = [self.motion.skeleton.index(name) for name in ("neck", "head")]
        faces = self.body.faces.numpy().astype(np.int32)
        return faces[~np.isin(self.carried_by[faces], above).any(1)]

    def hand_vertices(self) -> list[np.ndarray]:
        """Vertices of the left and of the right hand."""
        skeleton = self.motion.skeleton
        return [np.flatnonzero(self.carried_by == skeleton.index(skeleton.sites[palm].joint)) for palm in PALMS]

    def wearer(self, times: Float64[Tensor, "time"]) -> tuple[Motion, Float[np.ndarray, "time vertex 3"]]:
        """The true motion at some times, and the body's vertices (m)."""
        motion = at_times(self.motion, times.clamp(self.motion.timestamps[0], self.motion.timestamps[-1]))
        return motion, self.body.vertices(motion.T_world_joint).numpy().astype(np.float32)


def depth_of(camera: Camera, T_world_cam: Rigid, *meshes: Mesh) -> Float32[np.ndarray, "height width"]:
    """Depth along the optical axis (m), infinite where no mesh is."""
    return render(camera, T_world_cam, meshes).depth


def uncovered(
    depth: Float32[np.ndarray, "height width"], pixels: Float[np.ndarray, "point 2"], z: Float[np.ndarray, "point"]
) -> Bool[np.ndarray, "point"]:
    """Points (pixels and depths) with nothing clearly before them."""
    column, row = (np.clip(np.rint(part), 0, size - 1).astype(int) for part, size in zip(pixels.T, depth.shape[::-1]))
    return z < depth[row, column] + 0.05
