"""Keypoints that a detector missed, tracked by optical flow from earlier and later detections (MocapEvery §3.4).

Each missing keypoint is tracked forwards from its last detection and backwards from its next; both tracks are blended,
weighted towards the nearer detection. Video frames pass through a buffer as long as the longest track.
"""

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, UInt8
from torch import Tensor

from data_prep.keypoint_detectors import Detector, Keypoint
from wearcap.errors import WearcapError
from wearcap.extras import at_first_use
from wearcap.localization.landmark_tracking import flow_there_and_back
from wearcap.recording.recording import Cue

cv2 = at_first_use("cv2", "keypoints' optical flow")

APART_AT_MOST = 4.0
"""Multiple of `apart_px` beyond which two tracks do not follow the same point."""


@dataclass(frozen=True)
class FlowSettings:
    """Settings of the tracking, and when a track ends."""

    reach: int = 15
    """Largest number of frames from a detection; 0: detections only."""
    window_px: int = 21
    levels: int = 3
    """Pyramid levels, for large displacements."""
    return_px: float = 1.0
    """Largest forward-backward error of a step."""
    likeness: float = 0.6
    """Smallest correlation of the patch around a track with the patch around its detection."""
    apart_px: float = 3.0
    """Distance of the two tracks that halves the confidence."""

    def __post_init__(self):
        if self.reach < 0 or self.window_px < 3 or self.levels < 0:
            what = f"flow over {self.reach} frames in windows of {self.window_px} px with {self.levels} levels"
            raise WearcapError(what, expected="0 frames or more, 3 px or more, 0 levels or more")


class _Spotted(NamedTuple):
    """All keypoints of one frame (pixels); a confidence of 0 where there is none."""

    pixels: Float32[np.ndarray, "keypoint 2"]
    confidence: Float32[np.ndarray, "keypoint"]


@dataclass(frozen=True, eq=False)
class _Track:
    """Tracked position of each keypoint (NaN where lost), and the detection that it started from."""

    pixels: Float32[np.ndarray, "keypoint 2"]
    age: Float32[np.ndarray, "keypoint"]
    """Frames since the detection."""
    trust: Float32[np.ndarray, "keypoint"]
    """The detection's confidence."""
    look: Float32[np.ndarray, "keypoint row column"]
    """Image patch around the detection."""

    @property
    def there(self) -> Bool[np.ndarray, "keypoint"]:
        return np.isfinite(self.pixels[:, 0])

    def where(self, chosen: Bool[np.ndarray, "keypoint"], other: "_Track") -> "_Track":
        """The chosen keypoints of this track, the rest of another."""
        pairs = zip(vars(self).values(), vars(other).values())
        return _Track(*(np.where(chosen.reshape(-1, *[1] * (a.ndim - 1)), a, b) for a, b in pairs))


@dataclass(eq=False)
class _Frame:
    grey: UInt8[np.ndarray, "height width"]
    found: Bool[np.ndarray, "keypoint"]
    forward: _Track
    backward: _Track


class KeypointFlow:
    """Consumes a video's frames one by one and returns each, in order, once later frames cannot change it."""

    def __init__(self, joints: Sequence[str], settings: FlowSettings = FlowSettings()):
        self.joints, self.settings = tuple(joints), settings
        self._frames: deque[_Frame] = deque()
        count, side = len(self.joints), settings.window_px
        none = np.full(count, np.nan, np.float32)
        self._nowhere = _Track(np.stack([none, none], -1), none, none, np.zeros((count, side, side), np.float32))

    def advance(self, picture: UInt8[np.ndarray, "height width 3"], found: Mapping[str, Keypoint]) -> list[_Spotted]:
        """Frames that are final now, none to one."""
        grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
        rows = [found.get(joint, Keypoint(np.nan, np.nan, 0.0)) for joint in self.joints]
        table = np.array(rows, np.float32).reshape(-1, 3)
        table[~(np.isfinite(table).all(-1) & (table[:, 2] > 0))] = np.nan
        pixels, trust = table[:, :2].copy(), table[:, 2].copy()
        there = np.isfinite(trust)
        look = self._nowhere.look.copy()
        look[there] = _patches(grey, pixels[there], self.settings.window_px)
        detected = _Track(pixels, np.where(there, 0, np.nan).astype(np.float32), trust, look)
        forward = self._nowhere
        if self._frames:
            last = self._frames[-1]
            if grey.shape != last.grey.shape:
                raise WearcapError(
                    f"a picture of {grey.shape[1]}x{grey.shape[0]} pixels after one of "
                    f"{last.grey.shape[1]}x{last.grey.shape[0]}",
                    expected="a video of one size",
                )
            forward = _followed(_without(last.forward, detected.there), last.grey, grey, self.settings)
        forward = detected.where(detected.there, forward)
        self._frames.append(_Frame(grey, detected.there, forward, self._nowhere))
        # Detections are tracked backwards through the frames that lack them.
        track = detected
        for later, earlier in pairwise(reversed(self._frames)):
            track = _without(track, earlier.found)
            if not track.there.any():
                break
            track = _followed(track, later.grey, earlier.grey, self.settings)
            earlier.backward = track.where(track.there, earlier.backward)
        ready = len(self._frames) > self.settings.reach
        return [_blended(self._frames.popleft(), self.settings)] if ready else []

    def finish(self) -> list[_Spotted]:
        """Return the remaining frames."""
        remaining = [_blended(frame, self.settings) for frame in self._frames]
        self._frames.clear()
        return remaining


def tracked_cues(
    pictures: Iterable[UInt8[np.ndarray, "height width 3"]],
    timestamps: Float64[Tensor, "time"],
    detector: Detector,
    settings: FlowSettings = FlowSettings(),
) -> dict[str, Cue]:
    """Cues of all joints that are detected in a video or tracked from detections; each holds only the frames at which
    its joint was observed.

    Raises WearcapError when there are not as many pictures as timestamps.
    """
    flow, times = KeypointFlow(detector.joints, settings), timestamps.tolist()
    spotted, count = list[_Spotted](), 0
    for count, picture in enumerate(pictures, 1):
        if count > len(times):
            break
        spotted += flow.advance(picture, detector(picture, times[count - 1]))
    spotted += flow.finish()
    if count != len(times):
        what = f"{'more' if count > len(times) else count} pictures for {len(times)} timestamps"
        raise WearcapError(what, expected="a picture for each timestamp of the camera")
    if not spotted:
        return {}
    pixels, confidence = (torch.from_numpy(np.stack(part, 1)) for part in zip(*spotted))
    return {
        joint: Cue(timestamps[sure > 0], joint, where[sure > 0], sure[sure > 0])
        for joint, where, sure in zip(flow.joints, pixels, confidence)
        if (sure > 0).any()
    }


def _without(track: _Track, ended: Bool[np.ndarray, "keypoint"]) -> _Track:
    return replace(track, pixels=np.where(ended[:, None], np.float32(np.nan), track.pixels))


def _followed(track: _Track, before: np.ndarray, after: np.ndarray, settings: FlowSettings) -> _Track:
    """Advance tracks by one frame; lost and too old ones end."""
    rows = np.flatnonzero(track.there & (track.age < settings.reach))
    pixels = np.full_like(track.pixels, np.nan)
    if len(rows):
        start = track.pixels[rows]
        end, off_px, found = flow_there_and_back(before, after, start, settings.window_px, settings.levels)
        # Correlation coefficient of the patches; 0 for flat ones
        looks = (_patches(after, end, settings.window_px), track.look[rows])
        a, b = (look - look.mean((1, 2), keepdims=True) for look in looks)
        scale = np.sqrt((a**2).sum((1, 2)) * (b**2).sum((1, 2)))
        same = (a * b).sum((1, 2)) / np.maximum(scale, 1e-6) >= settings.likeness
        good = found & (off_px <= settings.return_px) & same
        pixels[rows[good]] = end[good]
    return replace(track, pixels=pixels, age=track.age + 1)


def _patches(
    grey: np.ndarray, pixels: Float32[np.ndarray, "keypoint 2"], side: int
) -> Float32[np.ndarray, "keypoint row column"]:
    """The squares around keypoints, between pixels where these are."""
    if not len(pixels):
        return np.zeros((0, side, side), np.float32)
    offset = np.arange(side, dtype=np.float32) - (side - 1) / 2
    y, x = (
        pixels[:, axis, None, None] + grid for axis, grid in zip((1, 0), np.meshgrid(offset, offset, indexing="ij"))
    )
    maps = (part.reshape(-1, side).astype(np.float32) for part in (x, y))
    found = cv2.remap(grey, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return found.reshape(-1, side, side).astype(np.float32)


def _blended(frame: _Frame, settings: FlowSettings) -> _Spotted:
    """Blend both directions, weighted towards the nearer detection; confidence decreases with the distance (frames) to
    the detections and with the distance (px) between the tracks."""
    tracks = (frame.forward, frame.backward)
    there = np.stack([track.there for track in tracks])
    age = np.where(there, np.stack([track.age for track in tracks]), 1.0)
    share = there / np.maximum(age, 1e-6)
    share = share / np.maximum(share.sum(0), 1e-9)
    where = np.where(there[..., None], np.stack([track.pixels for track in tracks]), 0.0)
    sure = np.where(there, np.stack([track.trust for track in tracks]) * (1 - age / (settings.reach + 1)), 0.0)
    apart = np.where(there.all(0), np.linalg.norm(where[0] - where[1], axis=-1), 0.0)
    confidence = (share * sure).sum(0) / (1 + (apart / settings.apart_px) ** 2)
    confidence[apart > APART_AT_MOST * settings.apart_px] = 0.0
    return _Spotted((share[..., None] * where).sum(0).astype(np.float32), confidence.clip(0, 1).astype(np.float32))
