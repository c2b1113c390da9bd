"""Blocks shared by the transformers: rotary attention, adaptive layer norm, level embedding."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional as F


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


class RotaryAttention(nn.Module):
    """Multi-head self-attention with rotary positions (Su et al. 2021), fused by PyTorch."""

    cos: Tensor
    sin: Tensor

    def __init__(self, width: int, heads: int, max_tokens: int, streams: int = 1):
        """Of `streams`, one behind the other, tokens of one number share a position."""
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
        attended = F.scaled_dot_product_attention(self._rotate(q), self._rotate(k), v, mask)
        return self.out(attended.transpose(1, 2).reshape(batch, tokens, width))


def attention_mask(valid: Bool[Tensor, "batch token"]) -> Bool[Tensor, "batch 1 token token"]:
    """Who may see whom: all see what is valid. A row with nothing to see would be NaN: padding may always see itself."""
    number = torch.arange(valid.shape[1], device=valid.device)
    return valid[:, None, None, :] | (number == number[:, None])


class AdaptiveBlock(nn.Module):
    """A DiT block (Peebles & Xie 2023): attention and MLP, each scaled, shifted and gated by the level."""

    def __init__(
        self, width: int, heads: int, feedforward: int, max_tokens: int, dropout: float, streams: int = 1
    ):
        super().__init__()
        self.norm_attention = nn.LayerNorm(width, elementwise_affine=False)
        self.norm_mlp = nn.LayerNorm(width, elementwise_affine=False)
        self.attention = RotaryAttention(width, heads, max_tokens, streams)
        self.mlp = nn.Sequential(
            nn.Linear(width, feedforward), nn.GELU(), nn.Dropout(dropout), nn.Linear(feedforward, width)
        )
        self.modulation = nn.Linear(width, 6 * width)
        nn.init.zeros_(self.modulation.weight)
        nn.init.zeros_(self.modulation.bias)

    def plan(self, level: Float[Tensor, "batch #token width"]) -> Float[Tensor, "batch #token modulation"]:
        """Shifts, scales and gates: what of the block depends on the level alone."""
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
