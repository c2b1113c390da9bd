"""Image retrieval: VLAD over a vocabulary trained on the map (thesis eq. 2.1)."""

import numpy as np
import torch
from jaxtyping import Float32, Int64, UInt8

from wearcap.errors import WearcapError
from wearcap.localization.features import Features


def train_vocabulary(
    descriptors: Float32[np.ndarray, "sample feature"], words: int = 64, iterations: int = 15, seed: int = 0
) -> Float32[np.ndarray, "word feature"]:
    """Centres of `words` clusters of local descriptors: k-means from a k-means++ start, the same for the same seed.

    Raises WearcapError for fewer descriptors than words.
    """
    if len(descriptors) < words:
        raise WearcapError(
            f"{len(descriptors)} descriptors for a vocabulary of {words} words",
            expected="many more than words",
            fix="Give more photos, photos with more texture, or fewer words.",
        )
    random = torch.Generator().manual_seed(seed)
    samples = torch.from_numpy(descriptors)
    norms = (samples**2).sum(1)
    centers = torch.empty(words, samples.shape[1])
    distance = torch.full((len(samples),), torch.inf)
    chosen = int(torch.randint(len(samples), (1,), generator=random))
    for word in range(words):
        centers[word] = samples[chosen]
        distance = torch.minimum(distance, (norms - 2 * samples @ centers[word] + norms[chosen]).clamp(min=0))
        chosen = int(torch.multinomial(distance + 1e-12, 1, generator=random))
    for _ in range(iterations):
        nearest = _nearest_word(samples, centers)
        total = torch.zeros_like(centers).index_add_(0, nearest, samples)
        count = torch.bincount(nearest, minlength=words)[:, None]
        centers = torch.where(count > 0, total / count.clamp(min=1), centers)
    return centers.numpy()


def _nearest_word(descriptors: torch.Tensor, centers: torch.Tensor) -> torch.Tensor:
    return ((centers**2).sum(1) - 2 * descriptors @ centers.T).argmin(1)


class Vlad:
    """Vector of locally aggregated descriptors (thesis eq. 2.1).

    Sum of the residuals of local descriptors to their nearest word, of unit length over all words. `intra`: each
    word's residuals are made of unit length first, so that a repeated pattern does not drown the others (Arandjelović
    and Zisserman 2013); `signed_root`: each number is replaced by its signed square root. Both are ours to choose.
    """

    def __init__(self, vocabulary: Float32[np.ndarray, "word feature"], intra: bool = True, signed_root: bool = False):
        self.vocabulary, self.intra, self.signed_root = vocabulary, intra, signed_root
        self.name = f"vlad{len(vocabulary)}{'-intra' if intra else ''}{'-root' if signed_root else ''}"

    def __call__(
        self, image: UInt8[np.ndarray, "height width 3"], features: Features
    ) -> Float32[np.ndarray, "feature"]:
        """Global descriptor; `image` is not used. Zeros for an image without features."""
        return self.aggregate(features.descriptors)

    def aggregate(self, descriptors: Float32[np.ndarray, "keypoint feature"]) -> Float32[np.ndarray, "global"]:
        centers, local = torch.from_numpy(self.vocabulary), torch.from_numpy(descriptors)
        word = _nearest_word(local, centers)
        total = torch.zeros_like(centers).index_add_(0, word, local - centers[word])
        if self.intra:
            total = torch.nn.functional.normalize(total, dim=1)
        if self.signed_root:
            total = total.sign() * total.abs().sqrt()
        return torch.nn.functional.normalize(total.flatten(), dim=0).numpy()


def most_similar(
    query: Float32[np.ndarray, "feature"], database: Float32[np.ndarray, "image feature"], count: int = 40
) -> Int64[np.ndarray, "image_rank"]:
    """Indices of the `count` images with the largest cosine to the query, best first (descriptors of unit length)."""
    similarity = database @ query
    count = min(count, len(database))
    best = np.argpartition(-similarity, count - 1)[:count] if count else np.zeros(0, np.int64)
    return best[np.argsort(-similarity[best], kind="stable")].astype(np.int64)
