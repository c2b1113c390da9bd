"""`wearcap capture`: a recording goes in; motion files and a video come out."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from omegaconf import DictConfig
from rich import print as show
from rich.console import Console
from rich.markup import escape
from rich.progress import track
from torch import Tensor

from wearcap.apps.live.capture import LiveCapture
from wearcap.apps.live.pieces_source import PiecesSource
from wearcap.apps.live.sink import Sink
from wearcap.apps.viewer.picture import contact_sheet, save_png, write_video
from wearcap.apps.viewer.shown import with_objects
from wearcap.body.anny_body import anny_body
from wearcap.body.model import BodyModel
from wearcap.body.skeleton import xsens23
from wearcap.body.smpl_body import betas_of, smpl_body, template_pelvis
from wearcap.checks import require_sound
from wearcap.checks.consistency import SCAN_FILE
from wearcap.cli.capture_all import capture_all, is_dataset
from wearcap.cli.conf import (
    hydra_application,
    load_pipeline,
    run_application,
    sampling,
    with_pipeline,
    with_pipeline_of_content,
)
from wearcap.cli.stated import stated
from wearcap.errors import WearcapError
from wearcap.files import write_text
from wearcap.io.formats.amass import write_amass
from wearcap.io.formats.bvh import write_bvh
from wearcap.io.formats.gltf import write_glb
from wearcap.io.formats.motion_npz import write_motion
from wearcap.io.formats.scene_folder import cloud_file
from wearcap.io.formats.smpl import read_smpl
from wearcap.io.saving import FORMATS, USD, on_skeleton, require_formats, save, usd_writer, write_smplh
from wearcap.metrics.gait import crouches
from wearcap.metrics.strides import gait_report
from wearcap.prepare.rigs import read_rig, write_on_rig
from wearcap.reading import load, read
from wearcap.recording import Motion, Recording
from wearcap.recording.store import MANIFEST, dataset_folder
from wearcap.runtime.system import CaptureInput, LearnedSystem, StageOptions, System
from wearcap.runtime.walked_stature import with_walked_stature
from wearcap.scene.objects import Environment
from wearcap.tracking.fingers import with_fingers
from wearcap.tracking.stature import skeleton_of, with_stature


def run(config: DictConfig) -> Motion | None:
    """Capture one recording, or all of a data set, or follow one that still grows (`live`)."""
    if is_dataset(config):
        return capture_all(config, captured)
    system = load_pipeline(config.checkpoint, config.pipeline, config.device, shared=True)
    if config.live:
        return _live(system, config, Path(config.output))
    motion = captured(config, system)
    show(f"{'motion' if motion is not None else 'report'}: {config.output}")
    return motion


def captured(config: Any, system: System) -> Motion | None:
    """Capture one recording and write motion.npz, the `formats`, and motion.mp4 (beside the ground truth, if there is one).

    A pipeline with stages also writes report.json, and only that if `until` names a stage before the motion exists.
    """
    folder = Path(config.output)
    if config.samples < 1:
        raise WearcapError(f"samples={config.samples}", expected="at least 1")
    filmed_s = _filmed_s(config.video)
    require_formats(config.formats)
    rig = None if config.to_rig is None else read_rig(config.to_rig)
    source = _input(config, system)
    recording = source.recording
    seeds = range(config.seed, config.seed + config.samples)
    drawing = sampling(system) if len(seeds) > 1 else None
    cache = None if config.cache is None else Path(config.cache)
    options = StageOptions(cache, config.until, Console(stderr=True))
    (capture,) = system.capture([source], [config.seed], options)
    motion, report = capture.motion, capture.report
    if report is not None:
        write_text(folder / "report.json", json.dumps(report, indent=1) + "\n")
    if motion is not None:
        if config.checkpoint is not None:
            motion.provenance.update(checkpoint=str(config.checkpoint))
        motion.provenance.update(recording=str(config.recording))
        if recording.origin is not None:
            motion.provenance.update(origin=" ".join(map(str, recording.origin.tolist())))
        environment = None if motion.object_motion is None else system.objects(source)
        whole = with_fingers(motion, recording.fingers)  # of every system's motion, as far as the recording has hands
        _write(whole, source, environment, folder, config)
        if rig is not None:
            write_on_rig(motion, rig, folder / f"motion_{rig.name}{rig.suffix}", config.keep_hands)
        if (knee_deg := crouches(motion)) is not None:
            show(
                f"knees: bent by {knee_deg:.0f}° where they bear weight while walking: is the height right? (height=…)"
            )
        (folder / "gait.json").unlink(missing_ok=True)  # of an earlier capture into this folder
        if (gait := gait_report(motion)) is not None:
            write_text(folder / "gait.json", json.dumps(gait, indent=1) + "\n")
            show(f"gait: {gait['strides']} strides, gait.json")
        truth = with_objects(recording, environment)
        shown = {} if truth is None else {"truth": truth}
        if drawing is not None:  # sample-0.npz, …, and samples.png: the variety from one input (thesis Fig. 6.6)
            draws = {}
            for number, seed in enumerate(track(seeds, description="samples")):
                draws[f"sample {number}"] = draw = drawing(source, seed)
                write_motion(with_fingers(draw, recording.fingers), folder / f"sample-{number}.npz")
            body, rows = anny_body(motion.skeleton, recording.shape or None), shown | {"mean": motion} | draws
            save_png(folder / "samples.png", contact_sheet(rows, body=body, environment=environment))
        if filmed_s:
            drawn = whole if truth is None else motion  # one surface fits both
            body = anny_body(drawn.skeleton, recording.shape or None) if config.body else None
            shown |= {"capture": drawn}
            write_video(folder / "motion.mp4", shown, body=body, environment=environment, max_seconds=filmed_s)
    return motion


def _input(config: Any, system: System) -> CaptureInput:
    """The recording with its files and the wearer's height, with a line on each of both."""
    body = None if config.skeleton is None else skeleton_of(read(config.skeleton))
    how = stated(config if isinstance(config, DictConfig) else vars(config))
    loaded = load(config.recording, how)
    if config.check:  # a scene that is given stands in for the recording's own
        require_sound(
            loaded.recording, [found for found in loaded.findings if not (config.scene and found.check == SCAN_FILE)]
        )
    recording, stature = with_stature(loaded.recording, xsens23(), config.height, body)
    dataset = dataset_folder(config.recording)
    if recording.note and not (dataset / MANIFEST).is_file():
        show(f"read: {escape(recording.note)}")
    if stature.source != "skeleton":
        show(f"height: {stature}" if stature.known else f"{stature}: give height=… (m)")
    source = CaptureInput.in_dataset(recording, dataset, config.scene, config.metres_per_unit)
    if not isinstance(system, LearnedSystem):
        return source
    source, walked = with_walked_stature(system, source, stature, xsens23())
    if walked != stature:
        show(f"height: {walked}")
    return source


def _write(motion: Motion, source: CaptureInput, environment: Environment | None, folder: Path, config: Any) -> None:
    recording = source.recording
    write_motion(motion, folder / "motion.npz")
    shown, body = motion, anny_body(motion.skeleton, recording.shape or None) if config.body is True else None
    if isinstance(config.body, str):
        shown, body, betas, pelvis = _on_smpl(motion, recording, config.body)
        if config.smpl:
            write_amass(shown, folder / "motion_smplh.npz", betas, pelvis)
    elif config.smpl:
        write_smplh(motion, folder / "motion_smplh.npz")
    for name in config.formats:
        path = folder / f"motion{FORMATS[name]}"
        if path.suffix in USD:
            usd_writer()(shown, path, body, environment, source.read_surface())
        elif name == "glb":
            write_glb(shown, path, body=body)
        elif name == "bvh":
            write_bvh(motion, path, origin=recording.origin if config.map_coordinates else None)
        else:
            save(motion, path)


def _filmed_s(video: Any) -> float:
    """Longest duration (s) of the video, 0 for none. Raises WearcapError for what `video=` does not take."""
    if isinstance(video, bool) or video is None:
        return math.inf if video else 0.0
    if isinstance(video, int | float) and 0 <= video < math.inf:
        return float(video)
    if video != "auto":
        raise WearcapError(f"video={video}", expected="auto (the first minute), true, false, or seconds: video=10")
    return 60.0


def _on_smpl(
    motion: Motion, recording: Recording, file: str
) -> tuple[Motion, BodyModel, Float[Tensor, "beta"], list[float]]:
    """The motion on the body of the user's SMPL model file, with the recording's shape coefficients or those that the
    wearer's bones tell; the body, these, and the template's pelvis."""
    arrays = read_smpl(file)
    known = [value for name, value in recording.shape.items() if name.startswith("beta_")]
    betas = torch.tensor(known[: arrays.shape_directions.shape[-1]]) if known else betas_of(arrays, motion.skeleton)
    body = smpl_body(arrays, betas)
    return on_skeleton(motion, body.skeleton), body, betas, template_pelvis(arrays, betas).tolist()


class _Shown(Sink):
    """Shows up to when a growing recording is captured."""

    name = "progress"

    def take(self, wearer: str, motion: Motion) -> None:
        show(f"{motion.timestamps[-1].item():9.2f} s", flush=True)


def _live(system: System, config: DictConfig, folder: Path) -> None:
    """Follow a growing recording: the motion's files grow with it."""
    if config.to_rig is not None:
        fix = (
            f"Afterwards: wearcap capture recording={folder}/wearer/motion.npz pipeline=recorded to_rig={config.to_rig}"
        )
        raise WearcapError("to_rig=… while a recording grows", expected="a whole recording", fix=fix)
    growing = Path(config.recording)
    if not growing.is_dir():
        raise WearcapError("no such folder", where=growing, expected="a growing recording: piece-000000.safetensors, …")
    pieces = PiecesSource(growing, system)
    scan = None if config.scene is None else cloud_file(config.scene)
    place = CaptureInput(pieces.first, growing, scan, config.metres_per_unit)
    report = LiveCapture(system, [pieces], [_Shown()], source=place, record=folder).run()
    (about,) = report["wearers"].values()
    for reason, count in (report["refused"] | about["refused"]).items():
        show(f"refused {count} × {reason}")
    if not about["frames"]:
        raise WearcapError(f"no motion: {' '.join(about['notes'])}", growing)
    show(f"motion: {folder}")


def main(arguments: list[str], application: Callable[[], Any] | None = None) -> None:
    arguments = ["live=true" if argument == "--live" else argument for argument in arguments]
    run_application(
        "capture", application or hydra_application("capture", run), with_pipeline_of_content(with_pipeline(arguments))
    )
