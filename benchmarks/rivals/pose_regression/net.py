"""Pose regression from the recent past of tracked points (AvatarPoser, Jiang et al. 2022), a baseline of HMD²."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from wearcap.models.layers import Normalizer


class _Layer(nn.Module):
    """Attention and MLP, each after a layer norm; with `last` only the last token is a query and an output."""

    def __init__(self, width: int, heads: int, feedforward: int, dropout: float):
        super().__init__()
        self.norm_attention, self.norm_mlp = nn.LayerNorm(width), nn.LayerNorm(width)
        self.attention = nn.MultiheadAttention(width, heads, batch_first=True)
        self.mlp = nn.Sequential(
            nn.Linear(width, feedforward), nn.ReLU(), nn.Dropout(dropout), nn.Linear(feedforward, width)
        )

    def forward(
        self, x: Float[Tensor, "batch token width"], valid: Bool[Tensor, "batch token"], last: bool
    ) -> Float[Tensor, "batch out width"]:
        seen = self.norm_attention(x)
        asking, x = (seen[:, -1:], x[:, -1:]) if last else (seen, x)
        x = x + self.attention(asking, seen, seen, key_padding_mask=~valid, need_weights=False)[0]
        return x + self.mlp(self.norm_mlp(x))


class PoseRegressor(nn.Module):
    """The pose of a window's last frame, by a transformer encoder over the window.

    As in AvatarPoser one small MLP predicts the root's rotation, another the joints'. Positions of tokens are learned
    (AvatarPoser has none, its order of frames shows in the velocities alone). `frames_per_token` > 1 (ours, for CPUs)
    lets neighbouring frames share a token.
    """

    def __init__(
        self,
        feature_size: int,
        motion_size: int,
        window: int = 40,
        width: int = 256,
        layers: int = 3,
        heads: int = 8,
        feedforward: int = 2048,
        dropout: float = 0.1,
        frames_per_token: int = 1,
    ):
        super().__init__()
        if window % frames_per_token:
            raise ValueError(f"a window of {window} frames does not split into tokens of {frames_per_token}")
        self.window, self.frames_per_token = window, frames_per_token
        self.feature_normalizer, self.motion_normalizer = Normalizer(feature_size), Normalizer(motion_size)
        # One more channel marks valid frames: frames before the first would otherwise look like the mean frame.
        self.embed = nn.Linear(frames_per_token * (feature_size + 1), width)
        self.position = nn.Parameter(0.02 * torch.randn(window // frames_per_token, width))
        self.layers = nn.ModuleList(_Layer(width, heads, feedforward, dropout) for _ in range(layers))
        self.norm = nn.LayerNorm(width)
        self.root, self.joints = (
            nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, size)) for size in (6, motion_size - 6)
        )

    def forward(
        self, features: Float[Tensor, "batch window feature"], valid: Bool[Tensor, "batch window"]
    ) -> Float[Tensor, "batch motion"]:
        """6D rotations of the last frame, which must be valid; `features` are not normalised, invalid ones ignored."""
        mask = valid[..., None].to(features.dtype)
        frames = torch.cat([self.feature_normalizer(features) * mask, mask], -1)
        x = self.embed(frames.unflatten(1, (-1, self.frames_per_token)).flatten(2)) + self.position
        token_valid = valid.unflatten(1, (-1, self.frames_per_token)).any(-1)
        for index, layer in enumerate(self.layers):
            x = layer(x, token_valid, last=index == len(self.layers) - 1)
        last = self.norm(x[:, -1])
        return self.motion_normalizer.inverse(torch.cat([self.root(last), self.joints(last)], -1))
