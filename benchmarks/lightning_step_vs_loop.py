"""A Lightning training step of the small configuration, against a hand-written loop's step.

Same network, losses, clipping, optimiser, schedule and loader; the two take turns step by step inside one run, so that
whatever else the machine does falls on both. A step is everything from one batch's end to the next one's.
value and baseline: median ms over 100 steps. ratio = value / baseline, to be at most `goal`.
"""

import itertools
import logging
import statistics
import tempfile
import time
from collections.abc import Iterator

import lightning
import planted
import torch
from hydra.utils import instantiate
from lightning.pytorch import Callback
from omegaconf import DictConfig

from wearcap.cli.conf import compose
from wearcap.systems.hmd2.training import MotionDiffusion

WARM_UP = 5


def measure(steps: int = 100, overrides: tuple[str, ...] = ()) -> list[dict]:
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    with tempfile.TemporaryDirectory() as folder:
        planted.write_store(f"{folder}/simulated", (30.0, 20.0, 10.0))
        config = compose(
            "train",
            [
                "experiment=motion_diffusion_head",
                f"paths.datasets={folder}",
                f"paths.run={folder}",
                f"trainer.max_steps={steps + WARM_UP}",
                f"data.loading.steps_per_epoch={steps + WARM_UP}",
                *overrides,
            ],
        )
        torch.manual_seed(0)
        turns = _TakeTurns(_hand_written(config))
        system, data = instantiate(config.model), instantiate(config.data, _convert_="all")
        system.set_statistics(data.dataset("train"))
        trainer = lightning.Trainer(
            accelerator="cpu",
            max_steps=config.trainer.max_steps,
            gradient_clip_val=config.trainer.gradient_clip_val,
            log_every_n_steps=config.trainer.log_every_n_steps,
            use_distributed_sampler=False,
            limit_val_batches=0,
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            callbacks=[turns],
        )
        trainer.fit(system, datamodule=data)
    value, baseline = (1000 * statistics.median(times[WARM_UP:]) for times in (turns.lightning, turns.by_hand))
    return [
        {
            "name": "lightning_step_vs_loop",
            "value": value,
            "unit": "ms per step",
            "baseline": baseline,
            "ratio": value / baseline,
            "goal": 1.05,
        }
    ]


class _TakeTurns(Callback):
    """Times the Trainer's steps and, after each of them, one step of the hand-written loop."""

    def __init__(self, loop: Iterator[float]):
        self.loop = loop
        self.lightning: list[float] = []
        self.by_hand: list[float] = []
        self._resumed: float | None = None

    def on_train_batch_end(self, *_) -> None:
        ended = time.perf_counter()
        if self._resumed is not None:
            self.lightning.append(ended - self._resumed)
        next(self.loop)
        self._resumed = time.perf_counter()
        self.by_hand.append(self._resumed - ended)


def _hand_written(config: DictConfig) -> Iterator[float]:
    """The loop one would write without Lightning; yields the loss once per step."""
    system: MotionDiffusion = instantiate(config.model)
    data = instantiate(config.data, _convert_="all")
    data.setup("fit")
    system.set_statistics(data.dataset("train"))
    weights = system.loss_weights
    optimizer = instantiate(config.optimizer.optimizer)(system.net.parameters())
    scheduler = instantiate(config.optimizer.scheduler)(optimizer)
    loader = data.train_dataloader()
    system.train()
    for batch in itertools.chain.from_iterable(itertools.repeat(loader)):
        optimizer.zero_grad()
        loss = torch.stack([weights.get(name, 0.0) * term for name, term in system.terms(batch).items()]).sum()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(system.net.parameters(), config.trainer.gradient_clip_val)
        optimizer.step()
        scheduler.step()
        yield loss.item()
