"""The steps of a sampler by the fastest means at hand: the levels' part ready-made, the rest by PyTorch or ONNX Runtime."""

import contextlib
import copy
import importlib.util
import logging
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from wearcap.errors import WearcapError, nearest
from wearcap.models.denoiser import LevelPlan, MotionDenoiser

RUNTIMES = ("auto", "eager", "compile", "onnx")
"""auto: on a GPU compiled (CUDA graphs), elsewhere ONNX Runtime where it is installed, else eager."""
PRECISIONS = ("auto", "narrowest", "float32", "bfloat16", "int8")
"""auto: bfloat16 on a GPU, else float32. narrowest: int8 with ONNX Runtime, too. int8 (weights, and activations as they come) with ONNX Runtime alone."""
_ONNX = ("onnx", "onnxscript", "onnxruntime")

Step = Callable[[Tensor, LevelPlan, Tensor, Tensor, Tensor | None], Tensor]
"""x̂0 from x_t, its level's plan, what `encode` said, `valid`, and the last x̂0 (with self-conditioning)."""


class StepGraph(nn.Module):
    """One step of a denoiser with its level's plan as tensors of one level: what is compiled or exported."""

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
    """x̂0 at a fixed row of levels, for any number of windows. The network's weights must not change while it is used."""

    def __init__(
        self,
        net: MotionDenoiser,
        levels: Float[Tensor, "step"],
        runtime: str = "eager",
        precision: str = "float32",
    ):
        """Raises WearcapError for a runtime or precision that is unknown, not installed, or that do not go together."""
        self.net = net
        device = net.motion_normalizer.mean.device
        runtime, precision = _chosen(runtime, precision, device)
        self.runtime = runtime
        """What was chosen."""
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
        """x̂0 at level `number` of the row."""
        if self.net.self_conditioning and last is None:
            last = torch.zeros_like(x_t)
        return self._step(x_t, self._plans[number], encoded, valid, last)

    @contextlib.contextmanager
    def undisturbed(self) -> Iterator[None]:
        """For few small windows: PyTorch's threads, which wait by spinning, leave the cores to ONNX Runtime's."""
        threads = torch.get_num_threads()
        if self.runtime == "onnx":
            torch.set_num_threads(1)
        try:
            yield
        finally:
            torch.set_num_threads(threads)


def _chosen(runtime: str, precision: str, device: torch.device) -> tuple[str, str]:
    for what, value, known in (("runtime", runtime, RUNTIMES), ("precision", precision, PRECISIONS)):
        if value not in known:
            raise WearcapError(
                f"no {what} {value!r}", expected=f"one of {', '.join(known)}", fix=nearest(value, known)
            )
    missing = [name for name in _ONNX if importlib.util.find_spec(name) is None]
    if runtime == "auto":
        plain = "eager" if missing or precision == "bfloat16" else "onnx"
        runtime = "compile" if device.type == "cuda" else plain
    if precision in ("auto", "narrowest"):
        plain = "int8" if runtime == "onnx" and precision == "narrowest" else "float32"
        precision = "bfloat16" if device.type == "cuda" else plain
    if (precision == "int8") > (runtime == "onnx") or (precision == "bfloat16" and runtime == "onnx"):
        raise WearcapError(f"no {precision} with runtime {runtime!r}", expected="int8 with onnx; bfloat16 with eager or compile")  # fmt: skip
    if runtime == "onnx" and (missing or device.type != "cpu"):
        raise WearcapError(
            f"runtime 'onnx' needs {', '.join(missing)}" if missing else f"runtime 'onnx' on {device}",
            expected="ONNX Runtime on the CPU", fix='Run: pip install "wearcap[export]", or choose pipeline.runtime=eager.',
        )  # fmt: skip
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
            # What a CUDA graph gives out is overwritten when it is replayed.
            return compiled(x_t, plan.worth, torch.stack(plan.blocks), encoded, valid, last).clone()

    if precision == "float32":
        return step

    def narrow(x_t: Tensor, *told) -> Tensor:
        # Norms stay in float32 under autocast, and so does the sampler, which sees what comes out.
        with torch.autocast(x_t.device.type, torch.bfloat16):
            return step(x_t, *told).float()

    return narrow


def _onnx_step(net: MotionDenoiser, precision: str) -> Step:
    """The step in ONNX Runtime, which keeps its weights packed and fuses what PyTorch does one by one."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    options.log_severity_level = 3
    # Threads spin between the operations of a step; behind it they leave the cores to what else runs.
    options.add_session_config_entry("session.force_spinning_stop", "1")
    with tempfile.TemporaryDirectory() as folder, quiet():
        path = Path(folder) / "step.onnx"
        _write_onnx(net, path)
        if precision == "int8":
            path = _narrowed(path)
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    names = [entry.name for entry in session.get_inputs()]

    def step(x_t: Tensor, plan: LevelPlan, encoded: Tensor, valid: Tensor, last: Tensor | None) -> Tensor:
        told = (x_t, plan.worth, torch.stack(plan.blocks), encoded, valid, last)
        arrays = {name: value.contiguous().numpy() for name, value in zip(names, told) if value is not None}
        return torch.from_numpy(session.run(None, arrays)[0])

    return step


def _write_onnx(net: MotionDenoiser, path: Path) -> None:
    graph = StepGraph(copy.deepcopy(net).cpu().eval())
    batch, tokens, width = 2, net.window // net.frames_per_token, net.motion_encoder.linear.out_features
    x_t = torch.zeros(batch, net.window, net.motion_size)
    inputs = {
        "x_t": x_t, "worth": torch.zeros(1, 1, width), "blocks": torch.zeros(len(net.blocks), 1, 1, 6 * width),
        "encoded": torch.zeros(batch, tokens, width), "valid": torch.ones(batch, net.window, dtype=torch.bool),
    }  # fmt: skip
    if net.self_conditioning:
        inputs["last"] = x_t.clone()
    lanes = {0: torch.export.Dim("batch", min=1)}
    dynamic = {name: None if name in ("worth", "blocks") else lanes for name in inputs}
    with torch.no_grad():
        program = torch.export.export(graph, (), inputs, dynamic_shapes=dynamic)
        torch.onnx.export(program, (), path, kwargs=inputs, dynamo=True, external_data=False)


def _narrowed(path: Path) -> Path:
    """The same network with weights as int8 per channel; activations are scaled as they come."""
    from onnxruntime.quantization import QuantType, quantize_dynamic

    narrow = path.with_name("step8.onnx")
    quantize_dynamic(path, narrow, weight_type=QuantType.QInt8, per_channel=True, reduce_range=True)
    return narrow


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """The exporters speak at length of optional libraries and of what they fold together."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(None):
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)
