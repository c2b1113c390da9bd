"""`wearcap demo`: the complete workflow on simulated data, from preparation to a captured motion, in minutes."""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

from rich import print as show

from wearcap.cli import capture, evaluate, export, prepare, train
from wearcap.recording import RecordingStore

HELP = "prepare simulated data, train, evaluate, capture and export in minutes"


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser("wearcap demo", description=HELP)
    parser.add_argument("--output", type=Path, default=Path("outputs/demo"), help="folder for everything")
    parser.add_argument("--steps", type=int, default=240, help="training steps")
    options = parser.parse_args(arguments)
    out, data, checkpoint = (options.output, options.output / "data", options.output / "train/checkpoints/last.ckpt")
    started = time.monotonic()
    _step("Simulated wearers", prepare.main, ["simulated", "preset=demo", f"output={data}"])
    training = [
        "experiment=motion_diffusion_head",
        f"data.sources.simulated.root={data}",
        f"data.loading.steps_per_epoch={max(1, options.steps // 2)}",
        f"trainer.max_steps={options.steps}",
        f"hydra.run.dir={out}/train",
        "callbacks.capture.every_n_epochs=100",
        "callbacks.average.decay=0.98",
        "data.loading.batch_size=16",
    ]
    _step("Training", train.main, training)
    trained = f"checkpoint={checkpoint}"
    table = [trained, f"hydra.run.dir={out}/evaluate", "seeds=[0]", f"output={out}/table.json"]
    _step("Evaluation", evaluate.main, table)
    name = RecordingStore.open(data).names("test")[0]
    motion = [trained, f"recording={data}/{name}", f"hydra.run.dir={out}/capture", "video_seconds=10"]
    _step("Capture", capture.main, motion)
    _step("Export", export.main, [trained, f"hydra.run.dir={out}/export", f"output={out}/denoiser.onnx"])
    show(
        f"\n[bold]Done in {(time.monotonic() - started) / 60:.1f} minutes.[/bold]\n"
        f"table    {out / 'table.json'}\nvideo    {out / 'capture/motion.mp4'}\n"
        f"motion   {out / 'capture/motion.glb'} (and .bvh, .npz)\nmodel    {out / 'denoiser.onnx'}\n"
        f"watch    wearcap view {data}/{name} --motion {out / 'capture/motion.npz'}"
    )


def _step(title: str, verb: Callable[[list[str]], None], arguments: list[str]) -> None:
    show(f"\n[bold]{title}[/bold]: wearcap {verb.__module__.rpartition('.')[2]} {' '.join(arguments)}")
    verb(arguments)
