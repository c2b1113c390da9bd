"""`wearcap demo`: the complete workflow on simulated data, from preparation to a captured motion, in minutes."""

import argparse
import re
import time
from collections.abc import Callable
from pathlib import Path

from rich import print as show
from rich.markup import escape

from wearcap.body.anny_body import anny_body
from wearcap.cli import capture, evaluate, export, prepare, train
from wearcap.io.formats.motion_npz import read_motion
from wearcap.recording import Motion, Recording, RecordingStore
from wearcap.viewer.picture import contact_sheet, save_png, shared_frames

SHARED = "hmd2"
"""Shared checkpoint that is shown beside the one that is trained."""
HELP = "prepare simulated data, train, evaluate, capture and export in minutes"


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser("wearcap demo", description=HELP)
    parser.add_argument("--output", type=Path, default=Path("outputs/demo"), help="folder for everything")
    parser.add_argument("--steps", type=int, default=240, help="training steps")
    options = parser.parse_args(arguments)
    out, data, checkpoint = (options.output, options.output / "data", options.output / "train/checkpoints/last.ckpt")
    started = time.monotonic()
    _step("Simulated wearers", prepare.main, ["simulated", "preset=quick", f"output={data}"])
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
    trained, store = f"checkpoint={checkpoint}", RecordingStore.open(data)
    table = [trained, f"hydra.run.dir={out}/evaluate", "seeds=[0]", f"output={out}/table.json"]
    _step("Evaluation", evaluate.main, table)
    table = [f"checkpoint={SHARED}", f"dataset={data}", f"hydra.run.dir={out}/evaluate_shared", "seeds=[0]"]
    table += ["baselines=false", f"output={out}/table_shared.json"]
    _step("The shared checkpoint, which was trained for longer", evaluate.main, table)
    name = next(name for name in store.names("test") if re.fullmatch(r"[\w-]+", name))  # a value of the config
    for title, taken, folder in (
        ("Capture", trained, "capture"),
        ("The same, shared", f"checkpoint={SHARED}", "shared"),
    ):
        motion = [taken, f"recording={data}/{name}", f"hydra.run.dir={out}/{folder}", "video_seconds=10"]
        _step(title, capture.main, motion)
    _step("Export", export.main, [trained, f"hydra.run.dir={out}/export", f"output={out}/denoiser.onnx"])
    motions = {f"{options.steps} steps": out / "capture/motion.npz", "shared checkpoint": out / "shared/motion.npz"}
    _picture(out / "demo.png", store.load(name), {label: read_motion(path) for label, path in motions.items()})
    show(
        f"\n[bold]Done in {(time.monotonic() - started) / 60:.1f} minutes.[/bold]\n"
        f"picture  {out / 'demo.png'}: the truth, these {options.steps} steps, the shared checkpoint\n"
        f"table    {out / 'table.json'}, {out / 'table_shared.json'}\nvideo    {out / 'shared/motion.mp4'}, {out / 'capture/motion.mp4'}\n"
        f"motion   {out / 'shared/motion.glb'} (and .bvh, .npz, SMPL)\nmodel    {out / 'denoiser.onnx'}\n"
        f"watch    wearcap view {data}/{name} --motion {out / 'capture/motion.npz'} {out / 'shared/motion.npz'}"
    )


def _picture(path: Path, recording: Recording, captures: dict[str, Motion]) -> None:
    """The recording's true motion above the captures, as people."""
    assert recording.motion is not None
    motions = {"truth": recording.motion} | captures
    body = anny_body(recording.motion.skeleton, recording.shape or None)
    save_png(path, contact_sheet(motions, shared_frames(motions, 6), size=(240, 260), body=body))


def _step(title: str, verb: Callable[[list[str]], None], arguments: list[str]) -> None:
    show(f"\n[bold]{title}[/bold]: wearcap {verb.__module__.rpartition('.')[2]} {escape(' '.join(arguments))}")
    verb(arguments)
