"""ECHO's runtimes agree with each other; level-dependent activations are computed once, and their cache is bounded."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from carried_box import WINDOW, drawn_echo, small_features, small_net
from wearcap.errors import WearcapError
from wearcap.systems.echo import model as echo_model
from wearcap.systems.echo.model import EchoPlans, EchoRunner


def levels_of(items: int, frames: int, start: int) -> torch.Tensor:
    """Levels as on a queue, with an object that enters at another frame in every batch item."""
    level = torch.linspace(0, 1, frames)[None, :, None].repeat(items, 1, 3)
    for batch_item in range(items):
        level[batch_item, : max(start - batch_item, 0), 1] = 1.0
    return level


def conditioning(items: int, frames: int) -> list[torch.Tensor]:
    """Condition, object, whether there is one, and which frames are valid."""
    features, random = small_features(), torch.Generator().manual_seed(0)
    sizes = features.condition_size, len(small_net(features).no_object)
    condition, code = (torch.randn(items, frames, size, generator=random) for size in sizes)
    valid = torch.arange(frames).expand(items, -1) < frames - torch.arange(items)[:, None]
    return [condition, code, torch.rand(items, frames, generator=random) < 0.5, valid]


@pytest.mark.parametrize("streams", [1, 3])
@pytest.mark.parametrize("items", [1, 2])
def test_plans_are_those_of_the_network(streams, items):
    net = small_net(small_features(), streams=streams)
    plans = EchoPlans(net)
    for start in (0, 3, 4, 9):
        level = levels_of(items, WINDOW, start)
        found, expected = plans(level), net.plan(level)
        expected = torch.cat([*expected.worth, *expected.blocks], -1)
        torch.testing.assert_close(found.expand_as(expected), expected)


def test_plans_do_not_pile_up(monkeypatch):
    monkeypatch.setattr(echo_model, "MOST_ROWS", 50)
    net = small_net(small_features())
    plans, random = EchoPlans(net), torch.Generator().manual_seed(0)
    for _ in range(20):
        level = torch.rand(1, WINDOW, 3, generator=random)
        width = net.plan(level).worth[0].shape[-1]
        torch.testing.assert_close(plans(level)[..., :width], net.plan(level).worth[0])
        assert len(plans._rows) == len(plans._number) <= 50 + WINDOW
        assert len(plans._windows) <= echo_model.MOST_WINDOWS


def test_batch_items_of_the_same_levels_share_a_plan():
    plans = EchoPlans(small_net(small_features()))
    assert plans(levels_of(1, WINDOW, 2).repeat(4, 1, 1)).shape[:2] == (1, WINDOW)


def outputs(runner: EchoRunner) -> list[torch.Tensor]:
    """x̂0 of a full window, and of some that are not full yet."""
    answers, random = [], torch.Generator().manual_seed(1)
    for items, frames in ((1, WINDOW), (2, 5)):
        level = levels_of(items, frames, 3)
        x_t = torch.randn(items, frames, sum(runner.net.sizes), generator=random)
        answers.append(runner.begin(*conditioning(items, frames))(x_t, level))
    return answers


@torch.no_grad()
def worst_of(runtime: str, device: str = "cpu") -> float:
    """Largest difference from eager steps."""
    net = small_net(small_features(), streams=3, blend=3)
    expected = outputs(EchoRunner(net))
    found = outputs(EchoRunner(net.to(device), runtime))
    return max((one - two).abs().max().item() for one, two in zip(found, expected))


@pytest.mark.slow
def test_onnx_runtime_agrees_with_eager():
    pytest.importorskip("onnxruntime")
    assert worst_of("onnx") < 1e-4


def worst_of_compiled(device: str) -> float:
    """In its own process: the tests' shape checks cannot be compiled."""
    program = f"from test_echo_runtime import worst_of; print(worst_of('compile', {device!r}))"
    here = Path(__file__).parent
    paths = os.pathsep.join([str(here), str(here.parent), *sys.path])
    # Compiled in that process itself: others that help would have to import PyTorch first.
    environment = os.environ | {"PYTHONPATH": paths, "TORCHINDUCTOR_COMPILE_THREADS": "1"}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr[-2000:]
    return float(done.stdout)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="needs a C++ compiler")
def test_compiled_steps_agree_with_eager():
    assert worst_of_compiled("cpu") < 1e-4


@pytest.mark.gpu
def test_gpu_steps_agree_with_eager():
    assert worst_of_compiled("cuda") < 1e-3


def test_runtimes_that_cannot_run_are_refused():
    with pytest.raises(WearcapError, match="one of auto, eager, compile, onnx"):
        drawn_echo(runtime="onix")
    with pytest.raises(WearcapError, match="runtime 'onnx' on cuda"):
        drawn_echo(runtime="onnx", device="cuda")
