"""The best checkpoint by the error of captured recordings."""

import csv
from pathlib import Path

import torch

from wearcap.cli import train
from wearcap_testing import small_dataset

SMALL = [f"model.net.transformer.{name}" for name in ("width=32", "layers=1", "heads=4", "feedforward=32")]


def rows_of(tmp_path: Path, *more: str) -> list[dict[str, str]]:
    """The log of a small training."""
    small_dataset(tmp_path / "data")
    given = [
        "experiment=motion_diffusion_head",
        "callbacks=captured",
        "callbacks.progress=null",
        f"data.sources.simulated.root={tmp_path / 'data'}",
        f"paths.run={tmp_path / 'run'}",
        "data.dataset.window=60",
        "data.loading={batch_size: 4, steps_per_epoch: 2, val_windows: 8}",
        "trainer={max_steps: 8, accelerator: cpu, precision: 32-true, enable_progress_bar: false}",
        *SMALL,
        *more,
    ]
    train.main(given)
    with open(tmp_path / "run" / "metrics.csv", newline="") as file:
        return list(csv.DictReader(file))


def test_the_best_checkpoint_is_that_of_the_least_captured_error(tmp_path):
    rows = [row for row in rows_of(tmp_path, "early_stop=3") if row.get("capture/mpjpe_cm")]
    errors = {int(row["step"]) + 1: float(row["capture/mpjpe_cm"]) for row in rows}
    assert list(errors) == [2, 4, 6, 8], "every epoch captures"
    best = torch.load(tmp_path / "run" / "checkpoints" / "best.ckpt", weights_only=True)
    assert best["global_step"] == min(errors, key=lambda step: errors[step])


def test_a_training_that_has_time_left_ends_early_where_nothing_gets_better(tmp_path):
    still = [
        "optimizer.optimizer.lr=0.0",
        "optimizer.scheduler=null",
        "callbacks.capture=null",
        "callbacks.checkpoint.monitor=val/loss",
    ]
    rows = rows_of(tmp_path, *still, "trainer.max_steps=-1", "trainer.max_time=00:01:00:00", "early_stop=2")
    losses = [float(row["val/loss"]) for row in rows if row.get("val/loss")]
    assert len(losses) == 3, "the first is the best, then two epochs of patience"
    assert losses == [losses[0]] * 3
