"""Networks as graphs: one description of a network's parts, which are run eagerly, compiled or in ONNX Runtime.

`wearcap export` writes the same graphs that `run_of` runs. In a denoiser, what depends on the noise levels alone is computed
once per level: it has `plan(level) -> LevelPlan` and `step(x_t, plan, encoded, valid[, last])`, and its graphs pass a plan as
one tensor of columns.
"""

import contextlib
import copy
import importlib.util
import logging
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from wearcap import extras
from wearcap.body.skeleton import Site, Skeleton
from wearcap.boundary.opening import file_size
from wearcap.diffusion.schedule import CosineSchedule, Schedule
from wearcap.errors import WearcapError, nearest, require_choice

RUNTIMES = ("auto", "eager", "compile", "onnx")
"""Backends; auto: compiled (CUDA graphs) on a GPU, else ONNX Runtime where it is installed, else eager. All but eager
take some seconds to start."""
PRECISIONS = ("auto", "narrowest", "float32", "bfloat16", "int8")
"""Number formats; auto: bfloat16 on a GPU, else float32; narrowest: as auto, but int8 with ONNX Runtime.
int8 (weights, and dynamically quantised activations) needs ONNX Runtime."""
Run = Callable[..., Tensor]
"""A network's output from its inputs by name."""
Count = Annotated[int, msgspec.Meta(ge=0, le=1 << 20)]
"""Frames, features and other sizes in a sidecar."""
Rate = Annotated[float, msgspec.Meta(gt=0, le=10_000)]
"""Frame rate (Hz) in a sidecar."""


@dataclass(frozen=True, eq=False)
class Graph:
    """A network, or a part of one, as a function of named tensors that returns one tensor."""

    module: nn.Module | Run
    inputs: dict[str, Tensor]
    """Example inputs by name, with a batch axis of 2 or more; all other axes are fixed."""
    shared: tuple[str, ...] = ()
    """Names of inputs without a batch axis."""


@dataclass(frozen=True, eq=False)
class Exports:
    """What a system exports: its graphs, and everything else that running them needs."""

    network: str
    """Name of the system's folder."""
    graphs: dict[str, Graph]
    """Graphs by name; the first is the model's own file, the others are files beside it."""
    about: dict[str, Any]
    """Entries of the sidecar."""
    max_error: float = 1e-4
    """Largest difference of an output from eager's."""
    weights: Mapping[str, nn.Module] = field(default_factory=dict)
    """Modules that are not exported as graphs, whose weights are written beside the model."""


class Call(nn.Module):
    """A module whose `forward` is another method of a network."""

    def __init__(self, net: nn.Module, method: str):
        super().__init__()
        self.net = net
        self.forward = getattr(net, method)


class LevelPlan(NamedTuple):
    """The part of a denoising step that depends on the noise levels alone."""

    worth: tuple[Float[Tensor, "batch #token width"], ...]
    """Per-channel scale of the encoded x_t, for each encoder of the motion (`MotionEncoder.plan`)."""
    blocks: tuple[Float[Tensor, "batch #token modulation"], ...]
    """Modulation of every adaptive transformer block."""


class PlanGraph(nn.Module):
    """A plan's columns from levels."""

    def __init__(self, net: Any):
        super().__init__()
        self.net = net

    def forward(self, level: Float[Tensor, "batch *token"]) -> Float[Tensor, "batch #token column"]:
        plan = self.net.plan(level)
        return torch.cat([*plan.worth, *plan.blocks], -1)


class StepGraph(nn.Module):
    """x̂0 from x_t and a plan's columns."""

    def __init__(self, net: Any, level: Float[Tensor, "batch *token"]):
        """`level`: any levels, of the shape that `net.plan` takes."""
        super().__init__()
        self.net = net
        with torch.no_grad():
            plan = net.plan(level)
        self._worths = len(plan.worth)
        self._sizes = [part.shape[-1] for part in (*plan.worth, *plan.blocks)]

    @property
    def columns(self) -> int:
        """Columns of a plan."""
        return sum(self._sizes)

    def forward(
        self,
        x_t: Float[Tensor, "batch time motion"],
        plan: Float[Tensor, "#batch #token column"],
        encoded: Float[Tensor, "batch token width"],
        valid: Bool[Tensor, "batch time"],
        last: Float[Tensor, "batch time motion"] | None = None,
    ) -> Float[Tensor, "batch time motion"]:
        """`last`: x̂0 of the previous step, for a network with self-conditioning."""
        parts = plan.split(self._sizes, -1)
        more = () if last is None else (last,)
        return self.net.step(x_t, LevelPlan(parts[: self._worths], parts[self._worths :]), encoded, valid, *more)


def chosen(runtime: str, precision: str, device: torch.device | str) -> tuple[str, str]:
    """Backend and number format for a device, without "auto" and "narrowest".

    Raises WearcapError for those that are unknown, not installed, or that do not go together.
    """
    device = torch.device(device)
    for what, value, allowed in (("runtime", runtime, RUNTIMES), ("precision", precision, PRECISIONS)):
        if value not in allowed:
            expected = f"one of {', '.join(allowed)}"
            raise WearcapError(f"no {what} {value!r}", expected=expected, fix=nearest(value, allowed))
    missing = missing_libraries()
    if runtime == "auto":
        plain = "eager" if missing or precision == "bfloat16" else "onnx"
        runtime = "compile" if device.type == "cuda" else plain
    if precision in ("auto", "narrowest"):
        plain = "int8" if runtime == "onnx" and precision == "narrowest" else "float32"
        precision = "bfloat16" if device.type == "cuda" else plain
    if runtime == "onnx" and (missing or device.type != "cpu"):
        if missing:
            raise extras.missing(missing[0], "runtime 'onnx'", "choose pipeline.runtime=eager")
        expected, fix = "ONNX Runtime on the CPU", "Choose pipeline.runtime=eager."
        raise WearcapError(f"runtime 'onnx' on {device}", expected=expected, fix=fix)
    if (precision == "int8") > (runtime == "onnx") or (precision == "bfloat16" and runtime == "onnx"):
        expected = "int8 with onnx; bfloat16 with eager or compile"
        raise WearcapError(f"no {precision} with runtime {runtime!r}", expected=expected)
    return runtime, precision


def run_of(graph: Graph, runtime: str = "eager", precision: str = "float32") -> Run:
    """A graph with its current weights in a backend and number format, as `chosen` returns them."""
    if runtime == "onnx":
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "network.onnx"
            exported = program(graph)
            with quiet(), torch.inference_mode():
                torch.onnx.export(exported, (), path, kwargs=graph.inputs, dynamo=True, external_data=False)
            if precision == "int8":
                from onnxruntime.quantization import QuantType, quantize_dynamic

                wide, path = path, path.with_name("network8.onnx")
                quantize_dynamic(wide, path, weight_type=QuantType.QInt8, per_channel=True, reduce_range=True)
            return open_onnx(path)
    run: Run = graph.module
    if runtime == "compile":
        # Static shapes; on a GPU replayed as CUDA graphs, whose outputs are overwritten by the next replay.
        assert isinstance(graph.module, nn.Module)
        cuda = any(weight.device.type == "cuda" for weight in graph.module.parameters())
        mode = "reduce-overhead" if cuda else None
        compiled = torch.compile(graph.module, dynamic=False, fullgraph=True, mode=mode)
        run = lambda **inputs: compiled(**inputs).clone()  # noqa: E731
    if precision == "float32":
        return run

    def narrow(**inputs: Tensor) -> Tensor:
        # Norms stay in float32 under autocast; callers get float32.
        with torch.autocast(next(iter(inputs.values())).device.type, torch.bfloat16):
            return run(**inputs).float()

    return narrow


def program(graph: Graph) -> torch.export.ExportedProgram:
    """The graph as an exported program on the CPU, with a dynamic batch axis."""
    batch_axis = {0: torch.export.Dim("batch", min=1)}
    dynamic = {name: None if name in graph.shared else batch_axis for name in graph.inputs}
    with quiet(), torch.inference_mode():
        assert isinstance(graph.module, nn.Module)
        module = copy.deepcopy(graph.module).cpu().eval()
        return torch.export.export(module, (), graph.inputs, dynamic_shapes=dynamic)


def open_onnx(path: str | Path) -> Run:
    """An ONNX file in ONNX Runtime on the CPU.

    Its operators are ONNX Runtime's own, its weights in the file or beside it (ONNX Runtime refuses others). Raises
    WearcapError when it is missing or not readable.
    """
    onnxruntime = extras.required("onnxruntime", "an ONNX file")
    file_size(path, "exported model")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    options.log_severity_level = 3
    # Threads spin between the operations of a step; after it they yield the cores to other work.
    options.add_session_config_entry("session.force_spinning_stop", "1")
    # What is computed while a file is opened may be of any size.
    options.add_session_config_entry("optimization.constant_folding_max_output_size_in_bytes", str(1 << 24))
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's exceptions share no base of their own
        why = (str(error).splitlines() or [type(error).__name__])[0][:120]
        fix = "Copy it again, or export it again with `wearcap export`."
        raise WearcapError(f"not a readable ONNX file ({why})", where=path, fix=fix) from error

    def run(**inputs: Tensor) -> Tensor:
        arrays = {name: value.contiguous().numpy() for name, value in inputs.items()}
        return torch.from_numpy(session.run(None, arrays)[0])

    return run


def missing_libraries() -> list[str]:
    """Names of the packages for ONNX Runtime and its exporter that are not installed."""
    return [name for name in ("onnx", "onnxscript", "onnxruntime") if importlib.util.find_spec(name) is None]


@contextlib.contextmanager
def undisturbed(onnx: bool = True) -> Iterator[None]:
    """A context for small batches in which PyTorch's spinning threads leave the cores to ONNX Runtime's."""
    threads = torch.get_num_threads()
    if onnx:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """A context that silences the exporters' messages about optional libraries and constant folding."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(None):
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)


SCHEDULES = {"CosineSchedule": CosineSchedule}
ROT6D = tuple(f"{column}{axis}" for column in "xy" for axis in "xyz")
"""First two columns of a rotation matrix, one after the other."""


def schedule_to_json(schedule: Schedule) -> dict[str, Any]:
    """A schedule by name and settings. Raises WearcapError for one of another class than `SCHEDULES`."""
    name = type(schedule).__name__
    require_choice(name, SCHEDULES, f"schedule {name} cannot be exported")
    return {"name": name, **vars(schedule)}


def schedule_from_json(tree: dict[str, float | str]) -> Schedule:
    """The inverse of `schedule_to_json`."""
    return SCHEDULES[tree["name"]](**{key: value for key, value in tree.items() if key != "name"})


def skeleton_to_json(skeleton: Skeleton) -> dict[str, Any]:
    """A skeleton as plain data; offsets in m."""
    return {
        "name": skeleton.name,
        "joint_names": skeleton.joint_names,
        "parents": skeleton.parents,
        "t_parent_joint": skeleton.t_parent_joint.tolist(),
        "sites": {name: [site.joint, *site.t_joint_site] for name, site in skeleton.sites.items()},
    }


class SkeletonEntry(msgspec.Struct):
    """A skeleton in a sidecar; offsets in m."""

    name: str
    joint_names: tuple[str, ...]
    parents: tuple[int, ...]
    t_parent_joint: list[tuple[float, float, float]]
    sites: dict[str, tuple[str, float, float, float]]

    def skeleton(self) -> Skeleton:
        """The inverse of `skeleton_to_json`."""
        sites = {name: Site(joint, (x, y, z)) for name, (joint, x, y, z) in self.sites.items()}
        return Skeleton(self.name, self.joint_names, self.parents, torch.tensor(self.t_parent_joint), sites)
