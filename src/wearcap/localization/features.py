"""Local and global features of an image: keypoints with descriptors, VLAD over a vocabulary trained on the map (thesis
eq. 2.1), and the interfaces of extractors and matchers.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int64, UInt8

from wearcap.errors import WearcapError
from wearcap.extras import at_first_use

cv2 = at_first_use("cv2", "localisation")


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


class RootSift:
    """OpenCV's SIFT with the square root of L1-normalised descriptors (RootSIFT): Euclidean then means Hellinger.

    `contrast_threshold`: smaller finds fainter keypoints (OpenCV's default is 0.04). `max_side`: larger pictures
    are searched at a size whose longer side has this many pixels; None: at their own.
    """

    name = "rootsift"

    def __init__(self, max_keypoints: int = 2048, contrast_threshold: float = 0.02, max_side: int | None = None):
        if max_keypoints < 1 or contrast_threshold < 0 or (max_side is not None and max_side < 32):
            what = f"SIFT with {max_keypoints} keypoints, contrast threshold {contrast_threshold}, side {max_side}"
            raise WearcapError(what, expected="at least one keypoint, a threshold of 0 or more, at least 32 pixels")
        self.max_keypoints, self.contrast_threshold, self.max_side = max_keypoints, contrast_threshold, max_side

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
            empty = np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32), np.zeros(0, np.float32)
            return Features(*empty, (width, height))
        pixels = np.array([keypoint.pt for keypoint in found], np.float32)
        scale = np.array([width / gray.shape[1], height / gray.shape[0]], np.float32)
        scores = np.array([keypoint.response for keypoint in found], np.float32)
        features = Features((pixels + 0.5) * scale - 0.5, root(descriptors), scores, (width, height))
        # SIFT returns more than requested where a keypoint has two orientations.
        return features.subset(np.argsort(-scores, kind="stable")[: self.max_keypoints].astype(np.int64))


def root(descriptors: Float32[np.ndarray, "keypoint feature"]) -> Float32[np.ndarray, "keypoint feature"]:
    """RootSIFT of plain SIFT descriptors (Arandjelović and Zisserman 2012): √(d / |d|₁), of unit length."""
    total = np.maximum(descriptors.sum(1, keepdims=True), 1e-12)
    return np.sqrt(descriptors / total)


def _nearest_word(descriptors: torch.Tensor, centers: torch.Tensor) -> torch.Tensor:
    return ((centers**2).sum(1) - 2 * descriptors @ centers.T).argmin(1)


class Vlad:
    """Vector of locally aggregated descriptors (thesis eq. 2.1): sums of the residuals of local descriptors to their
    nearest word, of unit length over all words.

    Each word's sum is made of unit length first, so that a repeated pattern does not drown the others (Arandjelović and
    Zisserman 2013), which is our choice.
    """

    def __init__(self, vocabulary: Float32[np.ndarray, "word feature"]):
        self.vocabulary, self.name = vocabulary, f"vlad{len(vocabulary)}-intra"

    @classmethod
    def trained(cls, descriptors: Float32[np.ndarray, "sample feature"], words: int = 64) -> "Vlad":
        """VLAD over the centres of `words` clusters of local descriptors: k-means from a k-means++ start, always the same.

        Raises WearcapError for fewer descriptors than words.
        """
        if len(descriptors) < words:
            what = f"{len(descriptors)} descriptors for a vocabulary of {words} words"
            fix = "Give more photos, photos with more texture, or fewer words."
            raise WearcapError(what, expected="many more than words", fix=fix)
        random = torch.Generator().manual_seed(0)
        samples = torch.from_numpy(descriptors)
        norms = (samples**2).sum(1)
        centers = torch.empty(words, samples.shape[1])
        distance = torch.full((len(samples),), torch.inf)
        chosen = int(torch.randint(len(samples), (1,), generator=random))
        for word in range(words):
            centers[word] = samples[chosen]
            distance = torch.minimum(distance, (norms - 2 * samples @ centers[word] + norms[chosen]).clamp(min=0))
            chosen = int(torch.multinomial(distance + 1e-12, 1, generator=random))
        for _ in range(15):
            nearest = _nearest_word(samples, centers)
            total = torch.zeros_like(centers).index_add_(0, nearest, samples)
            count = torch.bincount(nearest, minlength=words)[:, None]
            centers = torch.where(count > 0, total / count.clamp(min=1), centers)
        return cls(centers.numpy())

    def aggregate(self, descriptors: Float32[np.ndarray, "keypoint feature"]) -> Float32[np.ndarray, "global"]:
        """Global descriptor of a picture by its local ones; zeros without any."""
        centers, local = torch.from_numpy(self.vocabulary), torch.from_numpy(descriptors)
        word = _nearest_word(local, centers)
        total = torch.zeros_like(centers).index_add_(0, word, local - centers[word])
        total = torch.nn.functional.normalize(total, dim=1)
        return torch.nn.functional.normalize(total.flatten(), dim=0).numpy()


def most_similar(
    query: Float32[np.ndarray, "feature"], database: Float32[np.ndarray, "image feature"], count: int = 40
) -> Int64[np.ndarray, "image_rank"]:
    """Indices of the `count` images with the largest cosine to the query, best first (descriptors of unit length)."""
    similarity = database @ query
    count = min(count, len(database))
    best = np.argpartition(-similarity, count - 1)[:count] if count else np.zeros(0, np.int64)
    return best[np.argsort(-similarity[best], kind="stable")].astype(np.int64)
