"""Runs denoising steps with precomputed level plans, in PyTorch (eager or compiled) or ONNX Runtime."""

from collections.abc import Callable
from contextlib import AbstractContextManager

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from wearcap.errors import WearcapError, nearest
from wearcap.runtime.onnx import missing_libraries, onnx_runner, undisturbed
from wearcap.systems.hmd2.model import LevelPlan, MotionDenoiser

RUNTIMES = ("auto", "eager", "compile", "onnx")
"""Backends; auto: compiled (CUDA graphs) on a GPU, else ONNX Runtime where it is installed, else eager."""
PRECISIONS = ("auto", "narrowest", "float32", "bfloat16", "int8")
"""Number formats; auto: bfloat16 on a GPU, else float32; narrowest: as auto, but int8 with ONNX Runtime.
int8 (weights, and dynamically quantised activations) needs ONNX Runtime."""

Step = Callable[[Tensor, LevelPlan, Tensor, Tensor, Tensor | None], Tensor]
"""x̂0 from x_t, its level's plan, the encoded conditions, `valid`, and the last x̂0 (with self-conditioning)."""


class StepGraph(nn.Module):
    """One denoising step with its level's plan as plain tensors: the graph that is compiled or exported."""

    def __init__(self, net: MotionDenoiser):
        super().__init__()
        self.net = net

    def forward(
        self,
        x_t: Float[Tensor, "batch time motion"],
        worth: Float[Tensor, "1 1 width"],
        blocks: Float[Tensor, "layer 1 1 modulation"],
        encoded: Float[Tensor, "batch token width"],
        valid: Bool[Tensor, "batch time"],
        last: Float[Tensor, "batch time motion"] | None = None,
    ) -> Float[Tensor, "batch time motion"]:
        return self.net.step(x_t, LevelPlan(worth, blocks.unbind(0)), encoded, valid, last)


class StepRunner:
    """x̂0 at a fixed sequence of levels, for any batch size. The network's weights must not change while it is used."""

    def __init__(
        self, net: MotionDenoiser, levels: Float[Tensor, "step"], runtime: str = "eager", precision: str = "float32"
    ):
        """Raises WearcapError for a runtime or precision that is unknown, not installed, or that do not go together."""
        self.net = net
        device = net.motion_normalizer.mean.device
        runtime, precision = _chosen(runtime, precision, device)
        self.runtime = runtime
        """The chosen backend, never "auto"."""
        with torch.inference_mode():
            self._plans = [net.plan(level.reshape(1, 1)) for level in levels.to(device)]
        self._step = _step_of(net, runtime, precision)

    def __call__(
        self,
        number: int,
        x_t: Float[Tensor, "batch time motion"],
        encoded: Float[Tensor, "batch token width"],
        valid: Bool[Tensor, "batch time"],
        last: Float[Tensor, "batch time motion"] | None = None,
    ) -> Float[Tensor, "batch time motion"]:
        """x̂0 at level `number` of the sequence."""
        if self.net.self_conditioning and last is None:
            last = torch.zeros_like(x_t)
        return self._step(x_t, self._plans[number], encoded, valid, last)

    def undisturbed(self) -> AbstractContextManager[None]:
        """A context for small batches in which PyTorch's threads leave the cores to ONNX Runtime's."""
        return undisturbed(self.runtime == "onnx")


def _chosen(runtime: str, precision: str, device: torch.device) -> tuple[str, str]:
    for what, value, allowed in (("runtime", runtime, RUNTIMES), ("precision", precision, PRECISIONS)):
        if value not in allowed:
            raise WearcapError(
                f"no {what} {value!r}", expected=f"one of {', '.join(allowed)}", fix=nearest(value, allowed)
            )
    missing = missing_libraries()
    if runtime == "auto":
        plain = "eager" if missing or precision == "bfloat16" else "onnx"
        runtime = "compile" if device.type == "cuda" else plain
    if precision in ("auto", "narrowest"):
        plain = "int8" if runtime == "onnx" and precision == "narrowest" else "float32"
        precision = "bfloat16" if device.type == "cuda" else plain
    if (precision == "int8") > (runtime == "onnx") or (precision == "bfloat16" and runtime == "onnx"):
        raise WearcapError(
            f"no {precision} with runtime {runtime!r}", expected="int8 with onnx; bfloat16 with eager or compile"
        )
    if runtime == "onnx" and (missing or device.type != "cpu"):
        raise WearcapError(
            f"runtime 'onnx' needs {', '.join(missing)}" if missing else f"runtime 'onnx' on {device}",
            expected="ONNX Runtime on the CPU",
            fix='Run: pip install "wearcap[export]", or choose pipeline.runtime=eager.',
        )
    return runtime, precision


def _step_of(net: MotionDenoiser, runtime: str, precision: str) -> Step:
    if runtime == "onnx":
        return _onnx_step(net, precision)
    step = net.step
    if runtime == "compile":
        # Static shapes; on a GPU, replayed as CUDA graphs.
        cuda = net.motion_normalizer.mean.device.type == "cuda"
        compiled = torch.compile(
            StepGraph(net), dynamic=False, fullgraph=True, mode="reduce-overhead" if cuda else None
        )

        def step(x_t: Tensor, plan: LevelPlan, encoded: Tensor, valid: Tensor, last: Tensor | None) -> Tensor:
            # Outputs of a CUDA graph are overwritten when it is replayed.
            return compiled(x_t, plan.worth, torch.stack(plan.blocks), encoded, valid, last).clone()

    if precision == "float32":
        return step

    def narrow(x_t: Tensor, *others) -> Tensor:
        # Norms stay in float32 under autocast; the sampler gets float32 outputs.
        with torch.autocast(x_t.device.type, torch.bfloat16):
            return step(x_t, *others).float()

    return narrow


def _onnx_step(net: MotionDenoiser, precision: str) -> Step:
    """The denoising step in ONNX Runtime."""
    batch, tokens, width = 2, net.window // net.frames_per_token, net.motion_encoder.linear.out_features
    x_t = torch.zeros(batch, net.window, net.motion_size)
    inputs = {
        "x_t": x_t,
        "worth": torch.zeros(1, 1, width),
        "blocks": torch.zeros(len(net.blocks), 1, 1, 6 * width),
        "encoded": torch.zeros(batch, tokens, width),
        "valid": torch.ones(batch, net.window, dtype=torch.bool),
    }
    if net.self_conditioning:
        inputs["last"] = x_t.clone()
    run = onnx_runner(StepGraph(net), inputs, fixed=("worth", "blocks"), int8=precision == "int8")

    def step(x_t: Tensor, plan: LevelPlan, encoded: Tensor, valid: Tensor, last: Tensor | None) -> Tensor:
        return run(x_t, plan.worth, torch.stack(plan.blocks), encoded, valid, last)[0]

    return step
