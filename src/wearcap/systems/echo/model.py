"""ECHO's denoiser (ECHO §3.2): a diffusion transformer over human, object and contacts, with an independent noise level
for each frame and modality, and its steps in any runtime with cached level-dependent activations."""

from collections.abc import Callable

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
from wearcap.runtime.graphs import Call, Graph, LevelPlan, PlanGraph, StepGraph, chosen, run_of

MODALITIES = ("human", "object", "contact")
MOST_ROWS = 1024
"""Level triples whose plans are cached: a queue has one per step and combination of observed and absent modalities."""
MOST_WINDOWS = 8
"""Windows of levels whose plans are cached: a queue in steady state repeats as many as it has steps per frame."""


class EchoDenoiser(nn.Module):
    """(x̂_H, x̂_O, x̂_I) = D(x_t, levels, E, C_O), with the modalities concatenated per frame (ECHO eq. 7).

    `streams` 1: one token per frame, the sum of its modalities' embeddings. 3: one token per frame and modality,
    sharing the frame's position. The active object conditions each frame (ours: ECHO has one object per window), so
    that it may change within a window; frames without one get a learned null vector. `blend`: see `MotionDenoiser`.
    """

    exported = False
    """Whether the weights are in exported files, which take full windows."""

    def __init__(
        self,
        sizes: tuple[int, int, int],
        condition_size: int,
        object_condition_size: int,
        window: int,
        transformer: TransformerSize,
        streams: int = 1,
        context: int = 7,
        blend: int = 0,
        mixing: str = "attention",
    ):
        """`sizes` of the modalities. `context`: frames before and after its own that the convolution over conditions sees. `mixing`: see
        `denoiser_block`."""
        super().__init__()
        if streams not in (1, len(MODALITIES)):
            raise ValueError(f"{streams} streams, but there are {len(MODALITIES)} modalities")
        self.window, self.streams, self.sizes, width = window, streams, sizes, transformer.width
        self.motion_normalizer = Normalizer(sum(self.sizes))
        self.condition_normalizer = Normalizer(condition_size)
        # One more channel marks valid frames: padding would otherwise look like the mean condition.
        self.widen = Widening(condition_size + 1, 2 * width, 1, context)
        self.object = nn.Sequential(nn.Linear(object_condition_size, width), nn.GELU(), nn.Linear(width, 2 * width))
        self.no_object = nn.Parameter(torch.zeros(2 * width))
        self.narrow = nn.Linear(2 * width, width)
        self.motion_encoders = nn.ModuleList(MotionEncoder(size, width, 1) for size in self.sizes)
        self.levels = nn.ModuleList(LevelEmbedding(width) for _ in self.sizes)
        self.stream = nn.Parameter(0.02 * torch.randn(streams, width)) if streams > 1 else None
        self.blocks = nn.ModuleList(
            denoiser_block(mixing, transformer, window, streams) for _ in range(transformer.layers)
        )
        self.norm = nn.LayerNorm(width)
        self.heads = nn.ModuleList(nn.Linear(width, size) for size in self.sizes)
        for head in self.heads:
            nn.init.zeros_(head.weight)
            nn.init.zeros_(head.bias)
        self.blend = TemporalBlend(blend) if blend else None

    def encode(
        self,
        condition: Float[Tensor, "batch time condition"],
        scene_object: Float[Tensor, "batch time embedded"],
        has_object: Bool[Tensor, "batch time"],
        valid: Bool[Tensor, "batch time"],
    ) -> Float[Tensor, "batch time width"]:
        """Encoded condition of each frame, the same in every step. `scene_object`: codes embedded by `self.object`."""
        mask = valid[..., None].to(condition.dtype)
        wide = self.widen(torch.cat([self.condition_normalizer(condition) * mask, mask], -1))
        scene_object = torch.where(has_object[..., None], scene_object, self.no_object)
        return self.narrow(F.gelu(wide + scene_object))

    def plan(self, level: Float[Tensor, "batch time modality"]) -> LevelPlan:
        """The part of a step that depends on the levels alone; a conveyor in steady state repeats its levels."""
        embedded = [embed(level[..., k]) for k, embed in enumerate(self.levels)]
        worth = tuple(encoder.plan(each) for encoder, each in zip(self.motion_encoders, embedded))
        together = torch.stack(embedded).sum(0)
        return LevelPlan(worth, tuple(block.plan(together) for block in self.blocks))

    def step(
        self,
        x_t: Float[Tensor, "batch time feature"],
        plan: LevelPlan,
        encoded: Float[Tensor, "batch time width"],
        valid: Bool[Tensor, "batch time"],
    ) -> Float[Tensor, "batch time feature"]:
        """x̂0 in normalised space, from x_t, the levels' plan and the encoded condition."""
        parts = x_t.split(self.sizes, -1)
        tokens = [encoder(part, worth, valid) for encoder, part, worth in zip(self.motion_encoders, parts, plan.worth)]
        mask = attention_mask(valid.repeat(1, self.streams))
        if self.stream is None:
            token = encoded + torch.stack(tokens).sum(0)
        else:
            token = torch.cat([encoded + part + own for part, own in zip(tokens, self.stream)], 1)
        for block, modulation in zip(self.blocks, plan.blocks):
            token = block(token, modulation.repeat(1, self.streams, 1), mask)
        outputs = self.norm(token).chunk(self.streams, 1)
        x0_hat = torch.cat([head(outputs[k % self.streams]) for k, head in enumerate(self.heads)], -1)
        return x0_hat if self.blend is None else self.blend(x0_hat, valid)

    def forward(
        self,
        x_t: Float[Tensor, "batch time feature"],
        level: Float[Tensor, "batch time modality"],
        encoded: Float[Tensor, "batch time width"],
        valid: Bool[Tensor, "batch time"],
    ) -> Float[Tensor, "batch time feature"]:
        """x̂0 in normalised space, from x_t, its levels and the result of `encode`."""
        return self.step(x_t, self.plan(level), encoded, valid)

    def per_feature(self, level: Float[Tensor, "batch time modality"]) -> Float[Tensor, "batch time feature"]:
        """Each modality's level, repeated for its features."""
        parts = zip(level.split(1, -1), self.sizes)
        return torch.cat([part.expand(*level.shape[:-1], size) for part, size in parts], -1)

    def graphs(self) -> dict[str, Graph]:
        """The parts as graphs of full windows, whose padding frames are not `valid`.

        "step": x̂0 from x_t, plan, encoded and valid. "plan": columns from levels "batch 1 modality". "conditions": `encode`.
        "objects": embedded codes of objects.
        """
        random, shape = torch.Generator().manual_seed(0), (2, self.window)
        normalizer, embedded = self.condition_normalizer, len(self.no_object)
        noise = torch.randn(*shape, len(normalizer.mean), generator=random)
        valid = torch.arange(self.window).expand(shape) < self.window - 3
        level = torch.rand(2, 1, len(MODALITIES), generator=random)
        step = StepGraph(self, torch.zeros(1, 1, len(MODALITIES), device=normalizer.mean.device))
        step_inputs = {
            "x_t": torch.randn(*shape, sum(self.sizes), generator=random),
            "plan": 0.1 * torch.randn(*shape, step.columns, generator=random),
            "encoded": torch.randn(*shape, self.narrow.out_features, generator=random),
            "valid": valid,
        }
        condition_inputs = {
            "condition": normalizer.mean.cpu() + normalizer.scale.cpu() * noise,
            "scene_object": torch.randn(*shape, embedded, generator=random),
            "has_object": torch.rand(shape, generator=random) < 0.7,
            "valid": valid,
        }
        codes = torch.randn(*shape, self.object[0].in_features, generator=random)
        return {
            "step": Graph(step, step_inputs),
            "plan": Graph(PlanGraph(self), {"level": level}),
            "conditions": Graph(Call(self, "encode"), condition_inputs),
            "objects": Graph(self.object, {"input": codes}),
        }


class EchoPlans:
    """Cache of a network's level-dependent activations (`EchoDenoiser.plan`), computed once per triple of levels.

    The network's weights must not change. Triples repeat between frames, while the levels of whole windows rarely do
    when an object enters: its first frame moves through the window.
    """

    def __init__(self, net: EchoDenoiser):
        self._plan, self._device = run_of(net.graphs()["plan"]), net.motion_normalizer.mean.device
        self._number: dict[tuple[float, ...], int] = {}
        self._rows: Tensor | None = None
        self._windows: dict[bytes, Tensor] = {}

    @torch.no_grad()
    def __call__(self, level: Float[Tensor, "batch frame modality"]) -> Float[Tensor, "#batch frame column"]:
        """Plans of all batch items, or of one if all have the same levels. Levels are on the CPU."""
        if len(level) > 1 and (level == level[:1]).all():
            level = level[:1]
        key = bytes(str(tuple(level.shape)), "ascii") + level.numpy().tobytes()
        if key not in self._windows:
            if len(self._windows) >= MOST_WINDOWS:
                self._windows.pop(next(iter(self._windows)))
            triples = [tuple(row) for row in level.flatten(0, 1).tolist()]
            if len(self._number) > MOST_ROWS:
                self._number.clear()
                self._rows = None
            fresh = list(dict.fromkeys(triple for triple in triples if triple not in self._number))
            if fresh:
                rows = self._plan(level=torch.tensor(fresh, device=self._device)[:, None])[:, 0]
                self._number |= {triple: len(self._number) + k for k, triple in enumerate(fresh)}
                self._rows = rows if self._rows is None else torch.cat([self._rows, rows])
            assert self._rows is not None
            take = torch.tensor([self._number[triple] for triple in triples], device=self._device)
            self._windows[key] = self._rows[take].unflatten(0, level.shape[:2])
        return self._windows[key]


class EchoRunner:
    """Computes x̂0 of windows. The network's weights must not change while it is in use."""

    def __init__(self, net: EchoDenoiser, runtime: str = "eager", precision: str = "float32"):
        """Raises WearcapError for a runtime or precision that is unknown, not installed, or not for the device."""
        self.net, self._device = net, net.motion_normalizer.mean.device
        self.runtime, precision = chosen(runtime, precision, self._device)
        graphs, self.plans = net.graphs(), EchoPlans(net)
        self._step, self._encode = (run_of(graphs[name], self.runtime, precision) for name in ("step", "conditions"))
        self._window = None if self.runtime == "eager" and not net.exported else net.window
        self._whole_batches = self.runtime == "onnx" or net.exported

    def begin(
        self,
        condition: Float[Tensor, "batch time condition"],
        scene_object: Float[Tensor, "batch time embedded"],
        has_object: Bool[Tensor, "batch time"],
        valid: Bool[Tensor, "batch time"],
    ) -> Callable[[Tensor, Tensor], Tensor]:
        """x̂0 as a function of x_t "batch time feature" and levels "batch time modality", encoding conditions once.

        Inputs and outputs are on the CPU.
        """
        count = valid.shape[1]
        condition, scene_object, has_object, valid = map(self._whole, (condition, scene_object, has_object, valid))
        encoded = self._encode(condition=condition, scene_object=scene_object, has_object=has_object, valid=valid)

        def denoise(x_t: Tensor, level: Tensor) -> Tensor:
            x_t, plan = self._whole(x_t), self.plans(self._padded(level))
            plan = plan.expand(len(x_t), -1, -1) if self._whole_batches else plan
            return self._step(x_t=x_t, plan=plan, encoded=encoded, valid=valid)[:, :count].float().cpu()

        return denoise

    def _whole(self, value: Tensor) -> Tensor:
        """A tensor on the device, padded to a full window for runtimes with fixed shapes."""
        return self._padded(value).to(self._device)

    def _padded(self, value: Tensor) -> Tensor:
        more = 0 if self._window is None else self._window - value.shape[1]
        return F.pad(value, (0, 0) * (value.ndim - 2) + (0, more)) if more else value
