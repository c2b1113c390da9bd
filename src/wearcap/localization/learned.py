"""SuperPoint, LightGlue and NetVLAD behind the protocols of `features.py`, with the weights that a user brings.

No weights come with wearcap, and the default needs none: these are choices of the config.
"""

from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, Int64, UInt8
from torch import Tensor, nn

from wearcap.errors import WearcapError
from wearcap.files import sha256_of
from wearcap.localization.features import Features
from wearcap.models.lightglue import LightGlue, mutual_matches, renamed
from wearcap.models.netvlad import NetVLAD
from wearcap.models.superpoint import SuperPoint
from wearcap.models.weights import load_weights, read_weights

_SMALLEST = 32  # pixels of the shorter side, below which the coarse maps have hardly a cell

_SUPERPOINT = (
    "SuperPoint's weights are licensed by Magic Leap and are not part of wearcap",
    "Read the licence, download superpoint_v1.pth from "
    "https://github.com/magicleap/SuperPointPretrainedNetwork "
    "and set localization.extractor.weights=PATH, or take localization=sift, which needs no weights.",
)
_LIGHTGLUE = (
    "LightGlue's weights are not part of wearcap",
    "Download superpoint_lightglue.pth from https://github.com/cvg/LightGlue/releases "
    "and set localization.matcher.weights=PATH, or set localization.matcher=null to match without it.",
)
_NETVLAD = (
    "NetVLAD's weights are not part of wearcap",
    "Download a VGG16 checkpoint of https://github.com/Nanne/pytorch-NetVlad "
    "(or Patch-NetVLAD's, with whitening) and set localization.descriptor.weights=PATH, "
    "or set localization.descriptor=null to take VLAD, which needs no weights.",
)


def _read(weights: str | Path | None, absent: tuple[str, str]) -> dict[str, Tensor]:
    what, fix = absent
    if weights is None:
        raise WearcapError(f"no path of weights is given: {what}", fix=fix)
    if not Path(weights).expanduser().is_file():
        raise WearcapError(f"there is no such file. {what}", where=weights, fix=fix)
    return read_weights(weights)


def _load(network: nn.Module, tensors: dict[str, Tensor], name: str, weights: str | Path | None, device: str) -> None:
    """Fill a network with weights and move it to its device, for inference only."""
    load_weights(network, tensors, name=name, where=str(weights))
    try:
        network.to(device).eval().requires_grad_(False)
    except (RuntimeError, AssertionError) as error:
        what = f"the device {device!r} cannot be used here"
        raise WearcapError(what, expected="cpu, or cuda on a machine with a GPU") from error


def _shrunk(image: UInt8[np.ndarray, "height width *channel"], max_side: int | None) -> np.ndarray:
    height, width = image.shape[:2]
    if min(height, width) < _SMALLEST:
        what = f"a picture of {width}×{height} pixels is too small for a network"
        raise WearcapError(what, expected=f"at least {_SMALLEST} pixels a side")
    shrink = 1.0 if max_side is None else max_side / max(height, width)
    if shrink >= 1:
        return image
    size = (max(round(width * shrink), _SMALLEST), max(round(height * shrink), _SMALLEST))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


class SuperPointExtractor:
    """SuperPoint's keypoints of a score above `threshold`, at most `max_keypoints`, best first.

    `max_side`: larger pictures are searched at a size whose longer side has this many pixels; None: at their own.
    Raises WearcapError for weights that are not there or not SuperPoint's.
    """

    def __init__(
        self,
        weights: str | Path | None,
        max_keypoints: int = 4096,
        threshold: float = 0.005,
        nms_radius: int = 4,
        max_side: int | None = 1600,
        device: str = "cpu",
    ):
        if max_keypoints < 1 or not 0 <= threshold < 1 or nms_radius < 0:
            what = f"SuperPoint with {max_keypoints} keypoints, threshold {threshold}, radius {nms_radius}"
            raise WearcapError(what, expected="at least one keypoint, a threshold in [0, 1), a radius of 0 or more")
        tensors = _read(weights, _SUPERPOINT)
        self.network, self.device = SuperPoint(nms_radius, border=4, max_keypoints=max_keypoints), device
        _load(self.network, tensors, "SuperPoint", weights, device)
        self.threshold, self.max_side = threshold, max_side
        self.name = f"superpoint-{sha256_of(Path(str(weights)).expanduser())[:12]}"

    def __call__(self, image: UInt8[np.ndarray, "height width 3"]) -> Features:
        height, width = image.shape[:2]
        gray = _shrunk(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), self.max_side)
        with torch.inference_mode():
            batch = torch.from_numpy(gray)[None, None].to(self.device).float() / 255
            keypoints, descriptors, scores = (x[0].cpu().numpy() for x in self.network(batch))
        scale = np.array([width / gray.shape[1], height / gray.shape[0]], np.float32)
        features = Features((keypoints + 0.5) * scale - 0.5, descriptors, scores, (width, height))
        return features.subset(scores > self.threshold)


class LightGlueMatcher:
    """Pairs that LightGlue holds for the same point with more than `min_probability`.

    `stop_confidence`: layers end when this share of keypoints is sure; None: always all nine.
    Raises WearcapError for weights that are not there or not LightGlue's for SuperPoint.
    """

    def __init__(
        self,
        weights: str | Path | None,
        min_probability: float = 0.1,
        stop_confidence: float | None = 0.95,
        device: str = "cpu",
    ):
        tensors = renamed(_read(weights, _LIGHTGLUE))
        self.network, self.device = LightGlue(stop_confidence=stop_confidence), device
        _load(self.network, tensors, "LightGlue for SuperPoint", weights, device)
        self.min_probability = min_probability

    def _inputs(self, features: Features) -> tuple[Tensor, Tensor, Tensor]:
        return (
            torch.from_numpy(features.keypoints)[None].to(self.device),
            torch.from_numpy(features.descriptors)[None].to(self.device),
            torch.tensor([features.size], dtype=torch.float32, device=self.device),
        )

    def __call__(self, query: Features, other: Features) -> Int64[np.ndarray, "match 2"]:
        if len(query) == 0 or len(other) == 0:
            return np.zeros((0, 2), np.int64)
        for features in (query, other):
            if features.descriptors.shape[1] != self.network.width:
                what = f"LightGlue cannot pair descriptors of {features.descriptors.shape[1]} numbers"
                fix = "Set localization.extractor to SuperPoint, in the map too, or take another matcher."
                raise WearcapError(what, expected=f"SuperPoint's {self.network.width}", fix=fix)
        with torch.inference_mode():
            scores = self.network(*self._inputs(query), *self._inputs(other))
            partner = mutual_matches(scores, self.min_probability)[0][0].cpu().numpy()
        matched = np.flatnonzero(partner >= 0)
        return np.stack([matched, partner[matched]], 1)


class NetVladDescriptor:
    """NetVLAD of a picture whose longer side is shrunk to `max_side` pixels; whitened if the weights hold a PCA.

    Raises WearcapError for weights that are not there or not NetVLAD's over VGG16.
    """

    def __init__(self, weights: str | Path | None, max_side: int | None = 1024, device: str = "cpu"):
        tensors = _read(weights, _NETVLAD)
        network = NetVLAD(
            clusters=_rows(tensors.get("pool.centroids"), 64),
            whitened=_rows(tensors.get("WPCA.0.weight"), 0),
            bias="pool.conv.bias" in tensors,
        )
        _load(network, tensors, "NetVLAD over VGG16", weights, device)
        self.network, self.device, self.max_side = network, device, max_side
        self.name = f"netvlad-{sha256_of(Path(str(weights)).expanduser())[:12]}"

    def __call__(
        self, image: UInt8[np.ndarray, "height width 3"], features: Features
    ) -> Float32[np.ndarray, "feature"]:
        """`features` are not looked at."""
        small = _shrunk(image, self.max_side)
        with torch.inference_mode():
            batch = torch.from_numpy(small).to(self.device).permute(2, 0, 1)[None].float() / 255
            return self.network(batch)[0].cpu().numpy()


def _rows(tensor: Float[Tensor, "..."] | None, default: int) -> int:
    return default if tensor is None or tensor.ndim == 0 else tensor.shape[0]
