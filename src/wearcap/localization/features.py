"""Local features of an image: keypoints and descriptors; interfaces of extractors, matchers and global descriptors."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int64, UInt8

from wearcap.errors import WearcapError


@dataclass(frozen=True, eq=False)
class Features:
    """Keypoints of one picture (pixels, centres at integers) and their descriptors of unit length."""

    keypoints: Float32[np.ndarray, "keypoint 2"]
    descriptors: Float32[np.ndarray, "keypoint feature"]
    scores: Float32[np.ndarray, "keypoint"]
    """The extractor's own strength of each keypoint; larger is better."""
    size: tuple[int, int]
    """Width and height (pixels) of the picture."""

    def __len__(self) -> int:
        return len(self.keypoints)

    def subset(self, chosen: Bool[np.ndarray, "keypoint"] | Int64[np.ndarray, "chosen"]) -> "Features":
        """The chosen keypoints, in their order."""
        return Features(self.keypoints[chosen], self.descriptors[chosen], self.scores[chosen], self.size)


@runtime_checkable
class Extractor(Protocol):
    """Detects and describes keypoints. Extractors with the same name give comparable descriptors."""

    @property
    def name(self) -> str: ...

    def __call__(self, image: UInt8[np.ndarray, "height width 3"]) -> Features: ...


@runtime_checkable
class Matcher(Protocol):
    """Pairs the keypoints of two pictures: rows (number in `query`, number in `other`), one per pair."""

    def __call__(self, query: Features, other: Features) -> Int64[np.ndarray, "match 2"]: ...


@runtime_checkable
class GlobalDescriptor(Protocol):
    """Describes an image by one vector of unit length; similar places have a large dot product."""

    @property
    def name(self) -> str: ...

    def __call__(
        self, image: UInt8[np.ndarray, "height width 3"], features: Features
    ) -> Float32[np.ndarray, "feature"]: ...


class RootSift:
    """OpenCV's SIFT with the square root of L1-normalised descriptors (RootSIFT): Euclidean then means Hellinger.

    `contrast_threshold`: smaller finds fainter keypoints (OpenCV's default is 0.04). `max_side`: larger pictures
    are searched at a size whose longer side has this many pixels; None: at their own.
    """

    name = "rootsift"

    def __init__(self, max_keypoints: int = 2048, contrast_threshold: float = 0.02, max_side: int | None = None):
        if max_keypoints < 1 or contrast_threshold < 0 or (max_side is not None and max_side < 32):
            raise WearcapError(
                f"SIFT with {max_keypoints} keypoints, contrast threshold {contrast_threshold}, side {max_side}",
                expected="at least one keypoint, a threshold of 0 or more, at least 32 pixels",
            )
        self.max_keypoints, self.contrast_threshold, self.max_side = (max_keypoints, contrast_threshold, max_side)

    def __call__(self, image: UInt8[np.ndarray, "height width 3"]) -> Features:
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        height, width = gray.shape
        shrink = 1.0 if self.max_side is None else min(1.0, self.max_side / max(height, width))
        if shrink < 1:
            gray = cv2.resize(gray, (round(width * shrink), round(height * shrink)), interpolation=cv2.INTER_AREA)
        # precise upscaling: without it every keypoint lies a quarter of a pixel off
        sift = cv2.SIFT.create(
            self.max_keypoints, contrastThreshold=self.contrast_threshold, enable_precise_upscale=True
        )
        found, descriptors = sift.detectAndCompute(gray, None)
        if not found:
            return Features(*_nothing(), (width, height))
        pixels = np.array([keypoint.pt for keypoint in found], np.float32)
        scale = np.array([width / gray.shape[1], height / gray.shape[0]], np.float32)
        scores = np.array([keypoint.response for keypoint in found], np.float32)
        features = Features((pixels + 0.5) * scale - 0.5, root(descriptors), scores, (width, height))
        return features.subset(_strongest(scores, self.max_keypoints))


def root(descriptors: Float32[np.ndarray, "keypoint feature"]) -> Float32[np.ndarray, "keypoint feature"]:
    """RootSIFT of plain SIFT descriptors (Arandjelović and Zisserman 2012): √(d / |d|₁), of unit length."""
    total = np.maximum(descriptors.sum(1, keepdims=True), 1e-12)
    return np.sqrt(descriptors / total)


def _strongest(scores: np.ndarray, count: int) -> np.ndarray:
    """Indices of the strongest keypoints (SIFT returns more than requested where one has two orientations)."""
    return np.argsort(-scores, kind="stable")[:count].astype(np.int64)


def _nothing() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32), np.zeros(0, np.float32)
