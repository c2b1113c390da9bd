"""The conditional motion denoiser of HMD² (thesis §6.2): a DiT/EDGE-like transformer that predicts x0."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional as F

from wearcap.models.layers import AdaptiveBlock, LevelEmbedding


class Normalizer(nn.Module):
    """Per-feature mean and scale, kept with the weights so that a checkpoint carries its own statistics."""

    mean: Tensor
    scale: Tensor

    def __init__(self, size: int):
        super().__init__()
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("scale", torch.ones(size))

    def set(self, mean: Float[Tensor, "feature"], scale: Float[Tensor, "feature"]) -> None:
        self.mean.copy_(mean)
        self.scale.copy_(scale)

    def forward(self, x: Float[Tensor, "*batch feature"]) -> Float[Tensor, "*batch feature"]:
        return (x - self.mean) / self.scale

    def inverse(self, x: Float[Tensor, "*batch feature"]) -> Float[Tensor, "*batch feature"]:
        return x * self.scale + self.mean


class TemporalBlend(nn.Module):
    """A learned weighted mean of neighbouring frames, the same for all features; it never looks at padding."""

    def __init__(self, frames: int, spread: float = 1.5):
        """`frames` (odd) are blended; the weights start as a Gaussian of `spread` frames."""
        super().__init__()
        offset = torch.arange(frames) - frames // 2
        self.weight = nn.Parameter(-0.5 * (offset / spread) ** 2)

    def forward(
        self, x: Float[Tensor, "batch time feature"], valid: Bool[Tensor, "batch time"]
    ) -> Float[Tensor, "batch time feature"]:
        kernel = self.weight.softmax(0)
        mask = valid.to(x.dtype)[..., None]

        def mixed(value: Tensor) -> Tensor:
            rows = value.transpose(1, 2).flatten(0, 1)[:, None]
            blended = F.conv1d(rows, kernel.to(rows.dtype)[None, None], padding=len(kernel) // 2)
            return blended.view(x.shape[0], -1, x.shape[1]).transpose(1, 2)

        return mixed(x * mask) / mixed(mask).clamp_min(1e-3)


class MotionDenoiser(nn.Module):
    """x̂0 = D(x_t, c, level): one token per frame (or per few frames) through adaptive transformer blocks.

    x_t and the condition of every frame are concatenated and narrowed by an MLP to one token (thesis §6.2);
    where x_t joins the conditions the document leaves open. `frames_per_token` > 1 is ours: neighbouring frames
    share a token, which cuts the cost of a window about as many times; `blend` > 0 (ours too) mixes that many
    neighbouring frames of x̂0, which removes the seams between tokens and most of an unfinished network's jitter.
    """

    def __init__(
        self,
        motion_size: int,
        condition_size: int,
        window: int = 240,
        width: int = 512,
        layers: int = 8,
        heads: int = 8,
        feedforward: int = 1024,
        dropout: float = 0.1,
        frames_per_token: int = 1,
        blend: int = 0,
    ):
        super().__init__()
        if window % frames_per_token:
            raise ValueError(f"a window of {window} frames does not split into tokens of {frames_per_token}")
        self.window, self.frames_per_token = window, frames_per_token
        self.motion_size, self.condition_size = motion_size, condition_size
        self.motion_normalizer = Normalizer(motion_size)
        self.condition_normalizer = Normalizer(condition_size)
        token_input = frames_per_token * (motion_size + condition_size)
        self.narrow = nn.Sequential(nn.Linear(token_input, 2 * width), nn.GELU(), nn.Linear(2 * width, width))
        self.level = LevelEmbedding(width)
        self.blocks = nn.ModuleList(
            AdaptiveBlock(width, heads, feedforward, window // frames_per_token, dropout)
            for _ in range(layers)
        )
        self.norm = nn.LayerNorm(width)
        self.head = nn.Linear(width, frames_per_token * motion_size)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)
        self.blend = TemporalBlend(blend) if blend else None

    def forward(
        self,
        x_t: Float[Tensor, "batch time motion"],
        level: Float[Tensor, "batch #time"],
        condition: Float[Tensor, "batch time condition"],
        valid: Bool[Tensor, "batch time"],
    ) -> Float[Tensor, "batch time motion"]:
        """x̂0 in normalised motion space; `condition` is raw, `valid` is False on padding."""
        batch, time, _ = x_t.shape
        k = self.frames_per_token
        frames = torch.cat([x_t, self.condition_normalizer(condition)], -1) * valid[..., None]
        token = self.narrow(frames.reshape(batch, time // k, -1))
        token_valid = valid.view(batch, time // k, k).any(-1)
        token_level = level if level.shape[1] == 1 else level.view(batch, time // k, k).mean(-1)
        embedded = self.level(token_level)
        for block in self.blocks:
            token = block(token, embedded, token_valid)
        x0_hat = self.head(self.norm(token)).reshape(batch, time, -1)
        return x0_hat if self.blend is None else self.blend(x0_hat, valid)
