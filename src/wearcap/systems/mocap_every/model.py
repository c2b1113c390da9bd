"""MocapEvery's two-stage estimator (§3.3): end-effectors first, then contacts, then the body; and one MLP in its place (ours)."""

from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from wearcap.body.skeleton import FEET
from wearcap.models.layers import MixingBlock, Normalizer, TemporalBlend, TransformerSize, attention_mask
from wearcap.runtime.graphs import Graph

ENDS_SIZE = 12
"""Size of the positions of two hands and two feet."""


class Estimate(NamedTuple):
    """Predictions for the last frames of a window (all of them, or the last one only)."""

    motion: Float[Tensor, "batch predicted motion"]
    """Root translation and 6D rotations in the window's canonical frame."""
    contact_logit: Float[Tensor, "batch predicted foot"]
    ends: Float[Tensor, "batch predicted 12"] | None
    """Positions of hands and feet predicted by the first stage (m); None for a single-stage network."""


class WatchEstimator(nn.Module):
    """Interface of the networks that predict body motion from windows of sensor features."""

    window: int
    """Number of frames of an input window."""

    def forward(self, features: Float[Tensor, "batch window feature"]) -> Estimate:
        """Predict from raw (not normalised) features."""
        raise NotImplementedError

    def graph(self, size: int) -> Graph:
        """The network as a graph of unnormalised features, `size` per frame."""
        normalizer: Any = self.feature_normalizer
        random = torch.Generator().manual_seed(0)
        noise = torch.randn(2, self.window, size, generator=random)
        return Graph(_EstimatorOutput(self), {"features": normalizer.mean.cpu() + normalizer.scale.cpu() * noise})


class TwoStageEstimator(WatchEstimator):
    """Two transformer encoders in sequence (the paper: width 1280, 4 layers, 10 heads, MLP heads of 256).

    `multi_stage=False` (the paper's ablation) leaves out the first encoder. Position embeddings are learned.
    `frames_per_token` > 1 (ours, for CPUs) packs neighbouring frames into one token.
    """

    def __init__(
        self,
        feature_size: int,
        motion_size: int,
        window: int,
        transformer: TransformerSize,
        hidden: int,
        multi_stage: bool = True,
        frames_per_token: int = 1,
        blend: int = 0,
    ):
        """`blend` (odd; 0: none): output frames that are blended with learned weights (ours, against jitter)."""
        super().__init__()
        if window % frames_per_token:
            raise ValueError(f"a window of {window} frames does not split into tokens of {frames_per_token}")
        self.window, self.per_token = window, frames_per_token
        self.feature_normalizer, self.motion_normalizer = Normalizer(feature_size), Normalizer(motion_size)
        self.ends_normalizer = Normalizer(ENDS_SIZE)
        tokens = window // frames_per_token
        per, size, width = frames_per_token, transformer, transformer.width

        def encoder() -> nn.TransformerEncoder:
            more = {"batch_first": True, "norm_first": True}
            layer = nn.TransformerEncoderLayer(width, size.heads, size.feedforward, size.dropout, **more)
            return nn.TransformerEncoder(layer, size.layers, nn.LayerNorm(width), enable_nested_tensor=False)

        def head(inputs: int, outputs: int) -> nn.Sequential:
            return nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, per * outputs))

        self.first: nn.ModuleDict | None = None
        if multi_stage:
            self.first = nn.ModuleDict(
                {"embed": nn.Linear(per * feature_size, width), "encoder": encoder(), "ends": head(width, ENDS_SIZE)}
            )
            self.first_position = nn.Parameter(0.02 * torch.randn(tokens, width))
            self.embed_ends = nn.Linear(per * ENDS_SIZE, width // 2)
        self.embed = nn.Linear(per * feature_size, width // 2 if multi_stage else width)
        self.position = nn.Parameter(0.02 * torch.randn(tokens, width))
        self.encoder = encoder()
        self.contact = head(width, FEET)
        self.body = head(width + per * FEET, motion_size)
        self.blend = TemporalBlend(blend) if blend else None

    def forward(self, features: Float[Tensor, "batch window feature"]) -> Estimate:
        """Predict every frame of the window from raw features."""
        x = self._tokens(self.feature_normalizer(features))
        ends, embedded = None, self.embed(x)
        if self.first is not None:
            output = self.first["encoder"](self.first["embed"](x) + self.first_position)
            ends = self._frames(self.first["ends"](output))
            embedded = torch.cat([embedded, self.embed_ends(self._tokens(ends))], -1)
            ends = self.ends_normalizer.inverse(ends)
        encoded = self.encoder(embedded + self.position)
        logit = self.contact(encoded)
        motion = self._frames(self.body(torch.cat([encoded, logit.sigmoid()], -1)))
        if self.blend is not None:
            motion = self.blend(motion, torch.ones(motion.shape[:2], dtype=torch.bool, device=motion.device))
        return Estimate(self.motion_normalizer.inverse(motion), self._frames(logit), ends)

    def _tokens(self, frames: Float[Tensor, "batch window feature"]) -> Float[Tensor, "batch token wide"]:
        return frames.unflatten(1, (-1, self.per_token)).flatten(2)

    def _frames(self, tokens: Float[Tensor, "batch token wide"]) -> Float[Tensor, "batch window feature"]:
        return tokens.unflatten(2, (self.per_token, -1)).flatten(1, 2)


class MLPEstimator(WatchEstimator):
    """AGRoL's network without its diffusion (Du et al. 2023): one MLP predicts all frames of a window; with `blend` ours."""

    def __init__(self, feature_size: int, motion_size: int, window: int, width: int, layers: int, blend: int = 0):
        """`blend`: as `TwoStageEstimator`'s (ours)."""
        super().__init__()
        self.window = window
        self.feature_normalizer, self.motion_normalizer = Normalizer(feature_size), Normalizer(motion_size)
        self.ends_normalizer = Normalizer(ENDS_SIZE)
        self.embed = nn.Linear(feature_size, width)
        self.blocks = nn.ModuleList(MixingBlock(width, window, has_level=False) for _ in range(layers))
        self.head = nn.Linear(width, motion_size + FEET)
        self.blend = TemporalBlend(blend) if blend else None

    def forward(self, features: Float[Tensor, "batch window feature"]) -> Estimate:
        """Predict every frame of the window from raw features."""
        x = self.embed(self.feature_normalizer(features))
        no_level = torch.zeros_like(x[:1, :1])
        mask = attention_mask(torch.ones(x.shape[:2], dtype=torch.bool, device=x.device))
        for block in self.blocks:
            x = block(x, no_level, mask)
        motion, logit = self.head(x).split([len(self.motion_normalizer.mean), FEET], -1)
        if self.blend is not None:
            motion = self.blend(motion, torch.ones(motion.shape[:2], dtype=torch.bool, device=motion.device))
        return Estimate(self.motion_normalizer.inverse(motion), logit, None)


TrainedEstimator = TwoStageEstimator | MLPEstimator


class _EstimatorOutput(nn.Module):
    """Motion and contact logits of an estimator's last frames, in one tensor."""

    def __init__(self, net: WatchEstimator):
        super().__init__()
        self.net = net

    def forward(self, features: Float[Tensor, "batch window feature"]) -> Float[Tensor, "batch predicted value"]:
        output = self.net(features)
        return torch.cat([output.motion, output.contact_logit], -1)
