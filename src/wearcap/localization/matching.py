"""Matching of query keypoints to landmarks: nearest descriptors, with a ratio test that ignores the same place."""

import numpy as np
import torch
from jaxtyping import Float32, Int64

from wearcap.geometry.compiled import compiled

_KEPT = 4
"""Number of best landmarks per keypoint that are kept for the ratio test."""


def match_landmarks(
    query: Float32[np.ndarray, "keypoint feature"],
    descriptors: Float32[np.ndarray, "landmark feature"],
    positions: Float32[np.ndarray, "landmark 3"],
    *,
    max_ratio: float = 0.85,
    same_m: float = 0.05,
    tile: int = 1024,
) -> Int64[np.ndarray, "match 2"]:
    """Mutually nearest (keypoint, landmark) pairs whose distance is below `max_ratio` times the next place's.

    Landmarks within `same_m` of the nearest one are the same place seen differently: they do not count against it.
    Descriptors have unit length.
    """
    if not len(query) or not len(descriptors):
        return np.zeros((0, 2), np.int64)
    best = np.full((len(query), _KEPT), -2.0, np.float32)
    number = np.full((len(query), _KEPT), -1, np.int64)
    reverse, reverse_best = np.full(len(descriptors), -1), np.full(len(descriptors), -2.0, np.float32)
    rows = torch.from_numpy(np.ascontiguousarray(query))
    for start in range(0, len(descriptors), tile):
        similarity = rows @ torch.from_numpy(descriptors[start : start + tile]).T
        _keep_best(similarity.numpy(), start, best, number, reverse_best, reverse)
    nearest = number[:, 0]
    apart = np.linalg.norm(positions[number] - positions[nearest][:, None], axis=-1) > same_m
    apart &= number >= 0
    rival = np.where(apart, best, -np.inf).max(1)
    rival = np.where(np.isfinite(rival), rival, best[:, -1])  # at least as far as the last one kept
    distance, rival_distance = (np.sqrt(np.maximum(2 - 2 * s, 0)) for s in (best[:, 0], rival))
    keep = (reverse[nearest] == np.arange(len(query))) & (distance < max_ratio * rival_distance)
    chosen = np.flatnonzero(keep)
    return np.stack([chosen, nearest[chosen]], 1)


def match_nearby(
    query: Float32[np.ndarray, "keypoint feature"],
    descriptors: Float32[np.ndarray, "landmark feature"],
    near: Int64[np.ndarray, "pair 2"],
    min_cosine: float,
) -> Int64[np.ndarray, "match 2"]:
    """Most similar landmark of each keypoint among candidate (keypoint, landmark) pairs, if similar enough."""
    cosine = np.einsum("pf,pf->p", query[near[:, 0]], descriptors[near[:, 1]])
    near, cosine = near[cosine >= min_cosine], cosine[cosine >= min_cosine]
    near = near[np.argsort(-cosine, kind="stable")]
    _, first = np.unique(near[:, 0], return_index=True)
    near = near[np.sort(first)]
    _, first = np.unique(near[:, 1], return_index=True)
    return near[first]


@compiled
def _keep_best(similarity, offset, best, number, reverse_best, reverse):
    """Merge one tile of similarities into each row's list of the largest and each column's largest."""
    kept = best.shape[1]
    for row in range(similarity.shape[0]):
        worst = best[row, kept - 1]
        for column in range(similarity.shape[1]):
            value = similarity[row, column]
            if value > reverse_best[offset + column]:
                reverse_best[offset + column] = value
                reverse[offset + column] = row
            if value > worst:
                place = kept - 1
                while place > 0 and best[row, place - 1] < value:
                    best[row, place] = best[row, place - 1]
                    number[row, place] = number[row, place - 1]
                    place -= 1
                best[row, place] = value
                number[row, place] = offset + column
                worst = best[row, kept - 1]
