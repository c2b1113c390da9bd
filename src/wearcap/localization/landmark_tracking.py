"""A head camera localised in key frames, between which landmarks of the map are tracked by optical flow (ours).

Key frames are localised in the map as single pictures are. A frame between them has the pose that the tracked landmarks
agree with. Frames are localised anew regularly, and when few landmarks are left, cover little of the picture or fit badly.
A key frame that contradicts the track begins a rival; further key frames decide between the two, and poses that rest on
the loser alone are withdrawn.
"""

from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, UInt8
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.extras import at_first_use
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.localization.absolute_pose import CameraPose, Fit, Matches
from wearcap.localization.localizer import Localizer, confidence, counted, localization_of
from wearcap.localization.point_map import check_size, undistortion
from wearcap.localization.pose_chain import ChainedPose, joined
from wearcap.recording.recording import Localization

cv2 = at_first_use("cv2", "tracking of landmarks")

_AHEAD = 24
"""Number of frames that are decoded ahead while a key frame is localised."""
_TRACKED = 0.5
"""Confidence from which a key frame is tracked, and below which a track is lost."""
_ESTABLISHED = 2
"""Largest number of agreeing key frames that a track can set against a rival's."""
_RETURN_PX = 1.0
"""Distance from where a landmark was, tracked to the next frame and back, beyond which it is lost."""
_LEVELS = 3
"""Pyramid levels of the optical flow, for large displacements."""


@dataclass(frozen=True)
class TrackingSettings:
    """When a video's frames are localised anew, and how landmarks are tracked in between."""

    key_s: float
    """Time (s) between regular key frames."""
    retry_s: float
    """Time (s) between key frames while tracking is weak, lost or contradicted."""
    landmarks: int
    """Largest number of tracked landmarks, spread over the picture."""
    min_share: float
    """Share of a key frame's landmarks below which tracking is weak."""
    min_confidence: float
    """Confidence below which tracking is weak."""
    max_error_px: float
    """Median reprojection error beyond which tracking is weak, at a picture 1000 pixels wide."""
    max_drift_m: float
    """Deviation (m) of the position by the tracked landmarks beyond which tracking is weak; beyond twice that it is lost."""
    window_px: int
    """Side of the optical flow's window."""
    max_side: int
    """The flow is computed in pictures reduced to this longer side (px)."""

    def __post_init__(self):
        shares = 0 <= self.min_share < 1 and 0 <= self.min_confidence < 1
        sizes = min(self.max_error_px, self.max_drift_m, self.window_px - 2, self.max_side - 31, self.landmarks - 3) > 0
        if not (0 < self.retry_s <= self.key_s and shares and sizes):
            expected = "0 < retry_s <= key_s; shares in 0…1; 4 landmarks, a window of 3 px, sides of 32 px or more"
            raise WearcapError(f"tracking with {self}", expected=expected)


@dataclass(eq=False)
class _Track:
    """Landmarks tracked since a key frame, and the camera's poses by them."""

    first: int
    """Index of the frame that `poses` begin with: where the track began, or was last confirmed."""
    key: CameraPose
    """Pose of the last key frame."""
    camera: Camera
    """Camera of the picture, or the perspective one that it is undistorted to."""
    pixels: Float32[np.ndarray, "landmark 2"]
    points_world: Float32[np.ndarray, "landmark 3"]
    fit: Fit
    """Pose in the last frame."""
    before: Fit
    """Pose in the frame before that, for the prediction."""
    started: int
    """Number of landmarks in the last key frame."""
    poses: list[ChainedPose]
    votes: int = 1
    """Number of key frames that agree with the track."""
    error_px: float = 0.0
    """Median reprojection error in the last frame."""


class LandmarkTracker:
    """Localises the frames of a video one after another."""

    def __init__(self, localizer: Localizer, settings: TrackingSettings):
        self.localizer, self.settings = localizer, settings
        self.key_frames = 0
        """Number of frames that were localised in the map."""
        self._final: list[ChainedPose | None] = []
        self._tracks: list[_Track] = []
        """The track, and the rival that contradicts it, if any."""
        self._grey: np.ndarray | None = None
        self._now, self._key_time = -1, -np.inf

    def poses(self) -> list[CameraPose | None]:
        """Pose of each frame so far, None where none was found."""
        return joined(self._final + (self._tracks[0].poses if self._tracks else []))

    def advance(self, time: float, frame: "_Frame") -> None:
        """Localise the next frame; `time` in s."""
        self._now += 1
        if self._grey is not None:
            lost = [track for track in self._tracks if not self._followed(track, self._grey, frame.grey)]
            self._end(lost)
        self._grey = frame.grey
        unsure = len(self._tracks) != 1 or self._weak(self._tracks[0])
        pose = None
        if frame.described or (unsure and time - self._key_time > self.settings.retry_s - 1e-3):
            self._key_time, self.key_frames = time, self.key_frames + 1
            pose = self._localized(frame)
        if not self._tracks:
            self._final.append(pose and ChainedPose(replace(pose, matches=None), pose, np.zeros((6, 6))))

    def _localized(self, frame: "_Frame") -> CameraPose | None:
        """Pose of a key frame, which confirms a track, contradicts it, or begins one."""
        picture = frame.described.result() if frame.described else self.localizer.describe(frame.image, frame.camera)
        alone = len(self._tracks) == 1
        near = self._tracks[0].fit if alone else None
        prior = near and Rigid(torch.from_numpy(near.R_world_cam), torch.from_numpy(near.t_world_cam))
        pose = self.localizer.locate(picture, prior)
        if pose is None or pose.confidence < _TRACKED:
            return pose
        new = self._begun(pose, picture.camera)
        agreeing = next((track for track in self._tracks if _agree(track, new.fit, 2 * self._limit_px(track))), None)
        if agreeing is not None:
            self._confirm(agreeing, new)
        elif alone and self._weak(self._tracks[0]):
            if pose.confidence > self._tracks[0].poses[-1].pose.confidence:
                self._end(self._tracks)
                self._tracks = [new]
        else:
            for track in self._tracks[:1]:
                track.votes = min(track.votes, _ESTABLISHED)
            self._tracks = [*self._tracks[:1], new]
        return pose

    def _confirm(self, track: _Track, new: _Track) -> None:
        """A key frame agrees with a track, which goes on with the new landmarks if they suffice."""
        others = [other for other in self._tracks if other is not track]
        if new.key.confidence >= min(track.poses[-1].pose.confidence, self.settings.min_confidence):
            new.before, new.first, new.votes = track.before, track.first, track.votes
            new.poses = [*track.poses[:-1], replace(new.poses[0], before=track.poses[-1])]
            self._tracks[self._tracks.index(track)] = track = new
        track.votes += 1
        if all(other.votes < track.votes for other in others):
            self._end(others)
            self._final += track.poses[:-1]
            track.poses, track.first = track.poses[-1:], self._now

    def _begun(self, pose: CameraPose, camera: Camera) -> _Track:
        """A track of a key frame's landmarks, of all cells of the picture alike, from where its pose shows them.

        Tracked from the keypoints, some landmarks would have another pose than all.
        """
        assert pose.matches is not None
        fit = Fit(pose.R_world_cam.double().numpy(), pose.t_world_cam.double().numpy(), np.zeros(0, bool))
        pixels, points = fit.project(pose.matches.points_world, camera)[0], pose.matches.points_world
        cell = (pixels / [camera.width / 8, camera.height / 6]).astype(np.int64).clip(0, [7, 5]) @ [1, 8]
        order, count = np.argsort(cell, kind="stable"), np.bincount(cell, minlength=48)
        rank = np.empty(len(cell), np.int64)
        rank[order] = np.arange(len(cell)) - np.repeat(count.cumsum() - count, count)
        chosen = np.argsort(rank, kind="stable")[: self.settings.landmarks]
        pixels, pose = pixels[chosen].astype(np.float32), replace(pose, matches=None)
        poses = [ChainedPose(pose, pose, np.zeros((6, 6)))]
        return _Track(self._now, pose, camera, pixels, points[chosen], fit, fit, len(chosen), poses)

    def _limit_px(self, track: _Track) -> float:
        return self.localizer.settings.max_error_px * track.camera.width / 1000

    def _weak(self, track: _Track) -> bool:
        """Whether few landmarks are left, cover little of the picture, or fit badly."""
        settings = self.settings
        return (
            len(track.pixels) < settings.min_share * track.started
            or track.poses[-1].pose.confidence < settings.min_confidence
            or _drift_m(track.poses[-1].drift) > settings.max_drift_m
            or track.error_px > settings.max_error_px * track.camera.width / 1000
        )

    def _end(self, ended: list[_Track]) -> None:
        """End tracks: a rival is forgotten; poses on which a surviving rival does not rest are withdrawn."""
        left = [track for track in self._tracks if track not in ended]
        if self._tracks and self._tracks[0] in ended:
            first = self._tracks[0]
            self._final += [None] * (left[0].first - first.first) if left else first.poses[: self._now - first.first]
        self._tracks = left

    def _followed(self, track: _Track, before: np.ndarray, after: np.ndarray) -> bool:
        """Track the landmarks into the next frame and estimate its pose; False where too few can be tracked."""
        camera, limit_px, least = track.camera, self._limit_px(track), self.localizer.settings.min_inliers
        size = np.array(after.shape[::-1])
        scale = size / [camera.width, camera.height]
        reduced = ((part + 0.5) * scale - 0.5 for part in (track.pixels, _expected(track)))
        start, guess = (np.ascontiguousarray(part, np.float32) for part in reduced)
        end, off_px, found = flow_there_and_back(before, after, start, self.settings.window_px, _LEVELS, guess)
        kept = found & (off_px < _RETURN_PX)
        if kept.sum() < least:
            return False
        pixels = ((end[kept] + 0.5) / scale - 0.5).astype(np.float32)
        matches = Matches(pixels, track.points_world[kept], camera)
        fit = matches.refined(track.fit, limit_px)
        trust = min(track.key.confidence, confidence(pixels[fit.inlier], camera))
        if fit.inlier.sum() < least or trust < _TRACKED:
            return False
        drift = matches.covariance(fit)
        if _drift_m(drift) > 2 * self.settings.max_drift_m:
            return False
        track.before, track.fit = track.fit, fit
        track.pixels, track.points_world = pixels[fit.inlier], matches.points_world[fit.inlier]
        track.error_px = float(np.median(matches.errors(fit)[fit.inlier]))
        R, t = (torch.from_numpy(part).float() for part in (fit.R_world_cam, fit.t_world_cam))
        covariance = track.key.covariance + torch.from_numpy(drift).float()
        pose = CameraPose(R, t, len(track.pixels), trust, covariance)
        track.poses.append(ChainedPose(pose, track.key, drift))
        return True


def track_video(
    frames: Iterable[UInt8[np.ndarray, "_ _ 3"]],
    timestamps: Float64[Tensor, "time"],
    camera: Camera | None,
    localizer: Localizer,
    settings: TrackingSettings,
    *,
    progress: bool = False,
) -> Localization:
    """Localise every frame, by tracking between key frames; frames without a pose as in `localize_video`.

    Raises WearcapError for more or fewer frames than timestamps, and as `Localizer.__call__`.
    """
    tracker, times = LandmarkTracker(localizer, settings), timestamps.tolist()
    ahead = _read_ahead(frames, times, camera, localizer, settings)
    for number, frame in enumerate(counted(ahead, len(times), progress)):
        tracker.advance(times[number], frame)
    return localization_of(tracker.poses(), timestamps)


def flow_there_and_back(
    before: np.ndarray,
    after: np.ndarray,
    start: Float32[np.ndarray, "point 2"],
    window_px: int,
    levels: int,
    guess: Float32[np.ndarray, "point 2"] | None = None,
) -> tuple[Float32[np.ndarray, "point 2"], Float32[np.ndarray, "point"], Bool[np.ndarray, "point"]]:
    """Points' places in the next picture by optical flow (from a guess of them, if any), how far (px) from their start the
    flow back takes them, and which are found both ways, within the picture."""
    options = {"winSize": (window_px, window_px), "maxLevel": levels, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
    first = np.array(start if guess is None else guess)
    end, there, _ = cv2.calcOpticalFlowPyrLK(before, after, start, first, **options)
    first = np.array(end if guess is None else start)
    back, again, _ = cv2.calcOpticalFlowPyrLK(after, before, end, first, **options)
    inside = ((end >= -0.5) & (end < np.array(after.shape[::-1]) - 0.5)).all(-1)
    return end, np.linalg.norm(back - start, axis=-1), (there[:, 0] == 1) & (again[:, 0] == 1) & inside


def _expected(track: _Track) -> Float32[np.ndarray, "landmark 2"]:
    """Where the landmarks are in the next frame if the camera keeps its velocities."""
    last, before = track.fit, track.before
    R = last.R_world_cam @ before.R_world_cam.T @ last.R_world_cam
    ahead = Fit(R, 2 * last.t_world_cam - before.t_world_cam, last.inlier)
    pixels, valid = ahead.project(track.points_world, track.camera)
    return np.where(valid[:, None], pixels, track.pixels).astype(np.float32)


def _drift_m(covariance: Float64[np.ndarray, "6 6"]) -> float:
    return float(np.sqrt(np.trace(covariance[3:, 3:])))


def _agree(track: _Track, fit: Fit, limit_px: float) -> bool:
    """Whether most of the tracked landmarks are where another pose of the camera shows them."""
    return bool(np.median(Matches(track.pixels, track.points_world, track.camera).errors(fit)) < limit_px)


@dataclass(frozen=True, eq=False)
class _Frame:
    """A frame of the video."""

    image: UInt8[np.ndarray, "height width 3"]
    camera: Camera | None
    grey: UInt8[np.ndarray, "height width"]
    """The undistorted picture, reduced for the optical flow."""
    described: Future[Any] | None
    """Its features, of a regular key frame."""


def _read_ahead(
    frames: Iterable[UInt8[np.ndarray, "_ _ 3"]],
    times: list[float],
    camera: Camera | None,
    localizer: Localizer,
    settings: TrackingSettings,
) -> Iterator[_Frame]:
    """Frames, of which one thread reads some ahead and another describes the regular key frames."""
    source, key_time, number = iter(frames), -np.inf, 0

    def read() -> _Frame | None:
        nonlocal key_time, number
        image = next(source, None)
        if image is None:
            return None
        if camera is not None:
            check_size(image, camera, "localization")
        described = None
        if number < len(times) and times[number] - key_time > settings.key_s - 1e-3:
            key_time, described = times[number], describing.submit(localizer.describe, image, camera)
        number += 1
        flat = image
        if camera is not None and camera.is_fisheye:
            flat = undistortion(camera, localizer.settings.horizontal_fov_deg).image(image)
        shrink = min(1.0, settings.max_side / max(flat.shape[:2]))
        size = round(flat.shape[1] * shrink), round(flat.shape[0] * shrink)
        grey = cv2.resize(cv2.cvtColor(flat, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA)
        return _Frame(image, camera, grey, described)

    with ThreadPoolExecutor(1) as describing, ThreadPoolExecutor(1) as reading:
        pending = deque(reading.submit(read) for _ in range(_AHEAD))
        while (frame := pending.popleft().result()) is not None:
            pending.append(reading.submit(read))
            yield frame
