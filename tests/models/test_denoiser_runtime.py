"""The steps of a sampler in other runtimes give the plain network's outputs."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from wearcap.errors import WearcapError
from wearcap.models.layers import TransformerSize
from wearcap.systems.hmd2.model import Conditions, MotionDenoiser, StepRunner

LEVELS = torch.tensor([1.0, 0.6, 0.2])


def network(device: str = "cpu", **changes) -> MotionDenoiser:
    torch.manual_seed(0)
    net = MotionDenoiser(
        12, 5, 16, TransformerSize(32, 2, 4, 64, 0.1), frames_per_token=4, blend=5, conditions={"points": 6}, **changes
    )
    for parameter in net.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    return net.eval().to(device)


def inputs_of(net: MotionDenoiser, batch: int, device: str = "cpu"):
    """x_t, what the conditions say, `valid` with a window that is still growing, the last x̂0."""
    torch.manual_seed(1)
    valid = torch.arange(16).expand(batch, -1) < torch.tensor([[9]] + [[16]] * (batch - 1))
    conditions = Conditions(torch.randn(batch, 16, 5), torch.randn(batch, 16, 6), valid[..., None])
    with torch.inference_mode():
        encoded = net.encode(Conditions(*(part.to(device) for part in conditions)), valid.to(device))
    x_t, last = torch.randn(2, batch, 16, 12)
    return x_t.to(device), encoded, valid.to(device), last.to(device) if net.self_conditioning else None


def worst(net: MotionDenoiser, runner: StepRunner, batch: int, device: str = "cpu") -> float:
    """Largest difference from the plain network over all levels, on frames that exist."""
    x_t, encoded, valid, last = inputs_of(net, batch, device)
    differences = []
    with torch.inference_mode():
        for number, level in enumerate(LEVELS.to(device)):
            plain = net(x_t, level.expand(batch, 1), encoded, valid, last)
            step = runner(number, x_t, encoded, valid, last)
            assert step.dtype == torch.float32
            differences.append((step - plain)[valid].abs().max().item())
    return max(differences)


@pytest.mark.parametrize("self_conditioning", [False, True])
def test_a_plan_made_once_changes_nothing(self_conditioning):
    net = network(self_conditioning=self_conditioning)
    assert worst(net, StepRunner(net, LEVELS), 3) < 1e-5


def test_onnx_runtime_gives_the_same_for_any_number_of_windows():
    net = network(self_conditioning=True)
    runner = StepRunner(net, LEVELS, "onnx")
    assert max(worst(net, runner, batch) for batch in (1, 3)) < 1e-5


def test_pytorch_leaves_the_cores_to_onnx_runtime():
    before = torch.get_num_threads()
    for runtime, threads in (("onnx", 1), ("eager", before)):
        with StepRunner(network(), LEVELS, runtime).undisturbed():
            assert torch.get_num_threads() == threads
    assert torch.get_num_threads() == before


def test_narrow_products_say_nearly_the_same():
    net = network()
    spread = inputs_of(net, 3)[0].std().item()
    assert 0 < worst(net, StepRunner(net, LEVELS, "eager", "bfloat16"), 3) < 0.1 * spread
    assert 0 < worst(net, StepRunner(net, LEVELS, "auto", "narrowest"), 3) < 0.3 * spread, "int8"


COMPILED = """
import sys

sys.path.insert(0, {folder!r})
from test_denoiser_runtime import LEVELS, StepRunner, network, worst

net = network({device!r})
print(worst(net, StepRunner(net, LEVELS, {runtime!r}, {precision!r}), 3, {device!r}))
"""


def worst_of_compiled(device: str, runtime: str, precision: str) -> float:
    """In a process of its own: what checks the shapes in tests cannot be compiled."""
    folder = str(Path(__file__).parent)
    code = COMPILED.format(folder=folder, device=device, runtime=runtime, precision=precision)
    # Compiled in that process itself: others that help would have to import PyTorch first.
    environment = os.environ | {"TORCHINDUCTOR_COMPILE_THREADS": "1"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr[-2000:]
    return float(done.stdout.split()[-1])


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="needs a C++ compiler")
def test_compiled_it_gives_the_same():
    assert worst_of_compiled("cpu", "compile", "float32") < 1e-5


@pytest.mark.gpu
def test_on_a_gpu_it_is_compiled_in_bfloat16():
    assert worst_of_compiled("cuda", "auto", "float32") < 1e-4
    assert 0 < worst_of_compiled("cuda", "auto", "auto") < 0.1


@pytest.mark.parametrize(
    ("runtime", "precision", "message"),
    [("onyx", "float32", "no runtime 'onyx'"), ("eager", "float64", "no precision"), ("eager", "int8", "no int8 with")],
)
def test_what_cannot_be_is_refused(runtime, precision, message):
    with pytest.raises(WearcapError, match=message):
        StepRunner(network(), LEVELS, runtime, precision)


def test_without_onnx_runtime_auto_is_eager_and_onnx_is_refused(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    net = network()
    assert worst(net, StepRunner(net, LEVELS, "auto", "narrowest"), 1) < 1e-5
    with pytest.raises(WearcapError, match="needs the package .onnx"):
        StepRunner(net, LEVELS, "onnx")
