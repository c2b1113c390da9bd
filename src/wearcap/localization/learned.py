"""DISK's keypoints and LightGlue's matches, as kornia has them, with the weights that a user brings.

No weights come with wearcap or are downloaded, and the default needs none. Needs the extra: `pip install "wearcap[learned]"`.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Int64, UInt8
from torch import Tensor, nn

from wearcap.errors import WearcapError
from wearcap.extras import at_first_use, required
from wearcap.files import sha256_of
from wearcap.localization.features import Features
from wearcap.models.weights import load_weights, read_weights

cv2 = at_first_use("cv2", "localisation")

_SMALLEST = 32  # pixels of the shorter side, below which the coarse maps have hardly a cell
_DISK = "https://github.com/cvlab-epfl/disk (depth-save.pth)"
_LIGHTGLUE = "https://github.com/cvg/LightGlue/releases (disk_lightglue.pth)"
_DESCRIPTOR = 128  # numbers of one of DISK's descriptors
_FORMER = re.compile(r"^(self_attn|cross_attn)\.(\d+)\.")  # LightGlue's first release names its layers so


def _kornia() -> Any:
    return required("kornia.feature", "DISK and LightGlue", "take localization=sift, which needs none")


def _read(weights: str | Path | None, part: str, source: str) -> dict[str, Tensor]:
    fix = f"Download them from {source} and set localization.{part}.weights=PATH, or take localization=sift."
    if weights is None:
        raise WearcapError(f"no path of weights is given for the {part}, and none are part of wearcap", fix=fix)
    if not Path(weights).expanduser().is_file():
        raise WearcapError(f"there is no such file of weights for the {part}", where=weights, fix=fix)
    return read_weights(weights)


def _ready(network: nn.Module, tensors: dict[str, Tensor], name: str, weights: str | Path | None, device: str) -> None:
    """Fill a network with weights and move it to its device, for inference only."""
    load_weights(network, tensors, name=name, where=str(weights))
    try:
        network.to(device).eval().requires_grad_(False)
    except (RuntimeError, AssertionError) as error:
        what = f"the device {device!r} cannot be used here"
        raise WearcapError(what, expected="cpu, or cuda on a machine with a GPU") from error


class DiskExtractor:
    """DISK's keypoints (Tyszkiewicz et al. 2020), at most `max_keypoints`, best first.

    `max_side`: larger pictures are searched at a size whose longer side has this many pixels; None: at their own.
    Raises WearcapError for weights that are not there or not DISK's, and without kornia.
    """

    def __init__(
        self, weights: str | Path | None, max_keypoints: int = 4096, max_side: int | None = 1600, device: str = "cpu"
    ):
        if max_keypoints < 1 or (max_side is not None and max_side < _SMALLEST):
            what = f"DISK with {max_keypoints} keypoints, side {max_side}"
            raise WearcapError(what, expected=f"at least one keypoint, at least {_SMALLEST} pixels")
        tensors, self.network = _read(weights, "extractor", _DISK), _kornia().DISK(desc_dim=_DESCRIPTOR)
        _ready(self.network, tensors, "DISK", weights, device)
        self.max_keypoints, self.max_side, self.device = max_keypoints, max_side, device
        self.name = f"disk-{sha256_of(Path(str(weights)).expanduser())[:12]}"

    def __call__(self, image: UInt8[np.ndarray, "height width 3"]) -> Features:
        height, width = image.shape[:2]
        if min(height, width) < _SMALLEST:
            what = f"a picture of {width}×{height} pixels is too small for a network"
            raise WearcapError(what, expected=f"at least {_SMALLEST} pixels a side")
        shrink = 1.0 if self.max_side is None else min(1.0, self.max_side / max(height, width))
        size = max(round(width * shrink), _SMALLEST), max(round(height * shrink), _SMALLEST)
        small = image if shrink == 1 else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        with torch.inference_mode():
            pixels = torch.tensor(small, device=self.device)
            batch = rearrange(pixels, "row column channel -> 1 channel row column").float() / 255
            found = self.network(batch, n=self.max_keypoints, pad_if_not_divisible=True)[0]
        parts = found.keypoints, found.descriptors, found.detection_scores
        keypoints, descriptors, scores = (part.float().cpu().numpy() for part in parts)
        scale = np.array([width / small.shape[1], height / small.shape[0]], np.float32)
        features = Features((keypoints + 0.5) * scale - 0.5, descriptors, scores, (width, height))
        return features.subset(np.argsort(-scores, kind="stable")[: self.max_keypoints].astype(np.int64))


class LightGlueMatcher:
    """Pairs of DISK's keypoints that LightGlue (Lindenberger et al. 2023) matches with more than `min_probability`.

    Raises WearcapError for weights that are not there or not LightGlue's for DISK, and without kornia.
    """

    def __init__(self, weights: str | Path | None, min_probability: float = 0.1, device: str = "cpu"):
        tensors = {_FORMER.sub(r"transformers.\2.\1.", n): v for n, v in _read(weights, "matcher", _LIGHTGLUE).items()}
        # features=None: kornia downloads nothing.
        self.network = _kornia().LightGlue(features=None, input_dim=_DESCRIPTOR, filter_threshold=min_probability)
        tensors.setdefault("confidence_thresholds", self.network.confidence_thresholds)  # constants of the paper
        _ready(self.network, tensors, "LightGlue for DISK", weights, device)
        self.device = device

    def __call__(self, query: Features, other: Features) -> Int64[np.ndarray, "match 2"]:
        if len(query) == 0 or len(other) == 0:
            return np.zeros((0, 2), np.int64)
        images = [self._input(features) for features in (query, other)]
        with torch.inference_mode():
            return self.network({"image0": images[0], "image1": images[1]})["matches"][0].cpu().numpy()

    def _input(self, features: Features) -> dict[str, Tensor]:
        if (count := features.descriptors.shape[1]) != _DESCRIPTOR:
            fix = "Set localization.extractor to DISK, in the map too, or localization.matcher=null."
            raise WearcapError(f"LightGlue cannot pair descriptors of {count} numbers", expected="DISK's 128", fix=fix)
        parts = {"keypoints": features.keypoints, "descriptors": features.descriptors}
        size = torch.tensor([features.size], dtype=torch.float32, device=self.device)
        return {name: torch.from_numpy(part)[None].to(self.device) for name, part in parts.items()} | {
            "image_size": size
        }
