"""The conditional motion denoiser of HMD² (thesis §6.2): a DiT/EDGE-like transformer that predicts x0.

`StepRunner` runs its steps at a fixed sequence of levels, in any runtime.
"""

from collections.abc import Mapping
from contextlib import AbstractContextManager
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional as F

from wearcap.models.layers import (
    LevelEmbedding,
    MotionEncoder,
    Normalizer,
    TemporalBlend,
    TransformerSize,
    Widening,
    attention_mask,
    denoiser_block,
)
from wearcap.runtime.graphs import Graph, LevelPlan, PlanGraph, StepGraph, chosen, run_of, undisturbed


class Conditions(NamedTuple):
    """Conditioning of a window, not normalised."""

    head: Float[Tensor, "batch time head_feature"]
    others: Float[Tensor, "batch time feature"]
    """Features of the network's other conditions side by side; of a condition that a frame lacks any finite numbers."""
    given: Bool[Tensor, "batch time condition"]
    """Which of these conditions each frame has."""


class OptionalInput(nn.Module):
    """Encodes a modality that may be missing: standardised features, or a learned null vector in their place."""

    def __init__(self, size: int, width: int, frames_per_token: int):
        super().__init__()
        self.normalizer = Normalizer(size)
        self.null = nn.Parameter(torch.zeros(size))
        self.widen = Widening(size + 1, width, frames_per_token, bias=False)

    def forward(
        self, x: Float[Tensor, "batch time feature"], valid: Bool[Tensor, "batch time"]
    ) -> Float[Tensor, "batch token width"]:
        # Without any valid frame all tokens are the same, and one is encoded; exported graphs have no such branch.
        if not (self.training or torch.compiler.is_compiling() or valid.any()):
            nothing = F.pad(self.null, (0, 1)).expand(1, self.widen.kernel_size[0], -1)
            return self.widen(nothing).expand(len(valid), valid.shape[1] // self.widen.stride[0], -1)
        there = valid[..., None]
        # The flag lets the network distinguish the null vector from features that resemble it.
        frames = torch.where(there, self.normalizer(x), self.null)
        return self.widen(torch.cat([frames, there.to(x.dtype)], -1))


class ConditionEncoder(nn.Module):
    """Concatenates a frame's conditions and narrows them to one vector per token by an MLP (thesis §6.2).

    The MLP's first layer is the sum of one linear layer per modality, which equals a linear layer on the concatenation.
    The head's features cover `context` frames before and after the token's own (ours): a step shows in half a second of
    head sway, not in one frame.
    """

    def __init__(self, head_size: int, sizes: Mapping[str, int], width: int, frames_per_token: int, context: int):
        super().__init__()
        # One more channel marks valid frames: padding would otherwise look like the mean condition.
        self.normalizer = Normalizer(head_size)
        self.widen = Widening(head_size + 1, 2 * width, frames_per_token, context)
        self.sizes = dict(sizes)
        for name, size in sizes.items():
            self.add_module(name, OptionalInput(size, 2 * width, frames_per_token))
        self.narrow = nn.Linear(2 * width, width)

    def forward(self, conditions: Conditions, valid: Bool[Tensor, "batch time"]) -> Float[Tensor, "batch token width"]:
        mask = valid[..., None].to(conditions.head.dtype)
        frames = torch.cat([self.normalizer(conditions.head) * mask, mask], -1)
        wide = self.widen(frames)
        parts = conditions.others.split([*self.sizes.values()], -1) if self.sizes else ()
        for number, (name, x) in enumerate(zip(self.sizes, parts)):
            wide = wide + self.get_submodule(name)(x, conditions.given[..., number] & valid)
        return self.narrow(F.gelu(wide))


class MotionDenoiser(nn.Module):
    """x̂0 = D(x_t, c, level): one token per frame (or per few frames) through adaptive transformer blocks.

    A token is the sum of the encoded condition and the encoded x_t of its frames (the thesis leaves open where x_t
    enters). The encoded condition (`encode`) is the same in every sampling step and computed once.
    `frames_per_token` > 1 is ours: neighbouring frames share a token, which divides the cost of a window by about that
    number; `blend` > 0 (also ours) mixes that many neighbouring frames of x̂0, which removes the seams between tokens
    and most of a partly trained network's jitter. `self_conditioning` (Chen et al. 2023) also takes in the last x̂0.
    """

    def __init__(
        self,
        motion_size: int,
        condition_size: int,
        window: int,
        transformer: TransformerSize,
        frames_per_token: int = 1,
        blend: int = 0,
        context: int = 14,
        conditions: Mapping[str, int] | None = None,
        self_conditioning: bool = False,
        mixing: str = "attention",
    ):
        """`mixing`: see `denoiser_block`. `conditions`: sizes of those beside the head; a network runs with and without each."""
        super().__init__()
        if window % frames_per_token:
            raise ValueError(f"a window of {window} frames does not split into tokens of {frames_per_token}")
        self.window, self.frames_per_token, width = window, frames_per_token, transformer.width
        self.motion_size, self.condition_size = motion_size, condition_size
        self.conditions = dict(conditions or {})
        self.self_conditioning = self_conditioning
        self.motion_normalizer = Normalizer(motion_size)
        self.condition_encoder = ConditionEncoder(condition_size, self.conditions, width, frames_per_token, context)
        self.motion_encoder = MotionEncoder(motion_size * (2 if self_conditioning else 1), width, frames_per_token)
        self.level = LevelEmbedding(width)
        self.blocks = nn.ModuleList(
            denoiser_block(mixing, transformer, window // frames_per_token) for _ in range(transformer.layers)
        )
        self.norm = nn.LayerNorm(width)
        self.head = nn.Linear(width, frames_per_token * motion_size)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)
        self.blend = TemporalBlend(blend) if blend else None

    def encode(self, conditions: Conditions, valid: Bool[Tensor, "batch time"]) -> Float[Tensor, "batch token width"]:
        """The encoded condition of every token; `valid` is False on padding."""
        return self.condition_encoder(conditions, valid)

    def forward(
        self,
        x_t: Float[Tensor, "batch time motion"],
        level: Float[Tensor, "batch #time"],
        encoded: Float[Tensor, "batch token width"],
        valid: Bool[Tensor, "batch time"],
        last: Float[Tensor, "batch time motion"] | None = None,
    ) -> Float[Tensor, "batch time motion"]:
        """x̂0 in normalised motion space from x_t and the output of `encode`.

        last: with self-conditioning, the x̂0 of the previous step (None in the first step).
        """
        return self.step(x_t, self.plan(level), encoded, valid, last)

    def plan(self, level: Float[Tensor, "batch #time"]) -> LevelPlan:
        """The level-dependent part of a step; sampling computes it once for all windows."""
        k = self.frames_per_token
        token_level = level if level.shape[1] == 1 else level.unflatten(1, (-1, k)).mean(-1)
        embedded = self.level(token_level)
        return LevelPlan((self.motion_encoder.plan(embedded),), tuple(block.plan(embedded) for block in self.blocks))

    def step(
        self,
        x_t: Float[Tensor, "batch time motion"],
        plan: LevelPlan,
        encoded: Float[Tensor, "batch token width"],
        valid: Bool[Tensor, "batch time"],
        last: Float[Tensor, "batch time motion"] | None = None,
    ) -> Float[Tensor, "batch time motion"]:
        """`forward` with the level's precomputed plan, which has a batch axis of 1 or of the batch's length."""
        batch, time, _ = x_t.shape
        mask = attention_mask(valid.unflatten(1, (-1, self.frames_per_token)).any(-1))
        if self.self_conditioning:
            x_t = torch.cat([x_t, torch.zeros_like(x_t) if last is None else last], -1)
        token = encoded + self.motion_encoder(x_t, plan.worth[0], valid)
        for block, modulation in zip(self.blocks, plan.blocks):
            token = block(token, modulation, mask)
        x0_hat = self.head(self.norm(token)).reshape(batch, time, -1)
        return x0_hat if self.blend is None else self.blend(x0_hat, valid)

    def graphs(self, window: int | None = None) -> dict[str, Graph]:
        """The parts of a denoising step as graphs, for windows of some frames; None: of those it was trained on.

        "step": x̂0 from x_t, plan (that all windows share), encoded, valid, and last with self-conditioning. "plan":
        columns from levels "batch 1".
        """
        random = torch.Generator().manual_seed(0)
        window = window or self.window
        tokens, width = window // self.frames_per_token, self.motion_encoder.linear.out_features
        x_t, last = torch.randn(2, 2, window, self.motion_size, generator=random)
        level = torch.rand(2, 1, generator=random)
        step = StepGraph(self, torch.zeros(1, 1, device=self.motion_normalizer.mean.device))
        inputs = {
            "x_t": x_t,
            "plan": 0.1 * torch.randn(1, 1, step.columns, generator=random),
            "encoded": torch.randn(2, tokens, width, generator=random),
            "valid": torch.arange(window).expand(2, -1) < window - 3,
        }
        inputs |= {"last": last} if self.self_conditioning else {}
        return {"step": Graph(step, inputs, shared=("plan",)), "plan": Graph(PlanGraph(self), {"level": level})}


class StepRunner:
    """x̂0 at a fixed sequence of levels, for any batch size. The network's weights must not change while it is used."""

    def __init__(
        self,
        net: MotionDenoiser,
        levels: Float[Tensor, "step"],
        runtime: str = "eager",
        precision: str = "float32",
        window: int | None = None,
    ):
        """`window`: its frames, where they are not the network's own.

        Raises WearcapError for a runtime or precision that is unknown, not installed, or that do not go together."""
        device = net.motion_normalizer.mean.device
        self.net, (self.runtime, precision) = net, chosen(runtime, precision, device)
        with torch.inference_mode():
            plan = run_of(net.graphs()["plan"])
            self._plans = [plan(level=level.reshape(1, 1)) for level in levels.to(device)]
        self._step = run_of(net.graphs(window)["step"], self.runtime, precision)

    def __call__(
        self,
        number: int,
        x_t: Float[Tensor, "batch time motion"],
        encoded: Float[Tensor, "batch token width"],
        valid: Bool[Tensor, "batch time"],
        last: Float[Tensor, "batch time motion"] | None = None,
    ) -> Float[Tensor, "batch time motion"]:
        """x̂0 at level `number` of the sequence."""
        more = {"last": torch.zeros_like(x_t) if last is None else last} if self.net.self_conditioning else {}
        return self._step(x_t=x_t, plan=self._plans[number], encoded=encoded, valid=valid, **more)

    def undisturbed(self) -> AbstractContextManager[None]:
        """A context for small batches in which PyTorch's threads leave the cores to ONNX Runtime's."""
        return undisturbed(self.runtime == "onnx")
