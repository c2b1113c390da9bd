"""What every system gives on a few short simulated recordings, compared with what it gave before.

    python benchmarks/goldens.py [CASE ...]          compare with benchmarks/goldens.json; leaves with 1 where they differ
    python benchmarks/goldens.py --write [CASE ...]  write the goldens anew
    python benchmarks/goldens.py --list              the cases

A case prepares data, trains a few steps, captures, streams, evaluates or exports. Of each array that comes out the file
holds a SHA-256 and 16 values spread over it, so that another CPU, which sums in another order, can be distinguished from
another result: a case is "equal" where all hashes are, else "close" within `--tolerance`, else it differs.
"""

import argparse
import hashlib
import json
import os
import shutil
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.rivals import SEARCH, compose
from benchmarks.rivals.hps_suit import KINDS as SUIT_ROWS
from wearcap.cli import capture, evaluate, export, prepare, train
from wearcap.cli.conf import load_pipeline
from wearcap.io.formats.motion_npz import read_motion
from wearcap.recording import Motion, Recording
from wearcap.recording.active_objects import true_spans
from wearcap.recording.serialize import flatten
from wearcap.recording.store import dataset_folder, load_recording
from wearcap.recording.timing import joined
from wearcap.runtime.system import CaptureInput
from wearcap.runtime.wearer import Wearer
from wearcap.systems.echo.stream import EchoStream
from wearcap.systems.hmd2.stream import HeadSample, HMD2Session
from wearcap.systems.hps.stream import HpsSession
from wearcap.systems.mocap_every.stream import MocapEveryStream, WatchSample
from wearcap.training.loggers import read_metrics

FOLDER = Path(__file__).resolve().parent
GOLDENS = FOLDER / "goldens.json"
VALUES = 16
Arrays = dict[str, np.ndarray]

DATA = {
    "walkers": ("simulated", "recordings={train: 2, val: 1, test: 1}", "duration_s=10", "camera=true"),
    "hps": (
        "simulated_hps",
        "recordings={test: 1}",
        "spacing_m=0.05",
        "photo_m=0",
        "video_s=0",
        "returns_m=[8,16]",
        "end_m=24",
    ),
    "flats": ("simulated_interactions", "recordings={train: 1, val: 1, test: 1}", "minutes=0.5", "spacing_m=0.05"),
    "objects": ("simulated_objects", "recordings={train: 1, val: 1, test: 1}", "minutes=0.3"),
    "embedded": ("embeddings", "dataset=data/walkers", "encoder=egoview"),
    "keyed": ("keypoints", "dataset=data/walkers", "detector=simulated"),
}
"""Data sets by name: what `wearcap prepare` is given."""

SHARED = ("pipeline.synchronization.clock=shared",)
"""The session's camera has no sound to hear claps in: its clock is used as it is, though it is early."""
HMD2, WATCHES, ECHO = ("hmd2", "walkers"), ("mocap_every", "keyed"), ("echo", "objects")
CAPTURES: dict[str, tuple[str | None, str, tuple[str, ...]]] = {
    "hmd2": (*HMD2, ()),
    "hmd2_paper": (*HMD2, ()),
    "hmd2_sampled": (*HMD2, ()),
    "hmd2_online": (*HMD2, ()),
    "egoego_style": (*HMD2, ("pipeline.sampling.steps=4",)),
    "mocap_every": (*WATCHES, ()),
    "mocap_every_paper": (*WATCHES, ()),
    "mocap_every_cues": (*WATCHES, ()),
    "mocap_every_online": (*WATCHES, ()),
    "echo": (*ECHO, ()),
    "echo_paper": (*ECHO, ()),
    "echo_online": (*ECHO, ("pipeline.runtime=eager",)),
    "echo_conveyor": (*ECHO, ("pipeline.sampling.per_frame=1",)),
    "echo_rewindow": (*ECHO, ("pipeline.sampling.per_frame=1",)),
    "echo_search": (*ECHO, ()),
    "bodiffusion_object": (*ECHO, ()),
    "hps": (None, "hps", SHARED),
    "hps_paper": (None, "hps", (*SHARED, "pipeline.solver.settings.steps=4")),
    "hps_released": (None, "hps", SHARED),
    "hps_without_scene": (None, "hps", SHARED),
    **{f"hps_{kind}": (None, "hps", (*SHARED, f"pipeline.kind={kind}")) for kind in SUIT_ROWS},
    "bent_suit": (None, "hps", SHARED),
    "ireplica": ("contact_sequence", "flats", ()),
    "ireplica_without_correction": (
        "contact_sequence",
        "flats",
        ("pipeline.tracker.correction=null", "pipeline.tracker.hands=null"),
    ),
    "ireplica_paper": ("[contact_transformer_sliding,contact_transformer_hinged]", "flats", ()),
    "pose_regressor": ("runs/pose_regressor_hands/checkpoints/last.ckpt", "walkers", ()),
}
"""Captures with their checkpoint, data set, and overrides that keep them short."""
PIPELINES = {
    "hmd2_paper": "paper/hmd2",
    "hmd2_sampled": "ablation/hmd2_sampled",
    "egoego_style": "baseline/egoego_style",
    "mocap_every_paper": "paper/mocap_every",
    "echo_paper": "paper/echo",
    "echo_conveyor": "ablation/echo_conveyor",
    "echo_rewindow": "ablation/echo_rewindow",
    "bodiffusion_object": "baseline/bodiffusion_object",
    "hps_paper": "paper/hps",
    "hps_released": "paper/hps_released",
    "hps_without_scene": "paper/hps_without_scene",
    **{f"hps_{kind}": "baseline/hps_suit" for kind in SUIT_ROWS},
    "bent_suit": "paper/bent_suit",
    "ireplica_without_correction": "ireplica",
    "ireplica_paper": "paper/ireplica",
}
"""Pipeline configs of the captures that are not named after theirs."""

QUIET = "callbacks.capture=null"
TWO = "data.sources.cmu=null"
THREE = "people@data.sources=none"
VAL = "data.val_sources.cmu.root=data/walkers"
ONE = "data.sources.simulated.root=data/walkers"
TRAININGS: dict[str, tuple[str, ...]] = {
    "motion_diffusion_head": (QUIET, ONE, "data.dataset.window=120"),
    "hmd2": (QUIET, ONE, TWO, THREE, "data.dataset.window=120"),
    "mocap_every": (ONE, TWO, THREE, VAL),
    "echo": ("data.sources.objects.root=data/objects", TWO, THREE, "data.val_sources.objects.root=data/objects"),
    "contact_sequence": ("data.sources.simulated.root=data/flats", "callbacks.tracking=null"),
    "contact_transformer_sliding": ("data.sources.simulated.root=data/flats", "callbacks.tracking=null"),
    "pose_regressor_hands": (ONE, "data.dataset.window=120"),
    "motion_manifold": (ONE, TWO, THREE, VAL),
    "motion_autoencoder": (ONE, TWO),
    "voxel_autoencoder": (ONE, TWO, "data.dataset.window=8"),
    "object_encoder": ("data.dataset.per_class={train: 2, val: 1}", "data.dataset.root=data/clouds"),
    "egoview": (ONE, TWO),
}
"""Experiments with what they are trained on, for three steps."""

EVALUATIONS = {
    "hmd2": ("checkpoint=hmd2", "dataset=data/walkers", "seeds=[0,1]"),
    "mocap_every": ("checkpoint=mocap_every", "pipeline=mocap_every", "dataset=data/keyed", "seeds=[0]"),
    "echo": ("checkpoint=echo", "pipeline=echo", "dataset=data/objects", "seeds=[0]"),
    "hps": ("pipeline=hps", "dataset=data/hps", "seeds=[0]", *SHARED),
    "ireplica": ("pipeline=ireplica", "checkpoint=contact_sequence", "dataset=data/flats", "seeds=[0]"),
    "pose_regressor": (
        "checkpoint=runs/pose_regressor_hands/checkpoints/last.ckpt",
        "pipeline=pose_regressor",
        "seeds=[0]",
    ),
}
EXPORTS = {"hmd2": "hmd2", "mocap_every": "mocap_every", "echo": "echo", "contact_sequence": "ireplica"}
"""Checkpoints with the pipeline that they are exported for."""


def recording_of(dataset: str) -> str:
    """DATASET/NAME of the recording for testing."""
    manifest = json.loads(Path("data", dataset, "manifest.json").read_text(encoding="utf-8"))
    entries = manifest["recordings"]
    rows = entries.items() if isinstance(entries, dict) else ((row["name"], row) for row in entries)
    return f"data/{dataset}/{next(name for name, row in rows if row['split'] == 'test')}"


def prepared(name: str) -> Arrays:
    """A data set that is made anew; its recordings' tensors."""
    kind, *settings = DATA[name]
    if name != "embedded":  # which rewrites the walkers
        shutil.rmtree(Path("data", name), ignore_errors=True)
        settings = [f"output=data/{name}", *settings]
    prepare.main([kind, "jobs=1", *settings])
    folder = Path("data", "walkers" if name == "embedded" else name)
    return {
        f"{path.stem}/{key}": value.numpy()
        for path in sorted(folder.glob("recordings/*.safetensors"))
        for key, value in load_file(path).items()
    }


def arrays_of(motion: Motion) -> Arrays:
    return {key: tensor.numpy() for key, tensor in sorted(flatten(motion)[1].items())}


def captured(name: str) -> Arrays:
    checkpoint, dataset, settings = CAPTURES[name]
    given = [] if checkpoint is None else [f"checkpoint={checkpoint}"]
    output = Path("captures", name)
    capture.main(
        [
            SEARCH,
            f"pipeline={PIPELINES.get(name, name)}",
            f"recording={recording_of(dataset)}",
            f"output={output}",
            "video=false",
            "body=false",
            f"hydra.run.dir={output}",
            *given,
            *settings,
        ]
    )
    return arrays_of(read_motion(output / "motion.npz"))


def trained(name: str) -> Arrays:
    output = Path("runs", name)
    shutil.rmtree(output, ignore_errors=True)
    train.main(
        [
            SEARCH,
            f"experiment={name}",
            f"hydra.run.dir={output}",
            "trainer.max_steps=3",
            "trainer.precision=32-true",
            "data.loading.steps_per_epoch=3",
            "data.loading.batch_size=4",
            "trainer.log_every_n_steps=1",
            *TRAININGS[name],
        ]
    )
    rows = read_metrics(output / "metrics.csv")
    return {
        key: np.array([float(row[key]) for row in rows if row.get(key)])
        for key in sorted({k for row in rows for k in row})
        if "loss" in key
    }


def evaluated(name: str) -> Arrays:
    output = Path("tables", f"{name}.json")
    evaluate.main(
        [
            SEARCH,
            "baselines=" + str(name == "pose_regressor").lower(),
            f"output={output}",
            "hydra.run.dir=tables",
            *EVALUATIONS[name],
        ]
    )
    return {"/".join(place): np.array(value) for place, value in _numbers(json.loads(output.read_text()))}


def _numbers(tree: Any, *place: str) -> Iterator[tuple[tuple[str, ...], float]]:
    if isinstance(tree, dict | list):
        for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree):
            yield from _numbers(value, *place, str(key))
    elif isinstance(tree, int | float):
        yield place, float(tree)


def exported(name: str) -> Arrays:
    """Outputs of the exported networks for drawn inputs."""
    import onnxruntime

    output = Path("exports", name, "network.onnx")
    export.main(
        [f"checkpoint={name}", f"pipeline={EXPORTS[name]}", f"output={output}", f"hydra.run.dir={output.parent}"]
    )
    found, random = {}, np.random.default_rng(0)
    for path in sorted(output.parent.glob("*.onnx")):
        session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
        sizes: dict[str, int] = {}
        inputs = {}
        for item in sorted(session.get_inputs(), key=lambda item: item.name):
            shape = [size if isinstance(size, int) else sizes.setdefault(size, 2) for size in item.shape]
            drawn = random.random(shape, np.float32)
            inputs[item.name] = {"tensor(bool)": drawn > 0.3, "tensor(int64)": (3 * drawn).astype(np.int64)}.get(
                item.type, drawn
            )
        for item, value in zip(session.get_outputs(), session.run(None, inputs)):
            found[f"{path.stem}/{item.name}"] = np.asarray(value)
    return found


def _pipeline(name: str, dataset: str, *settings: str) -> tuple[Any, Recording, str]:
    config = compose("capture", [f"pipeline={PIPELINES.get(name, name)}", "recording=none", *settings]).pipeline
    place = recording_of(dataset)
    checkpoint = CAPTURES[name][0]
    return load_pipeline(checkpoint, config, "cpu"), load_recording(place), place


def hmd2_streamed() -> Motion | None:
    pipeline, recording, _ = _pipeline("hmd2_online", "walkers", "pipeline.runtime=eager", "pipeline.precision=float32")
    head, points, camera = recording.head, recording.points, recording.camera
    assert head is not None
    assert points is not None
    assert points.first_seen is not None
    session = HMD2Session(pipeline, [Wearer(recording.skeleton, head.R_head_device, head.t_head_device)], [3])
    parts, before = [], -np.inf
    for number, now in enumerate(head.timestamps.tolist()):
        new = (points.first_seen > before) & (points.first_seen <= now)
        shown = (
            None
            if camera is None or camera.embedding is None
            else (camera.timestamps > before) & (camera.timestamps <= now)
        )
        embedding = camera.embedding[shown][-1] if shown is not None and bool(shown.any()) else None
        session.push([[HeadSample(now, head.T_world_device[number], points.points_world[new], embedding)]])
        parts += session.poses()
        before = now
    return joined([part for part in (*parts, *session.poses(ended=True)) if part is not None])


def mocap_every_streamed() -> Motion | None:
    pipeline, recording, _ = _pipeline(
        "mocap_every_online", "keyed", "pipeline.runtime=eager", "pipeline.precision=float32"
    )
    head = recording.head
    assert head is not None
    mounts = {joint: stream.R_joint_imu for joint, stream in recording.imu.items() if "wrist" in joint}
    session = MocapEveryStream(pipeline, Wearer(recording.skeleton, head.R_head_device, head.t_head_device, mounts))
    parts, before = [], -np.inf
    for number, now in enumerate(head.timestamps.tolist()):
        session.head(now, head.T_world_device[number])
        for joint in mounts:
            stream = recording.imu[joint]
            new = (stream.timestamps > before) & (stream.timestamps <= now)
            rows = zip(stream.timestamps[new].tolist(), stream.R_world_imu[new], stream.acc_world[new])
            session.watch(joint, [WatchSample(*row) for row in rows])
        parts.append(session.poses())
        before = now
    return joined([part for part in (*parts, session.poses(ended=True)) if part is not None])


def echo_streamed() -> Motion | None:
    pipeline, recording, place = _pipeline("echo_online", "objects", "pipeline.runtime=eager")
    head, motion = recording.head, recording.motion
    assert head is not None
    assert motion is not None
    environment = CaptureInput(recording, dataset_folder(place)).objects()
    wearer = Wearer(recording.skeleton, head.R_head_device, head.t_head_device, shape=recording.shape)
    session = EchoStream(pipeline, wearer, environment, seed=3)
    for span in true_spans(recording):
        session.activate(span.object, span.start_s)
        session.activate(None, span.stop_s)
    parts = []
    wrists = {joint: motion.joint(joint) for joint in ("left_wrist", "right_wrist")}
    for number, now in enumerate(motion.timestamps.tolist()):
        session.head(now, head.T_world_device[int((head.timestamps - now).abs().argmin())])
        for joint, T in wrists.items():
            session.wrist(joint, now, T[number])
        parts.append(session.poses())
    return joined([part for part in (*parts, session.poses(ended=True)) if part is not None])


def hps_streamed() -> Motion | None:
    pipeline, recording, place = _pipeline("hps_without_scene", "hps", "pipeline.synchronization.clock=shared")
    pieces, motions = _pieces(recording, 4.0), []
    session = HpsSession(pipeline, [recording], None)
    for piece in pieces:
        session.push([[HpsSession.of_piece(pipeline, piece, Path(place).parent, None)]])
        motions += session.poses()
    return joined([motion for motion in (*motions, *session.poses(ended=True)) if motion is not None])


def _pieces(recording: Recording, seconds: float) -> Iterator[Recording]:
    """The suit and the localised camera, a few seconds at a time."""
    suit, seen, camera = recording.suit, recording.localization, recording.camera
    assert suit is not None
    assert seen is not None
    assert camera is not None
    for start in np.arange(suit.timestamps[0].item(), suit.timestamps[-1].item(), seconds).tolist():
        first, stop = (int(torch.searchsorted(suit.timestamps, start + t)) for t in (0.0, seconds))
        here = (seen.timestamps >= start) & (seen.timestamps < start + seconds)
        parts = {name: getattr(seen, name)[here] for name in ("timestamps", "R_world_cam", "t_world_cam", "confidence")}
        yield replace(
            recording,
            suit=suit.sliced(first, stop),
            localization=replace(seen, **parts),
            motion=None,
            contacts=None,
            camera=replace(camera, timestamps=seen.timestamps[here]),
        )


STREAMS: dict[str, Callable[[], Motion | None]] = {
    "hmd2": hmd2_streamed,
    "mocap_every": mocap_every_streamed,
    "echo": echo_streamed,
    "hps": hps_streamed,
}


def streamed(name: str) -> Arrays:
    Path("streams").mkdir(exist_ok=True)
    motion = STREAMS[name]()
    assert motion is not None
    return arrays_of(motion)


KINDS: dict[str, tuple[Callable[[str], Arrays], Any]] = {
    "data": (prepared, DATA),
    "train": (trained, TRAININGS),
    "capture": (captured, CAPTURES),
    "stream": (streamed, STREAMS),
    "evaluate": (evaluated, EVALUATIONS),
    "export": (exported, EXPORTS),
}
CASES = [f"{kind}/{name}" for kind, (_, names) in KINDS.items() for name in names]


def described(arrays: Arrays) -> dict[str, dict[str, Any]]:
    """Shape, hash and some values of each array."""
    found = {}
    for key, array in sorted(arrays.items()):
        array = np.ascontiguousarray(array)
        spread = np.unique(np.linspace(0, max(array.size - 1, 0), VALUES).round().astype(int)) if array.size else []
        values = [float(f"{value:.8g}") for value in array.reshape(-1)[spread].astype(np.float64)]
        digest = hashlib.sha256(array.tobytes()).hexdigest()[:16]
        found[key] = {"shape": list(array.shape), "sha256": digest, "values": values}
    return found


def difference(found: dict[str, Any], golden: dict[str, Any]) -> tuple[str, float]:
    """How a case differs from its golden: words, and the largest difference of the values that are kept."""
    # Names of arrays may change with the code; their order and content may not.
    ours, theirs = list(found.values()), list(golden.values())
    if sorted(row["sha256"] for row in ours) == sorted(row["sha256"] for row in theirs):
        return "equal", 0.0
    if list(found) != list(golden):
        return f"other arrays: {sorted(set(found) ^ set(golden))}", float("inf")
    largest = 0.0
    for key in found:
        if found[key]["shape"] != golden[key]["shape"]:
            return f"{key} has shape {found[key]['shape']}, was {golden[key]['shape']}", float("inf")
        a, b = (np.array(row[key]["values"]) for row in (found, golden))
        largest = max(largest, float(np.abs(a - b).max(initial=0.0)))
    return "close", largest


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", metavar="CASE", help="KIND/NAME or KIND (default: all)")
    parser.add_argument("--write", action="store_true", help="write the goldens of these cases anew")
    parser.add_argument("--list", action="store_true", help="name the cases and leave")
    parser.add_argument("--tolerance", type=float, default=1e-5)
    parser.add_argument("--output", type=Path, default=Path("outputs/goldens"), help="folder of what is made")
    parser.add_argument("--goldens", type=Path, default=GOLDENS, help="file of the goldens")
    options = parser.parse_args(arguments)
    if options.list:
        print(*CASES, sep="\n")
        return 0
    if unknown := [name for name in options.cases if name not in CASES and name not in KINDS]:
        parser.error(f"no case {', '.join(unknown)}. `--list` names them.")
    wanted = [case for case in CASES if not options.cases or {case, case.partition("/")[0]} & set(options.cases)]
    goldens_file = options.goldens.resolve()
    goldens = json.loads(goldens_file.read_text(encoding="utf-8")) if goldens_file.exists() else {}
    options.output.mkdir(parents=True, exist_ok=True)
    os.chdir(options.output)
    torch.set_num_threads(1)
    bad = 0
    for case in wanted:
        kind, _, name = case.partition("/")
        begin = time.monotonic()
        try:
            found = described(KINDS[kind][0](name))
        except Exception:
            traceback.print_exc()
            print(json.dumps({"case": case, "result": "failed"}), flush=True)
            bad += 1
            continue
        if options.write:
            goldens[case] = found
            goldens_file.write_text(
                json.dumps(goldens, indent=None).replace('}}, "', '}},\n"') + "\n", encoding="utf-8"
            )
            words, largest = "written", 0.0
        else:
            words, largest = difference(found, goldens[case]) if case in goldens else ("no golden", float("inf"))
        failed = largest > options.tolerance
        bad += failed
        print(
            json.dumps(
                {
                    "case": case,
                    "result": "differs" if failed and words == "close" else words,
                    "largest": largest,
                    "seconds": round(time.monotonic() - begin, 1),
                }
            ),
            flush=True,
        )
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
