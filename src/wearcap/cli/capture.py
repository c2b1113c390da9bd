"""`wearcap capture`: a recording goes in; motion files and a video come out."""

import json
from pathlib import Path

from omegaconf import DictConfig
from rich import print as show
from rich.console import Console
from rich.markup import escape

from wearcap.body.anny_body import anny_body
from wearcap.cli.conf import hydra_main
from wearcap.cli.load import load_pipeline, staged
from wearcap.errors import WearcapError
from wearcap.files import write_text
from wearcap.io.bvh import write_bvh
from wearcap.io.gltf import write_glb
from wearcap.io.motion_npz import write_motion
from wearcap.pipelines.hmd2 import HMD2
from wearcap.recording import Motion, Recording
from wearcap.recording.locate import load_recording
from wearcap.viewer.video import write_video

HELP = "turn a recording into motion: wearcap capture recording=DATASET/NAME, checkpoint=… or pipeline=hps"


def run(config: DictConfig) -> Motion | None:
    """Capture one recording and write motion.npz, .bvh, .glb and .mp4 (truth, where known, beside it).

    A pipeline of stages writes report.json, too; `until` a stage before there is a motion, that alone.
    """
    recording = load_recording(config.recording)
    pipeline = load_pipeline(config.checkpoint, config.pipeline, config.device)
    folder = Path(config.output)
    if isinstance(pipeline, HMD2):
        if config.until is not None or config.cache is not None:
            raise WearcapError(f"until={config.until} cache={config.cache}", expected="a pipeline with stages, such as pipeline=hps")  # fmt: skip
        motion = pipeline(recording, seed=config.seed)
        motion.provenance.update(checkpoint=str(config.checkpoint))
    else:
        console = Console(stderr=True)
        capture = staged(pipeline, config, config.recording, lambda line: console.print(escape(line)))
        captured = capture.run(recording, config.until)
        write_text(folder / "report.json", json.dumps(captured.report, indent=1) + "\n")
        motion = captured.motion
    if motion is not None:
        motion.provenance.update(recording=str(config.recording))
        _write(motion, recording, folder, config)
    show(f"{'motion' if motion is not None else 'report'}: {folder}")
    return motion


def _write(motion: Motion, recording: Recording, folder: Path, config: DictConfig) -> None:
    write_motion(motion, folder / "motion.npz")
    write_bvh(motion, folder / "motion.bvh")
    body = anny_body(motion.skeleton, recording.shape or None) if config.body else None
    write_glb(motion, folder / "motion.glb", body=body)
    if config.video:
        shown = {"truth": recording.motion} if recording.motion is not None else {}
        write_video(folder / "motion.mp4", shown | {"capture": motion}, max_seconds=config.video_seconds)


def main(arguments: list[str]) -> None:
    hydra_main("capture", run, arguments)
