"""Camera self-localisation (thesis 4.2.2): retrieval, 2D-3D matches, LO-RANSAC, and guided matching with the pose.

Guided matching (`second_look_px`) matches keypoints again, only with landmarks that project nearby: more and better
spread matches, so a more accurate pose. It is ours, as are confidence and covariance.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import chain, pairwise
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64, UInt8
from rich.console import Console
from rich.progress import track
from scipy.spatial import KDTree
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.localization.absolute_pose import CameraPose, Matches, match_landmarks, match_nearby
from wearcap.localization.features import Extractor, Features, Matcher, Vlad, most_similar
from wearcap.localization.point_map import described
from wearcap.localization.visual_map import VisualMap, from_bytes
from wearcap.recording.recording import Localization

_Frame = TypeVar("_Frame")
PRIOR_AGE_S = 1.0
_UNKNOWN = 1e4
"""Variance (rad², m²) of a pose that was not found."""


@dataclass(frozen=True)
class LocalizerSettings:
    """Settings of the localisation."""

    retrieved: int = 40
    """Number of retrieved database images whose landmarks are matched (K_loc of the thesis)."""
    retrieved_with_prior: int = 8
    """Number with a prior pose: this many similar images and as many near the prior."""
    max_landmarks: int = 8_000
    """Largest number of matched landmarks: those observed by most of the retrieved images."""
    max_landmarks_with_prior: int = 4_000
    max_ratio: float = 0.85
    """Ratio test on the distances of descriptors."""
    min_cosine: float = 0.75
    """Smallest similarity of descriptors in guided matching."""
    max_error_px: float = 5.0
    """Reprojection error up to which a match is an inlier, at a picture 1000 pixels wide; grows with the width."""
    second_look_px: float = 12.0
    """Search radius of guided matching, at the same width."""
    min_inliers: int = 10
    """Fewest initial matches that agree with the pose; with fewer there is no pose."""
    horizontal_fov_deg: float = 100.0
    """Field of view of the perspective camera that a fisheye's pictures are undistorted to."""


@dataclass(frozen=True, eq=False)
class _Described:
    """An image described for queries to the map."""

    camera: Camera
    """Camera of the image, or the perspective camera that it was undistorted to."""
    features: Features
    summary: Float32[np.ndarray, "global"]
    """Global descriptor of the image."""


class Localizer:
    """Finds the poses of pictures in a visual map.

    `matcher`: pairs the keypoints of picture and database picture (LightGlue); None: keypoints are matched with the
    landmarks of all retrieved pictures at once.
    Raises WearcapError for an empty map, and one made with other features.
    """

    def __init__(
        self,
        visual_map: VisualMap,
        extractor: Extractor,
        matcher: Matcher | None = None,
        settings: LocalizerSettings = LocalizerSettings(),
    ):
        if not len(visual_map) or not len(visual_map.landmarks.points_world):
            what = "the map is empty: nothing can be localised in it"
            fix = "Build it from photos that show the scene: wearcap scene."
            raise WearcapError(what, expected="pictures with landmarks", fix=fix)
        visual_map.require_features(extractor)
        self.map, self.extractor, self.matcher, self.settings = visual_map, extractor, matcher, settings
        self.vlad = Vlad(visual_map.vocabulary)
        extent = np.linalg.norm(np.ptp(visual_map.landmarks.points_world, axis=0))
        self._same_m = max(2.5 * visual_map.cell_m, 0.002 * float(extent))

    def __call__(
        self, image: UInt8[np.ndarray, "height width 3"], camera: Camera | None, prior: Rigid | None = None
    ) -> CameraPose | None:
        """Pose of the picture's camera, or None where none is found.

        `prior`: approximate camera pose; it only selects database images, and where that leads to a weak pose or
        none the search is repeated without it. Raises WearcapError as `describe`.
        """
        return self.locate(self.describe(image, camera), prior)

    def describe(self, image: UInt8[np.ndarray, "height width 3"], camera: Camera | None) -> _Described:
        """Features of a picture, undistorted where its camera is a fisheye: the half of the work without the map.

        Raises WearcapError without intrinsics or for a picture of another size than they are for.
        """
        if camera is None:
            fix = "Calibrate it from a checkerboard video: wearcap calibrate."
            raise WearcapError("no intrinsics of the camera", expected="a calibrated camera", fix=fix)
        fov_deg = self.settings.horizontal_fov_deg
        image, camera, features = described(image, camera, self.extractor, fov_deg, "localization")
        return _Described(camera, features, self.vlad.aggregate(features.descriptors))

    def locate(self, picture: _Described, prior: Rigid | None = None) -> CameraPose | None:
        """Pose of a described picture's camera; `prior` as in a call."""
        if len(picture.features) < self.settings.min_inliers:
            return None
        if prior is not None:
            few = self.settings.retrieved_with_prior
            similar = most_similar(picture.summary, self.map.global_descriptors, few)
            images = np.union1d(similar, self.map.nearest(prior, few))
            pose = self._pose(picture, images, self.settings.max_landmarks_with_prior)
            if pose is not None and pose.confidence > 0.5:
                return pose
        images = most_similar(picture.summary, self.map.global_descriptors, self.settings.retrieved)
        return self._pose(picture, images, self.settings.max_landmarks)

    def _pose(self, picture: _Described, images: Int64[np.ndarray, "chosen"], max_landmarks: int) -> CameraPose | None:
        """Pose from the landmarks of chosen database pictures."""
        camera, features = picture.camera, picture.features
        scale = camera.width / 1000
        chosen = self.map.landmarks_of(images, max_landmarks)
        points = self.map.landmarks.points_world[chosen]
        descriptors = from_bytes(self.map.landmarks.descriptors[chosen])
        if self.matcher is None:
            settings = {"max_ratio": self.settings.max_ratio, "same_m": self._same_m}
            pairs = match_landmarks(features.descriptors, descriptors, points, **settings)
            matches = Matches(features.keypoints[pairs[:, 0]], points[pairs[:, 1]], camera)
        else:
            # A keypoint and a landmark paired by several pictures are one match: repeated, it would count as many.
            found, seen = [np.zeros((0, 2), np.int64)], self.map.observations
            for image in images.tolist():
                part, taken_by = seen.of(image), self.map.cameras[image]
                known, size = from_bytes(seen.descriptors[part]), (taken_by.width, taken_by.height)
                other = Features(seen.keypoints[part], known, np.ones(len(known), np.float32), size)
                alike = self.matcher(features, other)
                found.append(np.stack([alike[:, 0], seen.landmark[part][alike[:, 1]].astype(np.int64)], 1))
            keypoint, number = np.unique(np.concatenate(found), axis=0).T
            pixels, positions = features.keypoints[keypoint], self.map.landmarks.points_world[number]
            matches = Matches(pixels, positions, camera)
        limit = self.settings.max_error_px * scale
        fit, evidence = matches.ransac(limit), matches
        if fit is None:
            return None
        if self.matcher is None:
            for reach in (self.settings.second_look_px * scale, limit):
                # (keypoint, landmark) pairs within reach in the picture, at most the 8 nearest landmarks per keypoint
                seen, valid = fit.project(points, camera)
                number, near = np.flatnonzero(valid), np.zeros((0, 2), np.int64)
                if len(number):
                    tree, nearest = KDTree(seen[number]), min(8, len(number))
                    distance, place = tree.query(features.keypoints, k=nearest, distance_upper_bound=reach)
                    distance, place = (part.reshape(len(features.keypoints), -1) for part in (distance, place))
                    row, column = np.nonzero(np.isfinite(distance))
                    near = np.stack([row, number[place[row, column]]], 1)
                pairs = match_nearby(features.descriptors, descriptors, near, self.settings.min_cosine)
                if len(pairs) < self.settings.min_inliers:
                    return None
                matches = Matches(features.keypoints[pairs[:, 0]], points[pairs[:, 1]], camera)
                fit = matches.refined(fit, limit)
        agreeing = evidence.pixels[evidence.errors(fit) < limit]
        if len(agreeing) < self.settings.min_inliers:
            return None
        return CameraPose(
            torch.from_numpy(fit.R_world_cam).float(),
            torch.from_numpy(fit.t_world_cam).float(),
            int(fit.inlier.sum()),
            confidence(agreeing, camera),
            torch.from_numpy(matches.covariance(fit)).float(),
            Matches(matches.pixels[fit.inlier], matches.points_world[fit.inlier], camera),
        )


def confidence(agreeing: Float32[np.ndarray, "match 2"], camera: Camera) -> float:
    """1 − 2^(−(n − 6)/8) of the n matches made without knowing the pose that agree with it (ours).

    At most 6 of them count in each of the picture's 8 x 6 cells: wrong poses gather few matches, or many in one spot.
    """
    cell = (agreeing / [camera.width / 8, camera.height / 6]).astype(np.int64).clip(0, [7, 5])
    counts = np.bincount(cell[:, 0] + 8 * cell[:, 1], minlength=48)
    return float(1 - 2.0 ** (-max(int(np.minimum(counts, 6).sum()) - 6, 0) / 8))


def localize_video(
    frames: Iterable[UInt8[np.ndarray, "height width 3"]],
    timestamps: Float64[Tensor, "time"],
    camera: Camera | None,
    localizer: Localizer,
    *,
    use_prior: bool = True,
    progress: bool = False,
) -> Localization:
    """Localise every frame. Where no pose is found confidence is 0 and the last pose is repeated (at first: the first).

    `use_prior`: the previous frame's pose, if not older than `PRIOR_AGE_S`, helps to choose database pictures.
    Raises WearcapError for more or fewer frames than timestamps, and as `Localizer.__call__`.
    """
    poses: list[CameraPose | None] = []
    last: tuple[float, CameraPose] | None = None
    times: Sequence[float] = timestamps.tolist()
    pictures = _one_ahead(lambda image: localizer.describe(image, camera), frames)
    for picture, now in zip(counted(pictures, len(times), progress), times):
        prior = None
        if use_prior and last is not None and now - last[0] <= PRIOR_AGE_S:
            prior = Rigid(last[1].R_world_cam, last[1].t_world_cam)
        pose = localizer.locate(picture, prior)
        last = last if pose is None else (now, pose)
        poses.append(None if pose is None else replace(pose, matches=None))
    return localization_of(poses, timestamps)


def counted(frames: Iterable[_Frame], count: int, progress: bool) -> Iterator[_Frame]:
    """The frames of a video, with a progress bar. Raises WearcapError unless there are `count`."""
    number = 0
    for number, frame in enumerate(
        track(frames, "localization", total=count, console=Console(stderr=True), disable=not progress), 1
    ):
        if number > count:
            raise WearcapError(f"more frames than the {count} timestamps", expected="one timestamp per frame")
        yield frame
    if number < count:
        raise WearcapError(f"{number} frames with {count} timestamps", expected="one timestamp per frame")


def localization_of(poses: Sequence[CameraPose | None], timestamps: Float64[Tensor, "time"]) -> Localization:
    """Poses over time; where there is none, confidence is 0 and the last pose is repeated (at first: the first)."""
    count = len(poses)
    R, t, sure = torch.eye(3).repeat(count, 1, 1), torch.zeros(count, 3), torch.zeros(count)
    covariance = torch.eye(6).repeat(count, 1, 1) * _UNKNOWN
    repeated = next((pose for pose in poses if pose is not None), None)
    for number, pose in enumerate(poses):
        if pose is not None:
            repeated, sure[number], covariance[number] = pose, pose.confidence, pose.covariance
        if repeated is not None:
            R[number], t[number] = repeated.R_world_cam, repeated.t_world_cam
    return Localization(timestamps, R, t, sure, covariance)


def _one_ahead(describe: Callable[[np.ndarray], _Described], frames: Iterable[np.ndarray]) -> Iterator[_Described]:
    """Describe frames in a second thread, one frame ahead of the consumer."""
    with ThreadPoolExecutor(1) as pool:
        submitted = (pool.submit(describe, frame) for frame in frames)
        for pending, _ in pairwise(chain(submitted, [None])):
            assert pending is not None
            yield pending.result()
