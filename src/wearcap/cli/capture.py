"""`wearcap capture`: a recording goes in; motion files and a video come out."""

from pathlib import Path

from omegaconf import DictConfig
from rich import print as show

from wearcap.body.anny_body import anny_body
from wearcap.cli.conf import hydra_main
from wearcap.cli.load import load_pipeline
from wearcap.io.bvh import write_bvh
from wearcap.io.gltf import write_glb
from wearcap.io.motion_npz import write_motion
from wearcap.recording import Motion
from wearcap.recording.locate import load_recording
from wearcap.viewer.video import write_video

HELP = "turn a recording into motion: wearcap capture checkpoint=… recording=DATASET/NAME"


def run(config: DictConfig) -> Motion:
    """Capture one recording and write motion.npz, .bvh, .glb and .mp4 (truth, where known, beside it)."""
    recording = load_recording(config.recording)
    pipeline = load_pipeline(config.checkpoint, config.pipeline, config.device)
    motion = pipeline(recording, seed=config.seed)
    motion.provenance.update(checkpoint=str(config.checkpoint), recording=str(config.recording))
    folder = Path(config.output)
    write_motion(motion, folder / "motion.npz")
    write_bvh(motion, folder / "motion.bvh")
    body = anny_body(motion.skeleton, recording.shape or None) if config.body else None
    write_glb(motion, folder / "motion.glb", body=body)
    if config.video:
        shown = {"truth": recording.motion} if recording.motion is not None else {}
        write_video(folder / "motion.mp4", shown | {"capture": motion}, max_seconds=config.video_seconds)
    show(f"motion: {folder}")
    return motion


def main(arguments: list[str]) -> None:
    hydra_main("capture", run, arguments)
