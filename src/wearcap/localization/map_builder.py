"""Building visual maps from photos and a scan, or from photos and the tracks of structure from motion."""

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int8
from rich.console import Console
from rich.progress import track
from scipy.spatial import KDTree

from wearcap.errors import WearcapError
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.io.formats.colmap import Tracks
from wearcap.io.formats.video import read_image
from wearcap.localization.features import Extractor, Features, Vlad
from wearcap.localization.point_map import PointMapper, described, undistortion
from wearcap.localization.visual_map import Observations, VisualMap, from_bytes, merge, to_bytes
from wearcap.scene.scan import Photo, Scan


@dataclass(frozen=True)
class MapSettings:
    """Settings of the map building; lengths in the scene's unit (m)."""

    splat_m: float = 0.015
    """Radius of a scan point's disc."""
    cell_m: float = 0.02
    """Keypoints of different photos within a cell of this size become one landmark (scans; tracks are merged already)."""
    horizontal_fov_deg: float = 100.0
    """Field of view of the perspective camera that fisheye photos are undistorted to."""
    track_distance_px: float = 1.5
    """A keypoint takes the 3D point of a track that was observed within this distance."""
    words: int = 64
    """Size of VLAD's vocabulary."""
    jobs: int = 2
    """Threads."""


@dataclass(frozen=True, eq=False)
class _Picture:
    """Features of one photo: all descriptors for retrieval, and keypoints with world positions."""

    camera: Camera
    descriptors: Int8[np.ndarray, "keypoint feature"]
    keypoints: Float32[np.ndarray, "keypoint 2"]
    positions: Float32[np.ndarray, "keypoint 3"]
    valid: Bool[np.ndarray, "keypoint"]


def build_map(
    photos: Sequence[Photo],
    source: Scan | Tracks,
    extractor: Extractor,
    *,
    settings: MapSettings = MapSettings(),
    progress: bool = False,
) -> VisualMap:
    """A map of the photos, their keypoints lifted by a scan or by tracks (whose photo numbers are the photos').

    They are retrieved by VLAD over a vocabulary trained on them.
    Raises WearcapError for no photos, photos whose size is not their camera's, unreadable ones, and an empty map.
    """
    pictures = _pictures(photos, source, extractor, settings, progress)
    # The vocabulary is trained on 60,000 descriptors, drawn alike from all pictures.
    random, share = np.random.default_rng(0), max(1, 60_000 // len(pictures))
    chosen = [p.descriptors[random.permutation(len(p.descriptors))[:share]] for p in pictures]
    vlad = Vlad.trained(from_bytes(np.concatenate(chosen)), settings.words)
    cell_m = settings.cell_m if isinstance(source, Scan) else 0.0
    return _assemble(photos, pictures, extractor.name, vlad, cell_m)


def extended(
    visual_map: VisualMap,
    photos: Sequence[Photo],
    source: Scan | Tracks,
    extractor: Extractor,
    *,
    settings: MapSettings = MapSettings(),
    progress: bool = False,
) -> VisualMap:
    """The map with more photos; its vocabulary stays. Raises WearcapError as `build_map`, and for other features."""
    visual_map.require_features(extractor)
    pictures = _pictures(photos, source, extractor, settings, progress)
    more = _assemble(photos, pictures, extractor.name, Vlad(visual_map.vocabulary), 0.0)
    old, new = visual_map.observations, more.observations
    joined = {
        name: np.concatenate([getattr(old, name), getattr(new, name)])
        for name in ("keypoints", "descriptors", "positions")
    }
    landmarks, landmark = merge(joined["positions"], joined["descriptors"], visual_map.cell_m)
    poses = [(part.T_world_cam.R, part.T_world_cam.t) for part in (visual_map, more)]
    return replace(
        visual_map,
        names=visual_map.names + more.names,
        cameras=visual_map.cameras + more.cameras,
        T_world_cam=Rigid(*(torch.cat(part) for part in zip(*poses))),
        global_descriptors=np.concatenate([visual_map.global_descriptors, more.global_descriptors]),
        observations=Observations(
            **joined, first=np.concatenate([old.first, old.first[-1] + new.first[1:]]), landmark=landmark
        ),
        landmarks=landmarks,
    )


def _pictures(photos, source, extractor, settings: MapSettings, progress: bool) -> list[_Picture]:
    """Features of each photo. Raises WearcapError without photos, and when none of them shows the scene."""
    if not photos:
        raise WearcapError("no photos to build a map from", expected="database photos with cameras and poses")
    lift = _lift(source, settings)

    def one(number: int) -> _Picture:
        photo = photos[number]
        image = read_image(photo.file)
        where = str(photo.file)
        image, camera, features = described(image, photo.camera, extractor, settings.horizontal_fov_deg, where)
        positions, valid = lift(number, photo, camera, features)
        return _Picture(camera, to_bytes(features.descriptors), features.keypoints, positions, valid)

    with ThreadPoolExecutor(settings.jobs) as pool:
        done: Iterable[_Picture] = pool.map(one, range(len(photos)))
        pictures = list(track(done, "photos", total=len(photos), console=Console(stderr=True), disable=not progress))
    if not any(picture.valid.any() for picture in pictures):
        found = sum(len(picture.keypoints) for picture in pictures)
        # The most likely cause: poses and scene in different units or worlds
        fix = "Are the poses camera-to-world, with OpenCV's camera axes (x right, y down, z forward)?"
        points = source.points if isinstance(source, Scan) else source.points_world
        if not len(points):
            fix = "The scene has no points."
        else:
            cameras = np.stack([photo.T_world_cam.t.double().numpy() for photo in photos])
            low, high = points.min(0), points.max(0)
            outside = ((cameras < low - 20) | (cameras > high + 20)).any(1).mean() > 0.5
            if outside or np.ptp(points, axis=0).max() > 100 * max(np.ptp(cameras, axis=0).max(), 1.0):
                fix = (
                    f"The cameras stand around {np.round(np.median(cameras, axis=0), 1).tolist()}, the scene reaches from "
                    f"{np.round(low, 1).tolist()} to {np.round(high, 1).tolist()}: are both in one unit (m) and in one world?"
                )
        what = f"the map would be empty: none of {found} keypoints in {len(photos)} photos lies on the scene"
        raise WearcapError(what, expected="photos that show the scanned scene", fix=fix)
    return pictures


def _lift(source: Scan | Tracks, settings: MapSettings) -> Callable[[int, Photo, Camera, Features], tuple]:
    """World positions of a photo's keypoints (in the perspective camera's pixels), and where they are valid."""
    if isinstance(source, Scan):
        mapper = PointMapper(source, settings.splat_m)

        def by_scan(number: int, photo: Photo, camera: Camera, features: Features):
            point_map = mapper(photo.camera, photo.T_world_cam)
            if photo.camera.is_fisheye:
                point_map = undistortion(photo.camera, settings.horizontal_fov_deg).point_map(point_map)
            return point_map.lift(source.points, features.keypoints)

        return by_scan
    order = np.argsort(source.photo, kind="stable")

    def by_tracks(number: int, photo: Photo, camera: Camera, features: Features):
        start, stop = np.searchsorted(source.photo[order], [number, number + 1])
        mine = order[start:stop]
        pixels = source.pixels[mine]
        if photo.camera.is_fisheye:
            rays = photo.camera.unproject(torch.from_numpy(pixels).double())
            flat, valid = camera.project(rays.nan_to_num(0.0))
            pixels, mine = flat[valid].numpy(), mine[valid.numpy()]
        if not len(mine) or not len(features):
            return np.zeros((len(features), 3), np.float32), np.zeros(len(features), bool)
        distance, nearest = KDTree(pixels).query(features.keypoints)
        positions = source.points_world[source.point[mine[nearest]]].astype(np.float32)
        return positions, distance <= settings.track_distance_px

    return by_tracks


def _assemble(photos, pictures: list[_Picture], extractor: str, vlad: Vlad, cell_m: float) -> VisualMap:
    positions = np.concatenate([p.positions[p.valid] for p in pictures]).astype(np.float32)
    descriptors = np.concatenate([p.descriptors[p.valid] for p in pictures])
    landmarks, landmark = merge(positions, descriptors, cell_m)
    counts = [int(p.valid.sum()) for p in pictures]
    first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    keypoints = np.concatenate([p.keypoints[p.valid] for p in pictures])
    return VisualMap(
        extractor,
        vlad.name,
        tuple(photo.file.name for photo in photos),
        tuple(picture.camera for picture in pictures),
        Rigid(*(torch.stack([getattr(photo.T_world_cam, part).double() for photo in photos]) for part in "Rt")),
        np.stack([vlad.aggregate(from_bytes(p.descriptors)) for p in pictures]),
        Observations(keypoints, descriptors, positions, first, landmark),
        landmarks,
        vlad.vocabulary,
        cell_m,
    )
