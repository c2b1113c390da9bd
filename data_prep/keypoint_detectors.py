"""Detectors of body joints in videos: their interface, one that replays recorded detections, and one of the wearer's
wrists in head camera images by MediaPipe's hand landmarker, an optional package whose model is a file that the user has.

Recorded keypoints are CSV: timestamp (s), joint, x, y (pixels) or x, y, z (m, in the world), confidence (0…1). A row is one
joint at one time, in any order. A file holds pixels or 3D positions, not both.
"""

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, UInt8

from wearcap.body.hands import MEDIAPIPE, in_layout
from wearcap.body.skeleton import SIDES
from wearcap.errors import WearcapError
from wearcap.extras import required
from wearcap.io.formats.csv_table import read_columns, read_header
from wearcap.recording.recording import Cue, FingerStream

MODEL_VARIABLE = "WEARCAP_HANDS_MODEL"
"""Environment variable with the path of `hand_landmarker.task`."""
WRIST = 0
"""Index of the wrist among MediaPipe's 21 landmarks."""
SIDE_PULL = 2.0
"""Prior from the image side: logit of being the left hand at the image's left border."""


class Keypoint(NamedTuple):
    """One joint in a picture (pixels, centres at integers)."""

    x: float
    y: float
    confidence: float
    """0…1."""


@runtime_checkable
class Detector(Protocol):
    """Detects joints in the images of one video, called in their order."""

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of all detectable joints, as in the skeleton."""
        ...

    def __call__(self, picture: UInt8[np.ndarray, "height width 3"], time_s: float) -> dict[str, Keypoint]:
        """The detected joints; others are absent."""
        ...


class RecordedDetections:
    """Replays recorded detections: for each image those nearest in time."""

    def __init__(self, cues: Mapping[str, Cue], within_s: float):
        """`within_s`: largest time difference between a detection and its image.

        Raises WearcapError for cues that are no pixels.
        """
        for cue in cues.values():
            if cue.points.shape[-1] != 2:
                raise WearcapError(f"{cue.joint!r} has {cue.points.shape[-1]} coordinates", expected="2: pixels")
        self._within_s = within_s
        self._cues = {
            cue.joint: (cue.timestamps.numpy(), cue.points.numpy(), cue.confidence.numpy())
            for cue in cues.values()
            if len(cue.timestamps)
        }

    @property
    def joints(self) -> tuple[str, ...]:
        return tuple(self._cues)

    def __call__(self, picture: UInt8[np.ndarray, "height width 3"], time_s: float) -> dict[str, Keypoint]:
        found = {}
        for joint, (times, points, confidence) in self._cues.items():
            after = int(np.searchsorted(times, time_s).clip(max=len(times) - 1))
            row = min((max(after - 1, 0), after), key=lambda k: abs(times[k] - time_s))
            if abs(times[row] - time_s) <= self._within_s:
                found[joint] = Keypoint(*points[row].tolist(), confidence[row].item())
        return found


class _Hand(NamedTuple):
    """One detected hand."""

    x: float
    """Horizontal wrist position, as a share of the image's width."""
    y: float
    """Vertical wrist position, as a share of the image's height."""
    left: float
    """Probability that it is a left hand."""
    points: Float[np.ndarray, "point 3"] | None = None
    """The 21 landmarks (m) in camera axes, from the hand's middle."""


class MediaPipeHands:
    """Wrists, and fingers, of up to two hands, tracked by MediaPipe from image to image: one object per video."""

    joints = ("left_wrist", "right_wrist")

    def __init__(self, model: str | Path | None = None, min_confidence: float = 0.5):
        """`model`: `hand_landmarker.task`; None: the file that $WEARCAP_HANDS_MODEL names.

        Raises WearcapError when the package or the model is missing, or the model is no such file.
        """
        self._mediapipe = required("mediapipe", "detector=mediapipe", "take detector=recorded, which needs none")
        self._seen: list[tuple[float, dict[str, _Hand]]] = []
        vision, path = self._mediapipe.tasks.vision, find_model(model)
        options = vision.HandLandmarkerOptions(
            base_options=self._mediapipe.tasks.BaseOptions(model_asset_path=str(path)),
            running_mode=vision.RunningMode.VIDEO,
            num_hands=2,
            min_hand_detection_confidence=min_confidence,
            min_hand_presence_confidence=min_confidence,
            min_tracking_confidence=min_confidence,
        )
        try:
            self._landmarker: Any = vision.HandLandmarker.create_from_options(options)
        except (ValueError, RuntimeError, OSError) as error:
            what = f"not a model that MediaPipe can run ({' '.join(str(error).split())[:200]})"
            raise WearcapError(what, where=path, expected="hand_landmarker.task", fix="Download it again.") from error

    def __call__(self, picture: UInt8[np.ndarray, "height width 3"], time_s: float) -> dict[str, Keypoint]:
        image = self._mediapipe.Image(image_format=self._mediapipe.ImageFormat.SRGB, data=np.ascontiguousarray(picture))
        result = self._landmarker.detect_for_video(image, round(1000 * time_s))
        hands = []
        for marks, side, places in zip(result.hand_landmarks, result.handedness, result.hand_world_landmarks):
            # MediaPipe names the person's own side in a picture that is not mirrored, as a head camera's is.
            left = side[0].score if side[0].category_name == "Left" else 1.0 - side[0].score
            points = np.array([(place.x, place.y, place.z) for place in places], np.float32)
            hands.append(_Hand(marks[WRIST].x, marks[WRIST].y, left, points))
        (height, width), found = picture.shape[:2], wearers_hands(hands)
        self._seen.append((time_s, {joint.split("_")[0]: hand for joint, (hand, _) in found.items()}))
        return {
            joint: Keypoint(hand.x * width - 0.5, hand.y * height - 0.5, sure) for joint, (hand, sure) in found.items()
        }

    def fingers(self) -> dict[str, FingerStream]:
        """The hands by side in all images so far, as far as they were found."""
        nothing, times = np.full((21, 3), np.nan), torch.tensor([at for at, _ in self._seen], dtype=torch.float64)
        streams = {}
        for side in SIDES:
            rows = [found[side].points if side in found else nothing for _, found in self._seen]
            points = in_layout(torch.tensor(np.array(rows), dtype=torch.float32).reshape(-1, 21, 3), MEDIAPIPE)
            valid = points[:, 0, 0].isfinite()
            streams[side] = FingerStream(times, points, valid, valid.float())
        return {side: stream for side, stream in streams.items() if stream.valid.any()}


def wearers_hands(hands: Sequence[_Hand]) -> dict[str, tuple[_Hand, float]]:
    """Which of up to two hands is the wearer's left wrist and which the right, and how sure that is (0…1).

    A wearer sees their left hand rather on the left: that adds to what the hand looks like. Two hands are never one side's.
    """
    votes = []
    for hand in hands:
        left = min(max(hand.left, 1e-3), 1 - 1e-3)
        votes.append(math.log(left / (1 - left)) + SIDE_PULL * (1 - 2 * min(max(hand.x, 0.0), 1.0)))
    if len(hands) == 1:
        votes.append(-votes[0])
    if not hands:
        return {}
    first = "left_wrist" if votes[0] >= votes[1] else "right_wrist"
    second = "right_wrist" if first == "left_wrist" else "left_wrist"
    sure = 1 / (1 + math.exp(-abs(votes[0] - votes[1]) / 2))
    return {joint: (hand, sure) for joint, hand in zip((first, second), hands)}


def find_model(given: str | Path | None) -> Path:
    """The file given, else the one that `MODEL_VARIABLE` names. Raises WearcapError when there is none."""
    named = given or os.environ.get(MODEL_VARIABLE)
    if not named or not Path(named).expanduser().is_file():
        raise WearcapError(
            "there is no model of MediaPipe's hands",
            where=named or f"${MODEL_VARIABLE}",
            expected="hand_landmarker.task",
            fix="Download it from https://ai.google.dev/edge/mediapipe/solutions/vision/hand_landmarker and give "
            f"model=PATH or set {MODEL_VARIABLE}, or take detector=recorded.",
        )
    return Path(named).expanduser()


_AXES = "xyz"
_MAX_PLACE = 1e9
"""Largest coordinate (m or pixels); larger numbers need not be finite as float32."""


def read_keypoints(path: str | Path) -> dict[str, Cue]:
    """Cues by joint, with rising times. Rows with a confidence of 0 carry no information and are dropped.

    Raises WearcapError for a missing column, a field that is no number, a time, place or confidence that cannot be one,
    and a joint that occurs twice at one time. Whether a skeleton has the joints is not checked here.
    """
    axes = list(_AXES if "z" in read_header(path) else _AXES[:2])
    table = read_columns(path, ["timestamp", *axes, "confidence"], text=["joint"])
    times, confidence = table["timestamp"], table["confidence"]
    points = np.stack([table[axis] for axis in axes], -1)
    joints = np.char.strip(np.char.decode(table["joint"], "latin-1"))
    observed = confidence != 0
    for wrong, what, expected in (
        (~np.isfinite(times), "a timestamp that is no time", "seconds"),
        (~((confidence >= 0) & (confidence <= 1)), "a confidence that is none", "0 to 1"),
        (observed & ~(np.abs(points) <= _MAX_PLACE).all(-1), "a place that is none", "numbers, or a confidence of 0"),
        (joints == "", "no joint", "a joint's name"),
    ):
        if wrong.any():
            raise WearcapError(what, where=f"{path}, row {int(wrong.argmax()) + 1} after the header", expected=expected)
    cues = {}
    for joint in map(str, np.unique(joints[observed])):
        rows = np.flatnonzero(observed & (joints == joint))
        rows = rows[np.argsort(times[rows], kind="stable")]
        twice = rows[1:][np.diff(times[rows]) == 0]
        if len(twice):
            what = f"{joint!r} is twice at {times[twice[0]]:.6f} s"
            raise WearcapError(what, where=path, expected="one row per joint and time")
        place, sure = (torch.from_numpy(part[rows]).float() for part in (points, confidence))
        cues[joint] = Cue(torch.from_numpy(times[rows]), joint, place, sure)
    return cues
