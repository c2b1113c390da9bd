"""Fast denoising steps for ECHO: level-dependent activations are cached, the rest runs in PyTorch or ONNX Runtime."""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional as F

from wearcap.errors import WearcapError, nearest
from wearcap.runtime.onnx import missing_libraries, onnx_runner
from wearcap.systems.echo.model import MODALITIES, EchoDenoiser, EchoPlan

RUNTIMES = ("eager", "onnx", "compile")
"""onnx: ONNX Runtime, on the CPU. compile: for a GPU, replayed as CUDA graphs. Both take some seconds to start."""
MOST_ROWS = 1024
"""Level triples whose plans are cached: a queue has one per step and combination of observed and absent modalities."""
MOST_WINDOWS = 8
"""Windows of levels whose plans are cached: a queue in steady state repeats as many as it has steps per frame."""


class EchoPlans:
    """Cache of a network's level-dependent activations (`EchoDenoiser.plan`), computed once per triple of levels.

    The network's weights must not change. Triples repeat between frames, while the levels of whole windows rarely do
    when an object enters: its first frame moves through the window.
    """

    def __init__(self, net: EchoDenoiser):
        self.net, self._device = net, net.motion_normalizer.mean.device
        with torch.no_grad():
            probe = net.plan(torch.zeros(1, 1, len(MODALITIES), device=self._device))
        self._worth = len(probe.worth)
        self._sizes = [part.shape[-1] for part in (*probe.worth, *probe.blocks)]
        self._number: dict[tuple[float, ...], int] = {}
        self._rows = torch.zeros(0, sum(self._sizes), device=self._device)
        self._windows: dict[bytes, Tensor] = {}

    @property
    def size(self) -> int:
        """Columns of a plan."""
        return sum(self._sizes)

    @torch.no_grad()
    def __call__(self, level: Float[Tensor, "batch frame modality"]) -> Float[Tensor, "#batch frame column"]:
        """Plans of all batch items, or of one if all have the same levels. Levels are on the CPU."""
        if len(level) > 1 and (level == level[:1]).all():
            level = level[:1]
        key = bytes(str(tuple(level.shape)), "ascii") + level.numpy().tobytes()
        if key not in self._windows:
            if len(self._windows) >= MOST_WINDOWS:
                self._windows.pop(next(iter(self._windows)))
            self._windows[key] = self._computed(level)
        return self._windows[key]

    def _computed(self, level: Float[Tensor, "batch frame modality"]) -> Float[Tensor, "batch frame column"]:
        triples = [tuple(row) for row in level.flatten(0, 1).tolist()]
        if len(self._number) > MOST_ROWS:
            self._number.clear()
            self._rows = self._rows[:0]
        fresh = list(dict.fromkeys(triple for triple in triples if triple not in self._number))
        if fresh:
            plan = self.net.plan(torch.tensor([fresh], device=self._device))
            parts = [*plan.worth, *(block[:, : len(fresh)] for block in plan.blocks)]
            self._number |= {triple: len(self._number) + k for k, triple in enumerate(fresh)}
            self._rows = torch.cat([self._rows, torch.cat(parts, -1)[0]])
        take = torch.tensor([self._number[triple] for triple in triples], device=self._device)
        return self._rows[take].unflatten(0, level.shape[:2])

    def plan(self, columns: Float[Tensor, "batch frame column"]) -> EchoPlan:
        """The plan in the form that the network takes."""
        parts = columns.split(self._sizes, -1)
        worth, blocks = parts[: self._worth], parts[self._worth :]
        if self.net.streams > 1:
            blocks = tuple(block.repeat(1, self.net.streams, 1) for block in blocks)
        return EchoPlan(worth, blocks)


class _StepGraph(nn.Module):
    """One denoising step, with the levels' plan as a single tensor."""

    def __init__(self, plans: EchoPlans):
        super().__init__()
        self.net, self._plans = plans.net, (plans,)

    def forward(
        self,
        x_t: Float[Tensor, "batch time feature"],
        plan: Float[Tensor, "#batch time column"],
        encoded: Float[Tensor, "batch time width"],
        valid: Bool[Tensor, "batch time"],
    ) -> Float[Tensor, "batch time feature"]:
        return self.net.step(x_t, self._plans[0].plan(plan), encoded, valid)


class _EncodeGraph(nn.Module):
    """Encoding of a window's conditions."""

    def __init__(self, net: EchoDenoiser):
        super().__init__()
        self.net = net

    def forward(
        self,
        condition: Float[Tensor, "batch time condition"],
        scene_object: Float[Tensor, "batch time embedded"],
        has_object: Bool[Tensor, "batch time"],
        valid: Bool[Tensor, "batch time"],
    ) -> Float[Tensor, "batch time width"]:
        return self.net.encode(condition, scene_object, has_object, valid)


class EchoRunner:
    """Computes x̂0 of windows. The network's weights must not change while it is in use."""

    def __init__(self, net: EchoDenoiser, runtime: str = "eager"):
        """Raises WearcapError for a runtime that is unknown, not installed, or not for the network's device."""
        self._device = net.motion_normalizer.mean.device
        require_runtime(runtime, self._device)
        self.net, self.plans = net, EchoPlans(net)
        step, encode = _StepGraph(self.plans).eval(), _EncodeGraph(net).eval()
        self._step: Callable[..., Tensor] = step
        self._encode: Callable[..., Tensor] = encode
        if runtime == "onnx":
            self._step, self._encode = _onnx(net, self.plans.size, step, encode)
        elif runtime == "compile":
            self._step, self._encode = _compiled(step, self._device), _compiled(encode, self._device)
        self._window = None if runtime == "eager" else net.window

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
        inputs = [self._whole(part) for part in (condition, scene_object, has_object, valid)]
        encoded, whole_valid = self._encode(*inputs), inputs[-1]

        def denoise(x_t: Tensor, level: Tensor) -> Tensor:
            plan = self.plans(self._padded(level))
            return self._step(self._whole(x_t), plan, encoded, whole_valid)[:, :count].float().cpu()

        return denoise

    def _whole(self, value: Tensor) -> Tensor:
        """A tensor on the device, padded to a full window for runtimes with fixed shapes."""
        return self._padded(value).to(self._device)

    def _padded(self, value: Tensor) -> Tensor:
        more = 0 if self._window is None else self._window - value.shape[1]
        return F.pad(value, (0, 0) * (value.ndim - 2) + (0, more)) if more else value


def require_runtime(runtime: str, device: str | torch.device) -> None:
    """Raises WearcapError for a runtime that is unknown, not installed, or not for a device."""
    if runtime not in RUNTIMES:
        raise WearcapError(
            f"unknown runtime {runtime!r}", expected=f"one of {', '.join(RUNTIMES)}", fix=nearest(runtime, RUNTIMES)
        )
    missing = missing_libraries() if runtime == "onnx" else []
    if missing or (runtime == "onnx" and torch.device(device).type != "cpu"):
        raise WearcapError(
            f"runtime 'onnx' needs {', '.join(missing)}" if missing else f"runtime 'onnx' on {device}",
            expected="ONNX Runtime on the CPU",
            fix='Run: pip install "wearcap[export]", or choose pipeline.runtime=eager.',
        )


def _onnx(
    net: EchoDenoiser, columns: int, step: nn.Module, encode: nn.Module
) -> tuple[Callable[..., Tensor], Callable[..., Tensor]]:
    frames = 2, net.window
    valid = torch.ones(frames, dtype=torch.bool)
    encode_inputs = {
        "condition": torch.zeros(*frames, len(net.condition_normalizer.mean)),
        "scene_object": torch.zeros(*frames, len(net.no_object)),
        "has_object": valid,
        "valid": valid.clone(),
    }
    step_inputs = {
        "x_t": torch.zeros(*frames, sum(net.sizes)),
        "plan": torch.zeros(*frames, columns),
        "encoded": torch.zeros(*frames, net.narrow.out_features),
        "valid": valid,
    }
    run_step, run_encode = onnx_runner(step, step_inputs), onnx_runner(encode, encode_inputs)

    def stepped(x_t: Tensor, plan: Tensor, encoded: Tensor, valid: Tensor) -> Tensor:
        return run_step(x_t, plan.expand(len(x_t), -1, -1), encoded, valid)[0]

    return stepped, lambda *inputs: run_encode(*inputs)[0]


def _compiled(graph: nn.Module, device: torch.device) -> Callable[..., Tensor]:
    """The compiled graph with static shapes; on a GPU replayed as CUDA graphs, whose outputs must be cloned: the next
    replay overwrites them."""
    mode = "reduce-overhead" if device.type == "cuda" else None
    compiled = torch.compile(graph, dynamic=False, fullgraph=True, mode=mode)
    return lambda *inputs: compiled(*inputs).clone()
