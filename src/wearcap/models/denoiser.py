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
        # As a matrix over frames: on the CPU much faster than a convolution of so many channels one by one.
        frame = torch.arange(x.shape[1], device=x.device)
        place = frame - frame[:, None] + len(kernel) // 2
        near = (place >= 0) & (place < len(kernel))
        band = (kernel[place.clamp(0, len(kernel) - 1)] * near).to(x.dtype)
        mask = valid.to(x.dtype)[..., None]
        return band @ (x * mask) / (band @ mask).clamp_min(1e-3)


class ConditionEncoder(nn.Module):
    """Narrows the conditions to one vector per token by an MLP (thesis §6.2).

    It sees `context` frames before the token's own and as many behind them (ours): a stride shows in half a second of
    a head's sway, not in one frame.
    """

    def __init__(self, size: int, width: int, frames_per_token: int, context: int):
        super().__init__()
        # One more channel says which frames exist: padding would else look like the mean condition.
        span = frames_per_token + 2 * context
        self.widen = nn.Conv1d(size + 1, 2 * width, span, frames_per_token, context)
        self.narrow = nn.Linear(2 * width, width)

    def forward(
        self, condition: Float[Tensor, "batch time condition"], valid: Bool[Tensor, "batch time"]
    ) -> Float[Tensor, "batch token width"]:
        mask = valid[..., None].to(condition.dtype)
        frames = torch.cat([condition * mask, mask], -1)
        return self.narrow(F.gelu(self.widen(frames.transpose(1, 2))).transpose(1, 2))


class MotionEncoder(nn.Module):
    """x_t as one vector per token, scaled by what its noise level makes it worth (ours).

    Concatenated with the conditions instead, the noise of high levels drowns them: the network then needs several
    times the steps to read the gait from the head.
    """

    def __init__(self, size: int, width: int, frames_per_token: int):
        super().__init__()
        self.frames_per_token = frames_per_token
        self.linear = nn.Linear(frames_per_token * size, width)
        self.worth = nn.Linear(width, width)
        nn.init.zeros_(self.worth.weight)
        nn.init.zeros_(self.worth.bias)

    def forward(
        self,
        x_t: Float[Tensor, "batch time motion"],
        level: Float[Tensor, "batch #token width"],
        valid: Bool[Tensor, "batch time"],
    ) -> Float[Tensor, "batch token width"]:
        batch, time, _ = x_t.shape
        tokens = (x_t * valid[..., None]).reshape(batch, time // self.frames_per_token, -1)
        return self.linear(tokens) * (1 + self.worth(F.silu(level)))


class MotionDenoiser(nn.Module):
    """x̂0 = D(x_t, c, level): one token per frame (or per few frames) through adaptive transformer blocks.

    A token is the sum of what the condition and x_t say about its frames; where x_t joins the conditions the document
    leaves open. `frames_per_token` > 1 is ours: neighbouring frames share a token, which cuts the cost of a window
    about as many times; `blend` > 0 (ours too) mixes that many neighbouring frames of x̂0, which removes the seams
    between tokens and most of an unfinished network's jitter.
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
        context: int = 14,
    ):
        super().__init__()
        if window % frames_per_token:
            raise ValueError(f"a window of {window} frames does not split into tokens of {frames_per_token}")
        self.window, self.frames_per_token = window, frames_per_token
        self.motion_size, self.condition_size = motion_size, condition_size
        self.motion_normalizer = Normalizer(motion_size)
        self.condition_normalizer = Normalizer(condition_size)
        self.condition_encoder = ConditionEncoder(condition_size, width, frames_per_token, context)
        self.motion_encoder = MotionEncoder(motion_size, width, frames_per_token)
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
        token_valid = valid.view(batch, time // k, k).any(-1)
        token_level = level if level.shape[1] == 1 else level.view(batch, time // k, k).mean(-1)
        embedded = self.level(token_level)
        token = self.condition_encoder(self.condition_normalizer(condition), valid)
        token = token + self.motion_encoder(x_t, embedded, valid)
        for block in self.blocks:
            token = block(token, embedded, token_valid)
        x0_hat = self.head(self.norm(token)).reshape(batch, time, -1)
        return x0_hat if self.blend is None else self.blend(x0_hat, valid)
