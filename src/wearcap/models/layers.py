"""Blocks shared by the transformers: rotary attention, adaptive layer norm, level embedding."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional as F

from wearcap.errors import require_choice


@dataclass(frozen=True)
class TransformerSize:
    """A stack of transformer blocks."""

    width: int
    layers: int
    heads: int
    feedforward: int
    dropout: float


class LevelEmbedding(nn.Module):
    """Sinusoids of a noise level in [0, 1], then a two-layer MLP."""

    frequencies: Tensor

    def __init__(self, width: int, sinusoids: int = 128):
        super().__init__()
        scale = torch.exp(torch.linspace(0, math.log(1000.0), sinusoids // 2))
        self.register_buffer("frequencies", scale, persistent=False)
        self.mlp = nn.Sequential(nn.Linear(sinusoids, width), nn.SiLU(), nn.Linear(width, width))

    def forward(self, level: Float[Tensor, "batch #token"]) -> Float[Tensor, "batch #token width"]:
        angle = level[..., None] * self.frequencies
        return self.mlp(torch.cat([angle.sin(), angle.cos()], -1))


class _RotaryAttention(nn.Module):
    """Multi-head self-attention with rotary positions (Su et al. 2021), fused by PyTorch."""

    cos: Tensor
    sin: Tensor

    def __init__(self, width: int, heads: int, max_tokens: int, streams: int = 1):
        """Tokens of the same index in each of `streams` concatenated sequences share a position."""
        super().__init__()
        if width % (2 * heads):
            raise ValueError(f"width {width} must be a multiple of twice the number of heads ({heads})")
        self.heads = heads
        self.qkv = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)
        half = width // heads // 2
        angle = torch.outer(torch.arange(max_tokens), 10000.0 ** (-torch.arange(half) / half))
        angle = angle.repeat(streams, 1, 1)
        self.register_buffer("cos", angle.cos(), persistent=False)
        self.register_buffer("sin", angle.sin(), persistent=False)

    def _rotate(self, x: Float[Tensor, "batch head token depth"]) -> Float[Tensor, "batch head token depth"]:
        first, second = x.chunk(2, -1)
        count = x.shape[-2] // len(self.cos)
        cos, sin = (table[:, :count].flatten(0, 1).to(x.dtype) for table in (self.cos, self.sin))
        return torch.cat([first * cos - second * sin, first * sin + second * cos], -1)

    def forward(
        self, x: Float[Tensor, "batch token width"], mask: Bool[Tensor, "batch 1 token token"]
    ) -> Float[Tensor, "batch token width"]:
        batch, tokens, width = x.shape
        q, k, v = self.qkv(x).view(batch, tokens, 3, self.heads, -1).permute(2, 0, 3, 1, 4)
        attended = attention(self._rotate(q), self._rotate(k), v, mask)
        return self.out(attended.transpose(1, 2).reshape(batch, tokens, width))


def attention(
    q: Float[Tensor, "batch head token depth"],
    k: Float[Tensor, "batch head token depth"],
    v: Float[Tensor, "batch head token depth"],
    mask: Bool[Tensor, "batch 1 token token"],
) -> Float[Tensor, "batch head token depth"]:
    """PyTorch's fused attention, but for bfloat16 on a CPU, where the gradient of plain products is four times as fast."""
    if not (q.device.type == "cpu" and q.requires_grad and v.dtype == torch.bfloat16):
        return F.scaled_dot_product_attention(q, k, v, mask)
    score = (q * q.shape[-1] ** -0.5) @ k.mT
    return score.masked_fill(~mask, -torch.inf).softmax(-1) @ v


def attention_mask(valid: Bool[Tensor, "batch token"]) -> Bool[Tensor, "batch 1 token token"]:
    """Attention mask: all tokens attend to the valid ones, padding also to itself, since an empty row gives NaN."""
    number = torch.arange(valid.shape[1], device=valid.device)
    return valid[:, None, None, :] | (number == number[:, None])


class AdaptiveBlock(nn.Module):
    """A DiT block (Peebles & Xie 2023): attention and MLP, each scaled, shifted and gated by the level."""

    def __init__(self, width: int, heads: int, feedforward: int, max_tokens: int, dropout: float, streams: int = 1):
        super().__init__()
        self.norm_attention = nn.LayerNorm(width, elementwise_affine=False)
        self.norm_mlp = nn.LayerNorm(width, elementwise_affine=False)
        self.attention = _RotaryAttention(width, heads, max_tokens, streams)
        self.mlp = nn.Sequential(
            nn.Linear(width, feedforward), nn.GELU(), nn.Dropout(dropout), nn.Linear(feedforward, width)
        )
        self.modulation = nn.Linear(width, 6 * width)
        nn.init.zeros_(self.modulation.weight)
        nn.init.zeros_(self.modulation.bias)

    def plan(self, level: Float[Tensor, "batch #token width"]) -> Float[Tensor, "batch #token modulation"]:
        """Shifts, scales and gates, which depend on the noise level alone."""
        return self.modulation(F.silu(level))

    def forward(
        self,
        x: Float[Tensor, "batch token width"],
        plan: Float[Tensor, "#batch #token modulation"],
        mask: Bool[Tensor, "batch 1 token token"],
    ) -> Float[Tensor, "batch token width"]:
        shift_a, scale_a, gate_a, shift_m, scale_m, gate_m = plan.chunk(6, -1)
        x = x + gate_a * self.attention(self.norm_attention(x) * (1 + scale_a) + shift_a, mask)
        return x + gate_m * self.mlp(self.norm_mlp(x) * (1 + scale_m) + shift_m)


class MixingBlock(nn.Module):
    """A block of AGRoL's MLP (Du et al. 2023): a linear layer across the tokens, then one across the channels, each after
    a layer norm and around a skip connection; the embedded level, if there is one, is added to the block's input."""

    def __init__(self, width: int, max_tokens: int, has_level: bool = True):
        super().__init__()
        self.level = nn.Linear(width, width) if has_level else nn.Identity()
        self.norm_tokens, self.norm_channels = nn.LayerNorm(width), nn.LayerNorm(width)
        self.tokens, self.channels = nn.Linear(max_tokens, max_tokens), nn.Linear(width, width)

    def plan(self, level: Float[Tensor, "batch #token width"]) -> Float[Tensor, "batch #token width"]:
        """What the noise level adds."""
        return self.level(F.silu(level))

    def forward(
        self,
        x: Float[Tensor, "batch token width"],
        plan: Float[Tensor, "#batch #token width"],
        mask: Bool[Tensor, "batch 1 token token"],
    ) -> Float[Tensor, "batch token width"]:
        count, x = x.shape[1], x + plan
        # Padding is what not all tokens attend to; shorter windows use the first tokens' weights.
        valid = mask[:, 0].all(1)[..., None].to(x.dtype)
        mixed = self.tokens.weight[:count, :count] @ (self.norm_tokens(x) * valid) + self.tokens.bias[:count, None]
        x = x + F.silu(mixed)
        return x + F.silu(self.channels(self.norm_channels(x)))


def denoiser_block(
    mixing: str, size: TransformerSize, max_tokens: int, streams: int = 1
) -> AdaptiveBlock | MixingBlock:
    """A block of a denoiser, whose tokens see each other by "attention", or in an "mlp" without heads, feedforward
    and dropout. Raises WearcapError for other ways."""
    require_choice(mixing, ("attention", "mlp"), f"a denoiser has no mixing {mixing!r}")
    if mixing == "mlp":
        return MixingBlock(size.width, max_tokens * streams)
    return AdaptiveBlock(size.width, size.heads, size.feedforward, max_tokens, size.dropout, streams)


class Normalizer(nn.Module):
    """Standardises features by mean and scale, which are stored with the weights in a checkpoint."""

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
    """A learned weighted mean of neighbouring frames, with the same weights for all features; padding is ignored."""

    def __init__(self, frames: int, spread: float = 1.5):
        """`frames` (odd) are blended; the weights start as a Gaussian of `spread` frames."""
        super().__init__()
        offset = torch.arange(frames) - frames // 2
        self.weight = nn.Parameter(-0.5 * (offset / spread) ** 2)

    def forward(
        self, x: Float[Tensor, "batch time feature"], valid: Bool[Tensor, "batch time"]
    ) -> Float[Tensor, "batch time feature"]:
        kernel = self.weight.softmax(0)
        # A matrix over frames is much faster on the CPU than a depthwise convolution.
        frame = torch.arange(x.shape[1], device=x.device)
        place = frame - frame[:, None] + len(kernel) // 2
        near = (place >= 0) & (place < len(kernel))
        band = (kernel[place.clamp(0, len(kernel) - 1)] * near).to(x.dtype)
        mask = valid.to(x.dtype)[..., None]
        return band @ (x * mask) / (band @ mask).clamp_min(1e-3)


class Widening(nn.Conv1d):
    """A strided convolution over frames with one output per token, as one matrix product (much faster on the CPU)."""

    def __init__(self, size: int, width: int, frames_per_token: int, context: int = 0, bias: bool = True):
        """Each token covers its own frames and `context` frames before and after them."""
        super().__init__(size, width, frames_per_token + 2 * context, frames_per_token, context, bias=bias)

    def forward(self, frames: Float[Tensor, "batch time feature"]) -> Float[Tensor, "batch token width"]:
        padded = F.pad(frames, (0, 0, self.padding[0], self.padding[0]))
        seen = padded.unfold(1, self.kernel_size[0], self.stride[0])
        return F.linear(seen.flatten(-2), self.weight.flatten(1), self.bias)


class MotionEncoder(nn.Module):
    """Encodes x_t as one vector per token, with a learned scale that depends on its noise level (ours).

    If x_t is concatenated with the conditions instead, its noise at high levels hides them: the network then needs
    several times the training steps to infer the gait from the head.
    """

    def __init__(self, size: int, width: int, frames_per_token: int):
        super().__init__()
        self.frames_per_token = frames_per_token
        self.linear = nn.Linear(frames_per_token * size, width)
        self.worth = nn.Linear(width, width)
        nn.init.zeros_(self.worth.weight)
        nn.init.zeros_(self.worth.bias)

    def plan(self, level: Float[Tensor, "batch #token width"]) -> Float[Tensor, "batch #token width"]:
        """The scale of the encoded x_t at a noise level, per channel."""
        return 1 + self.worth(F.silu(level))

    def forward(
        self,
        x_t: Float[Tensor, "batch time motion"],
        worth: Float[Tensor, "#batch #token width"],
        valid: Bool[Tensor, "batch time"],
    ) -> Float[Tensor, "batch token width"]:
        batch, time, _ = x_t.shape
        tokens = (x_t * valid[..., None]).reshape(batch, time // self.frames_per_token, -1)
        return self.linear(tokens) * worth
