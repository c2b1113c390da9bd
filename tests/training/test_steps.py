"""Budgets, compiled steps, averages of weights and the speed of a run."""

import csv
import itertools
import math
import os
import shutil
import subprocess
import sys
from contextlib import nullcontext
from datetime import timedelta
from types import SimpleNamespace

import lightning
import pytest
import torch
from lightning.pytorch.callbacks import EMAWeightAveraging
from lightning.pytorch.loggers import CSVLogger
from torch import nn

from wearcap.cli.conf import compose
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.models.layers import attention
from wearcap.training import losses
from wearcap.training.base import WORTH_COMPILING, Optimization, Training, timer_of
from wearcap.training.callbacks import MovingAverage, Speed, StepsProgressBar
from wearcap.training.schedules import warmup_cosine


class Small(Training):
    """A network of two layers with a buffer, whose target is 1."""

    def __init__(self, dropout: float = 0.0, scheduler=None):
        super().__init__(Optimization(lambda weights: torch.optim.AdamW(weights, lr=0.01, fused=True), scheduler))
        torch.manual_seed(0)
        self.net = nn.Sequential(nn.Linear(3, 4, bias=False), nn.BatchNorm1d(4), nn.Dropout(dropout), nn.Linear(4, 1))

    def measure(self, batch):
        return {"loss": (self.net(batch[0]) - 1).square().mean()}


class Batches:
    """Whole batches, as wearcap's loaders give them; `each` is called before one is drawn."""

    def __init__(self, count: int, each=lambda: None):
        self.count, self.each = count, each

    def __len__(self) -> int:
        return self.count

    def __iter__(self):
        random = torch.Generator().manual_seed(1)
        for _ in range(self.count):
            self.each()
            yield (torch.randn(5, 3, generator=random),)


def trainer(*callbacks: lightning.Callback, **settings) -> lightning.Trainer:
    off = {"logger": False, "enable_checkpointing": False, "enable_model_summary": False, "num_sanity_val_steps": 0}
    off |= {"enable_progress_bar": any(isinstance(each, StepsProgressBar) for each in callbacks)}
    return lightning.Trainer(accelerator="cpu", callbacks=[*callbacks], **off | settings)


@pytest.mark.parametrize("use_buffers", [False, True])
def test_averages_are_lightnings(use_buffers):
    averages = MovingAverage(0.8, use_buffers), EMAWeightAveraging(decay=0.8, use_buffers=use_buffers)
    states = []
    for average in averages:
        trained = Small()
        trainer(average, max_steps=7).fit(trained, Batches(7))
        states.append(trained.state_dict())
    assert states[0].keys() == states[1].keys()
    floating = {name: value for name, value in states[0].items() if value.is_floating_point()}
    for name, value in floating.items():
        torch.testing.assert_close(value, states[1][name], msg=name)
    assert averages[0].state_key == averages[1].state_key


@pytest.mark.parametrize(
    ("asked", "dropout", "steps", "cpu", "compiled"),
    [
        ("auto", 0.0, WORTH_COMPILING, "AVX2", True),
        ("auto", 0.0, WORTH_COMPILING, "DEFAULT", False),
        ("auto", 0.0, WORTH_COMPILING - 1, "AVX2", False),
        ("auto", 0.1, WORTH_COMPILING, "AVX2", False),
        (True, 0.1, 2, "AVX2", True),
        (False, 0.0, WORTH_COMPILING, "AVX2", False),
    ],
)
def test_steps_are_compiled_where_it_pays(asked, dropout, steps, cpu, compiled, monkeypatch):
    monkeypatch.setattr("shutil.which", str)
    monkeypatch.setattr("torch.backends.cpu.get_cpu_capability", lambda: cpu)
    made = Small(dropout, compile=asked)
    made._trainer = SimpleNamespace(max_steps=steps)
    assert made._is_compiled() == compiled


def test_without_a_compiler_steps_are_eager_with_a_warning(monkeypatch):
    monkeypatch.setattr("shutil.which", lambda name: None)
    made = Small(compile=True)
    with pytest.warns(UserWarning, match=r"no C\+\+ compiler"):
        trainer(max_steps=2).fit(made, Batches(2))
    assert made._measure == made.measure
    with pytest.raises(WearcapError, match="model.compile='yes'"):
        trainer(max_steps=2).fit(Small(compile="yes"), Batches(2))


COMPILED = """
import sys, torch
sys.path.insert(0, {folder!r})
from test_steps import Batches, Small, trainer
states = []
for asked in (False, True):
    made = Small(dropout=0.0, compile=asked)
    trainer(max_steps=3).fit(made, Batches(3))
    states.append(made.state_dict())
assert states[0].keys() == states[1].keys(), states[1].keys()
print(max((a.double() - b.double()).abs().max().item() for a, b in zip(*(state.values() for state in states))))
"""


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="needs a C++ compiler")
def test_compiled_steps_are_those_of_eager_ones():
    """In a process of its own: what checks the shapes in tests cannot be compiled."""
    code = COMPILED.format(folder=os.path.dirname(__file__))
    environment = os.environ | {"TORCHINDUCTOR_COMPILE_THREADS": "1"}
    environment.pop("ATEN_CPU_CAPABILITY", None)  # PyTorch compiles for CPUs with vector instructions alone
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr[-2000:]
    assert float(done.stdout.split()[-1]) < 1e-5


HALVES = """
import sys, torch
from contextlib import nullcontext
from datetime import timedelta
sys.path.insert(0, {folder!r})
from test_steps import Batches, MovingAverage, Small, Speed, trainer, warmup_cosine

class Half(Small):
    def measure(self, batch):
        rank, world = self.global_rank, self.trainer.world_size
        return {{"loss": self.net(batch[0].repeat(2, 1)[rank::world]).square().mean()}}

if __name__ == "__main__":
    made = Half(scheduler=lambda optimizer, **more: warmup_cosine(optimizer, 2, 6, **more))
    made.net[1] = torch.nn.LayerNorm(4)
    settings = dict(devices=2, strategy="ddp") if {processes} == 2 else dict()
    trainer(MovingAverage(0.5), Speed(), max_steps=6, max_time=timedelta(days=1000), **settings).fit(made, Batches(6))
    if made.global_rank == 0:
        torch.save(made.state_dict(), {path!r})
"""


@pytest.mark.slow
def test_two_processes_agree_with_one(tmp_path):
    states = []
    for processes in (1, 2):
        script, path = tmp_path / f"{processes}.py", str(tmp_path / f"{processes}.pt")
        script.write_text(HALVES.format(folder=os.path.dirname(__file__), processes=processes, path=path))
        done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, check=False, timeout=120)
        assert done.returncode == 0, done.stderr[-2000:]
        states.append(torch.load(path, weights_only=True))
    for name, value in states[0].items():
        torch.testing.assert_close(value, states[1][name], msg=name)


def test_the_learning_rate_follows_what_ends_first():
    weight, clock = torch.nn.Parameter(torch.zeros(())), [0.0]
    for total in (-1, 1000, 5):
        optimizer = torch.optim.SGD([weight], lr=1.0)
        schedule = warmup_cosine(optimizer, warmup=1, total=total, floor=0.0, elapsed=lambda: clock[0])
        for step in range(1, 5):
            clock[0] = step / 8
            optimizer.step()
            schedule.step()
            spent = max(step / 8, (step - 1) / (total - 1) if total > 0 else 0.0)
            assert optimizer.param_groups[0]["lr"] == pytest.approx(0.5 * (1 + math.cos(math.pi * spent)))


def test_a_budget_of_time_goes_on_where_it_was_left(tmp_path, monkeypatch):
    """Each clock reading of Lightning's timer is a second later than the one before."""
    ticks, rates = iter(range(10**6)), []
    monkeypatch.setattr("lightning.pytorch.callbacks.timer.time.monotonic", lambda: next(ticks))

    class Rates(lightning.Callback):
        def on_train_batch_end(self, trainer, pl_module, *batch):
            rates.append(trainer.optimizers[0].param_groups[0]["lr"])

    def made() -> Small:
        return Small(scheduler=lambda optimizer, **more: warmup_cosine(optimizer, 1, -1, floor=0.0, **more))

    settings = {"max_time": timedelta(seconds=100), "max_epochs": -1}
    first = trainer(Rates(), max_steps=8, **settings)
    first.fit(made(), Batches(4))
    first.save_checkpoint(tmp_path / "x.ckpt")
    before = rates[-1]
    second = trainer(Rates(), max_steps=-1, **settings)
    second.fit(made(), Batches(4), ckpt_path=tmp_path / "x.ckpt", weights_only=False)
    assert all(b < a for a, b in itertools.pairwise(rates[1:]))
    assert 0.7 * before < rates[8] < before, "the share that had passed counts"
    assert rates[-1] < 0.001 * rates[1]
    timer = timer_of(second)
    assert timer is not None
    assert timer.time_elapsed() >= 100 > timer.time_elapsed() - 5 * 3


def test_a_run_shows_its_speed(tmp_path, monkeypatch):
    """Steps take two seconds, their batches one."""
    now = [0.0]
    monkeypatch.setattr("wearcap.training.callbacks.time.perf_counter", lambda: now[0])

    def later(seconds: float) -> None:
        now[0] += seconds

    class Slow(Small):
        def training_step(self, batch, index):
            later(2.0)
            return super().training_step(batch, index)

        def val_dataloader(self):
            return Batches(2)

    logged = CSVLogger(tmp_path, name="", version="")
    bar = StepsProgressBar()
    fitted = trainer(Speed(), bar, max_epochs=2, logger=logged, log_every_n_steps=2)
    fitted.fit(Slow(), Batches(6, lambda: later(1.0)))
    with open(tmp_path / "metrics.csv") as file:
        rows = [row for row in csv.DictReader(file) if row["speed/windows_per_s"]]
    assert [float(row["speed/windows_per_s"]) for row in rows] == pytest.approx([5 / 3] * 2, rel=0.01)
    assert [float(row["speed/waiting"]) for row in rows] == pytest.approx([1 / 3] * 2, rel=0.01)
    assert float(rows[0]["speed/minutes_left"]) == pytest.approx(6 * 3 / 60, rel=0.2)
    assert fitted.progress_bar_metrics.keys() >= {"windows_per_s", "waiting", "minutes_left", "train/loss"}


@pytest.mark.parametrize("experiment", ["full/hmd2", "full/mocap_every", "full/echo"])
def test_a_gpu_gets_everything_without_further_settings(experiment):
    config = compose("train", [f"experiment={experiment}", "trainer=gpu", "paths.run=x"])
    assert (config.trainer.precision, config.trainer.accelerator) == ("bf16-mixed", "gpu")
    assert config.model.compile == "auto"
    assert config.optimizer.optimizer.get("fused", "prodigy" in config.optimizer.optimizer._target_)


def test_attention_in_bfloat16_on_a_cpu_is_pytorchs():
    torch.manual_seed(0)
    q, k, v = torch.randn(3, 2, 4, 7, 8).bfloat16().requires_grad_().unbind()
    mask = (torch.rand(2, 1, 7, 7) < 0.7) | torch.eye(7, dtype=torch.bool)
    wide = torch.nn.functional.scaled_dot_product_attention(q.float(), k.float(), v.float(), mask)
    torch.testing.assert_close(attention(q, k, v, mask).float(), wide, atol=0.03, rtol=0.03)


def test_geometry_is_exact_under_autocast():
    torch.manual_seed(0)
    R, t = rotation.exp(torch.randn(9, 3)), 10 * torch.rand(9, 3, 1)
    errors = []
    for context in (nullcontext(), losses.exact(t)):
        with torch.autocast("cpu", torch.bfloat16), context:
            errors.append(((R @ t).double() - R.double() @ t.double()).abs().max())
    assert errors[0] > 5e-3
    assert errors[1] < 1e-5
