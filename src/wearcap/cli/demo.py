"""`wearcap demo`: the complete workflow on simulated data, from preparation to a captured motion, in minutes."""

import re
import time
from collections.abc import Callable
from pathlib import Path
from textwrap import wrap

from wearcap.cli.verbs import VERBS, Arguments

SHARED = "hmd2"
"""Shared checkpoint that is shown beside the one that is trained."""


def main(arguments: list[str]) -> None:
    parser = Arguments("wearcap demo", description=VERBS["demo"])
    parser.add_argument("--output", type=Path, default=Path("outputs/demo"), help="folder for everything")
    parser.add_argument("--steps", type=int, default=400, help="training steps")
    options = parser.parse_args(arguments)

    from wearcap.apps.viewer.picture import contact_sheet, save_png, shared_frames
    from wearcap.body.anny_body import anny_body
    from wearcap.cli import capture, evaluate, export, prepare, train
    from wearcap.io.formats.motion_npz import read_motion
    from wearcap.recording import RecordingStore

    out, data, trained = options.output, options.output / "data", options.output / "train/checkpoints/last.ckpt"
    started = time.monotonic()
    _step("Simulated wearers", prepare.main, ["simulated", "preset=quick", f"output={data}"])
    training = [
        "experiment=motion_diffusion_head",
        f"data.sources.simulated.root={data}",
        f"data.loading.steps_per_epoch={max(1, options.steps // 2)}",
        f"trainer.max_steps={options.steps}",
        f"hydra.run.dir={out}/train",
        "callbacks.capture=null",
        "callbacks.average.decay=0.98",
        "data.loading.batch_size=16",
    ]
    _step("Training, shortly", train.main, training)
    store = RecordingStore.open(data)
    name = next(name for name in store.names("test") if re.fullmatch(r"[\w-]+", name))  # a value of the config
    motions = {}
    for label, checkpoint, video in (
        (f"checkpoint {SHARED}", SHARED, "10"),
        (f"{options.steps} steps", trained, "false"),
    ):
        folder = out / label.replace(" ", "_")
        taken = [f"checkpoint={checkpoint}", f"recording={data}/{name}", f"hydra.run.dir={folder}", f"video={video}"]
        _step(f"Capture, {label}", capture.main, taken)
        motions[label] = read_motion(folder / "motion.npz")
    table = [f"checkpoint={SHARED}", f"dataset={data}", f"hydra.run.dir={out}/evaluate", "seeds=[0]", "baselines=false"]
    _step(f"Evaluation: checkpoint {SHARED}", evaluate.main, [*table, f"output={out}/table.json"])
    exported = [f"checkpoint={trained}", f"hydra.run.dir={out}/export", f"output={out}/denoiser.onnx"]
    _step("Export", export.main, exported)
    truth, shared = store.load(name), out / f"checkpoint_{SHARED}"
    assert truth.motion is not None
    shown, body = {"truth": truth.motion} | motions, anny_body(truth.motion.skeleton, truth.shape or None)
    frames = shared_frames(shown, 6)
    save_png(out / "demo.png", contact_sheet(shown, frames, size=(280, 320), body=body, distance=3.9))
    print(
        f"\nDone in {(time.monotonic() - started) / 60:.1f} minutes. Look first at\n"
        f"  {out / 'demo.png'}\n      the truth, the checkpoint {SHARED}, and {options.steps} steps of training\n"
        f"  {shared / 'motion.mp4'}\n      ten seconds of it, moving; motion.glb beside it opens in Blender\n"
        f"  {out / 'table.json'}\n      how far joints are from the truth, in cm\n"
        f"or in the browser:\n  {_wrapped(f'wearcap view {data}/{name} --motion {shared}/motion.npz')}"
    )


def _step(title: str, verb: Callable[[list[str]], None], arguments: list[str]) -> None:
    command = " ".join(["wearcap", verb.__module__.rpartition(".")[2], *arguments])
    print(f"\n{title}\n  {_wrapped(command)}", flush=True)
    verb(arguments)


def _wrapped(command: str) -> str:
    """A command in lines of at most 80 columns, as a shell takes them."""
    return " \\\n      ".join(wrap(command, 72, break_long_words=False, break_on_hyphens=False))
