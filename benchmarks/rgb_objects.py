"""Objects localised in the head camera's pictures alone (thesis §5.4.3, "HPS w/ RGB Obj. Loc.").

As documented: pictures show each object at a known pose; keypoints of a picture of the head camera that lie within
the object's mask, which is perfect, are matched with theirs, and P3P in RANSAC gives the object's six degrees of
freedom in the camera. HPS's camera carries it into the world. Pictures are rendered, features are SIFT's, nothing is
filtered over time.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from ireplica_baselines import static_objects
from jaxtyping import Float32, UInt8
from seen_flat import SeenFlat, depth_of, uncovered
from simulated_depth_rig import look_at
from simulated_detections import GLANCE

from wearcap.geometry.camera import Camera
from wearcap.geometry.mesh import Mesh
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory
from wearcap.localization.absolute_pose import Matches, match_landmarks
from wearcap.localization.features import Features, RootSift
from wearcap.metrics.objects import handlings
from wearcap.recording import Motion
from wearcap.recording.timing import at_times
from wearcap.scene.objects import Environment
from wearcap.systems.ireplica.scores import SETTLED_S
from wearsim.rendering.head_camera import Filming, film
from wearsim.rendering.views import Development, Scenery, exposed, render_view

FPS = 2.0
"""Rate of the pictures in which a handled object is looked for."""
PHOTO_CAMERA = Camera.pinhole(800, 600, 70.0)
PHOTO_TURNS, PHOTO_M, PHOTO_HEIGHT_M = 8, (1.2, 2.0), 1.5
"""Photos of an object: directions from it, distances from it and height above the floor of the camera (m)."""
SHOWN_SHARE = 0.01
"""Least share of a photo that shows the object."""
MIN_INLIERS = 10
"""Fewest matches that agree with a pose, as in the localisation of the camera (`localization.LocalizerSettings`)."""
ERROR_PX = 5.0
MASK_M = 0.015
"""Largest distance from the object's surface of what belongs to its mask."""


@dataclass(frozen=True, eq=False)
class _Landmarks:
    """Keypoints on an object."""

    points: Float32[np.ndarray, "landmark 3"]
    """In the object's axes (m)."""
    descriptors: Float32[np.ndarray, "landmark feature"]


@dataclass(frozen=True, eq=False)
class FoundObjects:
    """Poses of handled objects in the head camera at the times of pictures."""

    T_cam_object: dict[str, list[tuple[float, Rigid]]]
    looked: int
    """Number of pictures that were searched for an object."""

    @property
    def found(self) -> int:
        return sum(map(len, self.T_cam_object.values()))


def found_objects(seen: SeenFlat) -> FoundObjects:
    """Every object in the pictures of the (true) times in which it is handled, and shortly after."""
    recording = seen.recording
    assert recording.camera is not None
    assert recording.interactions is not None
    held, stream, rng = recording.interactions, recording.camera, np.random.default_rng(43)
    T_world_cam = seen.T_world_cam(seen.motion)
    path = Trajectory(seen.motion.timestamps, T_world_cam.R, T_world_cam.t)
    landmarks: dict[str, _Landmarks] = {}
    poses: dict[str, list[tuple[float, Rigid]]] = {}
    looked = 0
    for name, start, stop in handlings(held.start_s, held.stop_s, held.objects):
        if name not in landmarks:
            landmarks[name] = _photographed(seen, name, rng)
        wanted = torch.arange(start, stop + SETTLED_S, 1 / FPS, dtype=torch.float64)
        nearest = torch.searchsorted(stream.timestamps, wanted).clamp(max=len(stream.timestamps) - 1)
        times = stream.timestamps[nearest.unique()]
        motion, vertices = seen.wearer(times)
        cams, true = seen.T_world_cam(motion), seen.poses(times)
        looked += len(times)
        for k, time in enumerate(times.tolist()):
            own = seen.mesh_at(name, true[name][k])
            if not np.isfinite(depth_of(GLANCE, cams[k], own)).any():
                continue
            body = Mesh(vertices[k], seen.in_view_faces, np.ones(3, np.float32))
            small = stream.camera.scaled(stream.camera.width // 4, stream.camera.height // 4)
            scenery = Scenery.of(seen.world(true, k))
            image = next(iter(film(scenery, stream.camera, path, times[[k]], Filming(), rng)))
            picture = _Picture.of(image, scenery, stream.camera, cams[k])
            apart, _ = seen.flat.environment.distance(name, torch.from_numpy(picture.points), true[name][k])
            bare = uncovered(depth_of(small, cams[k], body), picture.features.keypoints / 4, picture.z)
            T = _pose(picture.features.subset((apart.numpy() < MASK_M) & bare), landmarks[name], stream.camera)
            if T is not None:
                poses.setdefault(name, []).append((time, T))
    return FoundObjects(poses, looked)


@dataclass(frozen=True, eq=False)
class _Picture:
    """Keypoints of a rendered picture, with what they are of."""

    features: Features
    points: Float32[np.ndarray, "keypoint 3"]
    """In the world (m)."""
    z: Float32[np.ndarray, "keypoint"]
    """Along the optical axis (m)."""

    @classmethod
    def of(
        cls, image: UInt8[np.ndarray, "height width 3"], scenery: Scenery, camera: Camera, T_world_cam: Rigid
    ) -> "_Picture":
        features, (_, distance) = RootSift()(image), exposed(scenery, camera, T_world_cam)
        column, row = np.rint(features.keypoints).astype(int).clip(0, [camera.width - 1, camera.height - 1]).T
        far = np.minimum(distance[row, column], 100.0)
        points_cam = camera.unproject(torch.from_numpy(features.keypoints).double()).numpy() * far[:, None]
        world = points_cam @ T_world_cam.R.double().numpy().T + T_world_cam.t.double().numpy()
        return cls(features, world.astype(np.float32), points_cam[:, 2].astype(np.float32))


def _photographed(seen: SeenFlat, name: str, rng: np.random.Generator) -> _Landmarks:
    """Keypoints with places on an object at its initial pose, from photos taken all around it."""
    item, scenery = seen.flat.environment.by_name(name), Scenery.of(seen.flat.world)
    middle, T = item.box_world.mean(0), item.T_world_object
    points, descriptors = [np.zeros((0, 3))], [np.zeros((0, 128), np.float32)]
    for turn in np.arange(PHOTO_TURNS) * 2 * np.pi / PHOTO_TURNS:
        for distance in PHOTO_M:
            place = middle + distance * np.array([np.cos(turn), np.sin(turn), 0.0])
            place[2] = PHOTO_HEIGHT_M
            T_world_cam = look_at(place, middle)
            whole, own = (depth_of(GLANCE, T_world_cam, mesh) for mesh in (seen.flat.world.mesh, seen.mesh_at(name, T)))
            if (own < whole + 0.05).mean() < SHOWN_SHARE:
                continue
            light = Development(
                exposure=float(rng.uniform(0.92, 1.06)), noise=2.0, vignetting=0.25
            )  # as a scan's photos
            image = render_view(scenery, PHOTO_CAMERA, T_world_cam, light, rng)
            picture = _Picture.of(image, scenery, PHOTO_CAMERA, T_world_cam)
            apart, _ = seen.flat.environment.distance(name, torch.from_numpy(picture.points), T)
            inside = apart.numpy() < MASK_M
            points.append((picture.points[inside] - T.t.numpy()) @ T.R.numpy())
            descriptors.append(picture.features.descriptors[inside])
    return _Landmarks(np.concatenate(points).astype(np.float32), np.concatenate(descriptors))


def _pose(features: Features, landmarks: _Landmarks, camera: Camera) -> Rigid | None:
    """Pose of the object in the camera; None where too few matches agree."""
    pairs = match_landmarks(features.descriptors, landmarks.descriptors, landmarks.points)
    matches = Matches(features.keypoints[pairs[:, 0]], landmarks.points[pairs[:, 1]], camera)
    limit = ERROR_PX * camera.width / 1000
    fit = matches.ransac(limit)
    if fit is None or fit.inlier.sum() < MIN_INLIERS:
        return None
    fit = matches.refined(fit, limit)
    return Rigid(torch.from_numpy(fit.R_world_cam), torch.from_numpy(fit.t_world_cam)).inverse()


def with_found_objects(motion: Motion, seen: SeenFlat, found: FoundObjects, environment: Environment) -> Motion:
    """Row "HPS w/ RGB object localisation": objects are where they were last found, from HPS's camera.

    Until it is found, an object stays at its initial pose; the paper's row also takes poses of few matches.
    """
    tracks = dict(static_objects(motion, environment).object_motion or {})
    for name, rows in found.T_cam_object.items():
        times = torch.tensor([time for time, _ in rows], dtype=torch.float64)
        inside = times.clamp(motion.timestamps[0], motion.timestamps[-1])
        cams = seen.T_world_cam(at_times(motion, inside)).to(torch.float64)
        placed = [cams[k] @ T for k, (_, T) in enumerate(rows)]
        last = torch.searchsorted(times, motion.timestamps, right=True) - 1
        R = torch.stack([environment.by_name(name).R_world_object.double(), *(T.R for T in placed)])[last + 1]
        t = torch.stack([environment.by_name(name).t_world_object.double(), *(T.t for T in placed)])[last + 1]
        tracks[name] = Trajectory(motion.timestamps, R.float(), t.float())
    return replace(motion, object_motion=tracks)
