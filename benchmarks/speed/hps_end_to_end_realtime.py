"""HPS end to end: seconds of recording per second of computing, from suit and video to motion, localisation included.

A simulated wearer of the test split claps, walks 30 m through a scanned and photographed site and is filmed throughout:
960 x 540 at 30 frames per second, H.264, with sound; suit of typical errors. Inside the clock is all that
`capture.py pipeline=hps` does between a recording and its motion: reading the map and the scan, the claps in the video's
sound and in the wrist sensors, decoding every frame, localisation, alignment, initialisation, the bones' scale, the
solver. Outside are imports, compilation and the body's mesh (a capture of the first seconds runs before), the suit's file,
and written files.

value: times real time by default, with key frames and tracked landmarks (conf/head_camera/map.yaml), 10 poses a second.
baseline: each frame localised anew, six a second (each_frame.yaml). ratio = value / baseline; the goal is for `value`.
Both are compared with the truth, in the unit and on stderr: camera poses at the frames that have one, joints of the
captured motion in the world, without alignment. Speed that costs accuracy does not reach the goal. The unit also says
how many seconds of one core a second of recording takes, which beside other work tells more than the clock.
The recording and its map are made at first (a quarter of an hour) and kept in outputs/benchmarks.
"""

import sys
import time
from dataclasses import replace
from pathlib import Path

from hydra.utils import instantiate

from benchmarks.speed.figures import figure
from data_prep.shared.engine import Splits, prepare
from wearcap.cli.conf import compose, splits_dir
from wearcap.cli.scene import run as build_scene_map
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import nearest_frames
from wearcap.recording import Motion, Recording
from wearcap.recording.recording import Localization
from wearcap.recording.store import RecordingStore
from wearcap.recording.timing import resampled
from wearcap.runtime.system import CaptureInput
from wearsim.rendering.head_camera import HEAD_CAMERA_TRUTH

FOLDER = Path("outputs/benchmarks/hps_end_to_end")
ANEW = ("head_camera@pipeline=each_frame",)


def dataset(split: str = "test", end_m: float = 30.0) -> tuple[Recording, Path]:
    """A recording with its video, scan and map, and their folder; made where it is missing."""
    folder = FOLDER / split
    settings = [f"recordings={{{split}: 1}}", "returns_m=[]", f"end_m={end_m}", "video_s=null", "video_fps=30"]
    settings += ["photo_m=3", "camera_errors=ideal", f"output={folder}"]
    config = compose("prepare", ["prepare=simulated_hps", "preset=quick", *settings])
    tasks = instantiate(config.tasks, _convert_="all", _partial_=True)(splits=Splits.read(splits_dir() / config.splits))
    report = prepare(tasks, folder, jobs=1)
    if report.failed:
        raise SystemExit(f"error: {report.failed}")
    recording = RecordingStore.open(folder).load(tasks[0].name)
    assert recording.scene is not None
    scene = (folder / recording.scene).parent
    if not (scene / "map.safetensors").is_file():
        build_scene_map(compose("scene", [f"scene={scene}", f"output={scene / 'map.safetensors'}", "check=0"]))
    return recording, folder


def captured(recording: Recording, folder: Path, *choices: str) -> tuple[float, float, Motion, Localization]:
    """Seconds and processor seconds that a capture takes, its motion, and the camera's poses."""
    assert recording.scene is not None
    scene = folder / Path(recording.scene).parent
    chosen = ["pipeline=hps", "recording=none", f"pipeline.localization.map={scene}", *choices]
    pipeline = instantiate(compose("capture", chosen).pipeline, _convert_="all")
    source = CaptureInput.in_dataset(recording, folder)
    begin, spent = time.perf_counter(), time.process_time()
    results = pipeline.results(source)
    motion = pipeline.motion_of(results)
    seconds, spent = time.perf_counter() - begin, time.process_time() - spent
    assert motion is not None
    return seconds, spent, motion, results["localize"]


def started(recording: Recording, seconds: float = 6.0) -> Recording:
    """The first seconds of the camera's time."""
    camera = recording.camera
    assert camera is not None
    return replace(
        recording,
        camera=replace(camera, timestamps=camera.timestamps[camera.timestamps < camera.timestamps[0] + seconds]),
    )


def accuracy(recording: Recording, motion: Motion, localization: Localization) -> dict[str, float]:
    """Errors (mean, and 95th percentile) of the camera's poses and of the joints in the world, and the share of frames
    with a pose."""
    true, truth = recording.object_motion[HEAD_CAMERA_TRUTH], recording.motion
    assert truth is not None
    found = localization.confidence > 0.5
    at = nearest_frames(true.timestamps, localization.timestamps[found])
    cm = 100 * (localization.t_world_cam[found] - true.t_world_body[at]).norm(dim=-1)
    turned = rotation.geodesic(localization.R_world_cam[found].double(), true.R_world_body[at].double()).rad2deg()
    joints = (motion.T_world_joint.t - resampled(truth, 30.0).T_world_joint.t[: len(motion)]).norm(dim=-1)
    return {
        "camera_cm": cm.mean().item(),
        "camera_p95_cm": cm.quantile(0.95).item(),
        "camera_deg": turned.mean().item(),
        "camera_p95_deg": turned.quantile(0.95).item(),
        "share": found.double().mean().item(),
        "joints_cm": 100 * joints.mean().item(),
    }


def measure(split: str = "test", end_m: float = 30.0) -> list[dict]:
    recording, folder = dataset(split, end_m)
    camera = recording.camera
    assert camera is not None
    duration = (camera.timestamps[-1] - camera.timestamps[0]).item()
    captured(started(recording), folder)
    rows = {}
    for name, choices in (("tracked", ()), ("each frame anew", ANEW)):
        seconds, spent, motion, localization = captured(recording, folder, *choices)
        rows[name] = {"times_real_time": duration / seconds, "core_s_per_s": spent / duration}
        rows[name] |= accuracy(recording, motion, localization)
        print(name, {key: round(value, 3) for key, value in rows[name].items()}, file=sys.stderr, flush=True)
    ours, anew = rows.values()
    value, baseline = (row["times_real_time"] for row in (ours, anew))
    return [
        figure(
            "hps_end_to_end_realtime",
            value,
            f"s of recording per s (camera {ours['camera_cm']:.2f} cm off, each frame anew {anew['camera_cm']:.2f}; "
            f"joints {ours['joints_cm']:.2f} cm, {anew['joints_cm']:.2f}; {ours['core_s_per_s']:.2f} s of a core per s, "
            f"{anew['core_s_per_s']:.2f})",
            baseline,
            value / baseline,
            5.0,
        )
    ]
