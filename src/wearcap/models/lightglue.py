"""LightGlue (Lindenberger, Sarlin & Pollefeys 2023): matches keypoints of two images.

Modules carry the names of the published weights (`superpoint_lightglue.pth`); `renamed` turns the release's older
names into them.
"""

import math
import re
from collections import OrderedDict

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F


def normalized(
    keypoints: Float[Tensor, "batch keypoint 2"], size: Float[Tensor, "batch 2"]
) -> Float[Tensor, "batch keypoint 2"]:
    """Pixels relative to the centre of an image of `size` (width, height), in halves of its longer side."""
    return (keypoints - size[:, None] / 2) / (size.amax(-1)[:, None, None] / 2)


def _rotate(
    x: Float[Tensor, "batch head keypoint depth"], turn: Float[Tensor, "2 batch 1 keypoint pair"]
) -> Float[Tensor, "batch head keypoint depth"]:
    """Pairs of neighbouring features rotated by the keypoint's angles."""
    cos, sin = turn
    even, odd = x.unflatten(-1, (-1, 2)).unbind(-1)
    return torch.stack([even * cos - odd * sin, odd * cos + even * sin], -1).flatten(-2)


class RotaryPosition(nn.Module):
    """Angles linear in a keypoint's position (eq. 7), so that attention depends on relative positions only."""

    def __init__(self, depth: int):
        super().__init__()
        self.Wr = nn.Linear(2, depth // 2, bias=False)
        nn.init.normal_(self.Wr.weight)

    def forward(self, place: Float[Tensor, "batch keypoint 2"]) -> Float[Tensor, "2 batch 1 keypoint pair"]:
        """Cosines, then sines."""
        angle = self.Wr(place)[:, None]
        return torch.stack([angle.cos(), angle.sin()])


def _feedforward(width: int) -> nn.Sequential:
    """MLP of a token concatenated with its message."""
    return nn.Sequential(
        nn.Linear(2 * width, 2 * width), nn.LayerNorm(2 * width), nn.GELU(), nn.Linear(2 * width, width)
    )


class SelfBlock(nn.Module):
    """Self-attention: each keypoint attends to those of its own image."""

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.heads = heads
        self.Wqkv = nn.Linear(width, 3 * width)
        self.out_proj = nn.Linear(width, width)
        self.ffn = _feedforward(width)

    def forward(
        self, x: Float[Tensor, "batch keypoint width"], turn: Float[Tensor, "2 batch 1 keypoint pair"]
    ) -> Float[Tensor, "batch keypoint width"]:
        # In the published weights q, k and v of a feature are adjacent.
        q, k, v = self.Wqkv(x).unflatten(-1, (self.heads, -1, 3)).transpose(1, 2).unbind(-1)
        seen = F.scaled_dot_product_attention(_rotate(q, turn), _rotate(k, turn), v)
        message = self.out_proj(seen.transpose(1, 2).flatten(-2))
        return x + self.ffn(torch.cat([x, message], -1))


class _CrossBlock(nn.Module):
    """Cross-attention: each keypoint attends to those of the other image; keys and queries share one projection."""

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.heads = heads
        self.to_qk = nn.Linear(width, width)
        self.to_v = nn.Linear(width, width)
        self.to_out = nn.Linear(width, width)
        self.ffn = _feedforward(width)

    def _split(self, x: Float[Tensor, "batch keypoint width"]) -> Float[Tensor, "batch head keypoint depth"]:
        return x.unflatten(-1, (self.heads, -1)).transpose(1, 2)

    def _updated(
        self, x: Float[Tensor, "batch keypoint width"], seen: Float[Tensor, "batch head keypoint depth"]
    ) -> Float[Tensor, "batch keypoint width"]:
        return x + self.ffn(torch.cat([x, self.to_out(seen.transpose(1, 2).flatten(-2))], -1))

    def forward(
        self, x0: Float[Tensor, "batch keypoint0 width"], x1: Float[Tensor, "batch keypoint1 width"]
    ) -> tuple[Float[Tensor, "batch keypoint0 width"], Float[Tensor, "batch keypoint1 width"]]:
        key0, key1 = self._split(self.to_qk(x0)), self._split(self.to_qk(x1))
        value0, value1 = self._split(self.to_v(x0)), self._split(self.to_v(x1))
        seen0 = F.scaled_dot_product_attention(key0, key1, value1)
        seen1 = F.scaled_dot_product_attention(key1, key0, value0)
        return self._updated(x0, seen0), self._updated(x1, seen1)


class MatchAssignment(nn.Module):
    """Soft partial assignment (eq. 8-9): dual softmax of similarity, times both keypoints' matchability."""

    def __init__(self, width: int):
        super().__init__()
        self.matchability = nn.Linear(width, 1)
        self.final_proj = nn.Linear(width, width)

    def forward(
        self, x0: Float[Tensor, "batch keypoint0 width"], x1: Float[Tensor, "batch keypoint1 width"]
    ) -> Float[Tensor, "batch keypoint0 keypoint1"]:
        """Log of the probability that a pair is the same point."""
        scale = x0.shape[-1] ** 0.25
        similarity = (self.final_proj(x0) / scale) @ (self.final_proj(x1) / scale).transpose(1, 2)
        matchable = F.logsigmoid(self.matchability(x0)) + F.logsigmoid(self.matchability(x1)).transpose(1, 2)
        return similarity.log_softmax(2) + similarity.log_softmax(1) + matchable


def mutual_matches(
    log_assignment: Float[Tensor, "batch keypoint0 keypoint1"], threshold: float
) -> tuple[Int[Tensor, "batch keypoint0"], Float[Tensor, "batch keypoint0"]]:
    """The match in the second image of every keypoint of the first (-1: none), and its probability.

    A match is the best of its row and of its column and more probable than `threshold`.
    """
    best, partner = log_assignment.max(2)
    back = log_assignment.argmax(1).gather(1, partner)
    probability = best.exp()
    own = torch.arange(partner.shape[1], device=partner.device)
    matched = (back == own) & (probability > threshold)
    return torch.where(matched, partner, -1), torch.where(matched, probability, 0)


class LightGlue(nn.Module):
    """Nine layers of self- and cross-attention over two sets of keypoints with descriptors.

    `stop_confidence` (eq. 11): stop after the first layer where more than this share of the keypoints is confident;
    None runs all layers, which export needs. The paper's pruning of keypoints is not implemented.
    """

    def __init__(self, width: int = 256, layers: int = 9, heads: int = 4, stop_confidence: float | None = 0.95):
        super().__init__()
        self.width, self.stop_confidence = width, stop_confidence
        self.posenc = RotaryPosition(width // heads)
        self.transformers = nn.ModuleList(
            nn.ModuleDict({"self_attn": SelfBlock(width, heads), "cross_attn": _CrossBlock(width, heads)})
            for _ in range(layers)
        )
        self.log_assignment = nn.ModuleList(MatchAssignment(width) for _ in range(layers))
        # Confidence of a keypoint that further layers will not change its match (eq. 10).
        self.token_confidence = nn.ModuleList(
            nn.Sequential(OrderedDict(token=nn.Sequential(nn.Linear(width, 1), nn.Sigmoid())))
            for _ in range(layers - 1)
        )

    def forward(
        self,
        keypoints0: Float[Tensor, "batch keypoint0 2"],
        descriptors0: Float[Tensor, "batch keypoint0 width"],
        size0: Float[Tensor, "batch 2"],
        keypoints1: Float[Tensor, "batch keypoint1 2"],
        descriptors1: Float[Tensor, "batch keypoint1 width"],
        size1: Float[Tensor, "batch 2"],
    ) -> Float[Tensor, "batch keypoint0 keypoint1"]:
        """Log of the probability that a pair is the same point; keypoints in pixels, `size` is (width, height)."""
        turn0, turn1 = self.posenc(normalized(keypoints0, size0)), self.posenc(normalized(keypoints1, size1))
        x0, x1 = descriptors0, descriptors1
        depth = 0
        for depth, layer in enumerate(self.transformers):
            assert isinstance(layer, nn.ModuleDict)
            x0, x1 = layer["self_attn"](x0, turn0), layer["self_attn"](x1, turn1)
            x0, x1 = layer["cross_attn"](x0, x1)
            if self.stop_confidence is None or depth == len(self.token_confidence):
                continue
            confidence = torch.cat([self.token_confidence[depth](x)[..., 0] for x in (x0, x1)], 1)
            needed = 0.8 + 0.1 * math.exp(-4 * depth / len(self.transformers))
            if bool((confidence >= needed).float().mean() > self.stop_confidence):
                break
        return self.log_assignment[depth](x0, x1)


def renamed(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """The release's names as this module's: `self_attn.3.…` was once what is now `transformers.3.self_attn.…`.

    Later releases also save the thresholds of stopping, which are constants of the paper: dropped.
    """
    pattern = re.compile(r"^(self_attn|cross_attn)\.(\d+)\.")
    return {
        pattern.sub(r"transformers.\2.\1.", name): value
        for name, value in tensors.items()
        if name != "confidence_thresholds"
    }
