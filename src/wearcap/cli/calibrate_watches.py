"""`wearcap calibrate steps=watches`: two watches' logs and a camera's path go in; their poses, clocks and scale in the world come out.

The steps are MocapEvery's (appendix C.2): board, T-pose, four camera positions, standing, arm swings.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from rich import print as show
from rich.markup import escape
from rich.table import Table

from wearcap.body.skeleton import WRISTS
from wearcap.cli.conf import hydra_main
from wearcap.errors import WearcapError, nearest
from wearcap.files import folder_lock
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.devices.watch_calibration_json import WornCalibration, write_watch_calibration
from wearcap.io.devices.watch_log import read_watch_log
from wearcap.io.formats.tum import read_tum
from wearcap.recording import FloorTrack, ImuStream, Recording, RecordingStore
from wearcap.recording.store import load_recording, save_recording
from wearcap.sensors.arm_swings import SwingClock, fit_swing_clock, swing_checks, swing_peaks
from wearcap.sensors.camera_alignment import (
    HeadMount,
    SlamAlignment,
    align_by_marks,
    mark_checks,
    mark_positions,
    mount_by_standing,
    mount_checks,
)
from wearcap.sensors.stillness import StepCheck, Stretch, require, still_intervals
from wearcap.sensors.watch_calibration import measure_watches, propose_steps, require_watches, watch_checks

STEPS = {
    "board": "Lay both watches on the board for 3 s: backs down, 12 o'clock along the board's y axis. Touch nothing.",
    "tpose": "Put them on, stand in a T-pose that faces the board's y for 3 s: arms level, palms down.",
    "marks": "Put the camera on C1 and C2 (y axis), then C3 and C4 (x axis), for 3 s each, and measure |C1 C2| and |C3 C4|"
    " (distances_m=[…,…]) and the camera's height over the floor (mark_height_m=…).",
    "standing": "Put the camera on, stand upright for 10 s with hanging arms and look ahead along the board's y.",
    "swings": "Swing the stretched arms from hanging to before the camera and back, ten times, at uneven intervals; note the"
    " times of the frames in which the hands are nearest.",
}
OF_CAMERA = ("marks", "standing", "swings")
STAND_S = 8.0


@dataclass(frozen=True)
class Logs:
    """Recorded logs and camera path, and the times (s) that segments are relative to."""

    watches: dict[str, ImuStream]
    watch_zero: float
    slam: Trajectory | None
    camera_zero: float


def run(config: DictConfig) -> WornCalibration | None:
    """Calibrate from the config's logs and segments; write calibration.json and, if configured, a recording.

    With `guide`, or when a segment is missing, prints what to do and where the logs probably contain it.
    """
    if config.steps != "watches":
        raise WearcapError(f"no steps {config.steps!r}", fix=nearest(str(config.steps), ["watches"]))
    logs = _read(config)
    missing = [key for key in ("board", "tpose") if config[key] is None]
    if logs.slam is not None:
        missing += [key for key in ("marks", "distances_m", "standing") if config[key] is None]
    if config.guide or missing:
        _guide(config, logs)
    if config.guide:
        return None
    if missing:
        raise WearcapError(
            f"no {', '.join(missing)}",
            expected="every step's stretch, as listed above",
            fix="Give them as " + " ".join(f"{key}=[…]" for key in missing) + ".",
        )
    recording = None if config.recording is None else _base(Path(config.recording))
    found, checks = _measured(config, logs)
    _show_report(checks)
    require(checks)
    write_watch_calibration(found, config.output, checks, _about(config))
    show(f"calibration: {escape(str(config.output))}")
    if recording is not None:
        _store(found, logs, recording, Path(config.recording))
        show(f"recording: {escape(str(config.recording))}")
    return found


def _read(config: DictConfig) -> Logs:
    watches = {joint: read_watch_log(config[joint.split("_")[0]], joint) for joint in WRISTS}
    slam = None if config.camera is None else read_tum(config.camera)
    if slam is None and (given := [key for key in OF_CAMERA if config[key] is not None]):
        raise WearcapError(f"{', '.join(given)} without a camera", fix="Give its path, too: camera=TRAJ.txt.")
    zero = max(stream.timestamps[0].item() for stream in watches.values())
    return Logs(watches, zero, slam, 0.0 if slam is None else slam.timestamps[0].item())


def _stretch(config: DictConfig, key: str, zero: float, place: int | None = None) -> Stretch:
    """A segment of the config on the log's clock."""
    value = config[key] if place is None else config[key][place]
    try:
        start, stop = (float(number) + zero for number in value)
    except (TypeError, ValueError) as error:
        raise WearcapError(f"{key}={value}", expected=f"{key}=[from,to] in seconds") from error
    return start, stop


def _numbers(config: DictConfig, key: str, count: int | None = None) -> list[float]:
    try:
        numbers = [float(number) for number in config[key]]
    except (TypeError, ValueError) as error:
        raise WearcapError(f"{key}={config[key]}", expected="numbers in brackets") from error
    if not numbers or count not in (None, len(numbers)):
        raise WearcapError(f"{key}={numbers}", expected=f"{count or 'one or more'} numbers")
    return numbers


def _measured(config: DictConfig, logs: Logs) -> tuple[WornCalibration, list[StepCheck]]:
    board, t_pose = (_stretch(config, key, logs.watch_zero) for key in ("board", "tpose"))
    watches = measure_watches(logs.watches, board, t_pose)
    limits = instantiate(config.watch_limits)
    checks = watch_checks(watches, limits)
    if not all(check.ok for check in checks):
        _show_report(checks)
    # Swings of a wrongly calibrated watch would mislead.
    require_watches(logs.watches, watches, t_pose, limits)
    camera, head, clocks = None, None, {}
    if logs.slam is not None:
        camera, head, more = _camera(config, logs.slam, logs.camera_zero)
        checks += more
        if config.swings is not None:
            clocks = {
                joint: _clock(config, logs, watches[joint].apply(stream), t_pose)
                for joint, stream in logs.watches.items()
            }
            checks += [check for joint, clock in clocks.items() for check in swing_checks(clock, joint)]
    return WornCalibration(watches, clocks, camera, head), checks


def _camera(config: DictConfig, slam: Trajectory, zero: float) -> tuple[SlamAlignment, HeadMount, list[StepCheck]]:
    limits = instantiate(config.camera_limits)
    stretches = [_stretch(config, "marks", zero, place) for place in range(len(config.marks))]
    marks, moved, turned = mark_positions(slam, stretches)
    first, second = _numbers(config, "distances_m", 2)
    camera = align_by_marks(marks, (first, second), config.mark_height_m)
    x, y, z = _numbers(config, "t_head_cam", 3)
    head = mount_by_standing(camera.apply(slam), _stretch(config, "standing", zero), config.facing_deg, (x, y, z))
    return camera, head, mark_checks(camera, camera.scale * moved, turned, limits) + mount_checks(head, limits)


def _clock(config: DictConfig, logs: Logs, watch: ImuStream, t_pose: Stretch) -> SwingClock:
    """Clock relation of the camera and one watch, from times after both logs have begun."""
    start, stop = t_pose[1], watch.timestamps[-1].item()
    if config.swings_in is not None:
        start, stop = _stretch(config, "swings_in", logs.watch_zero)
    peaks = swing_peaks(watch, (start, stop)) - logs.watch_zero
    seen = torch.tensor(_numbers(config, "swings"), dtype=torch.float64)
    found = fit_swing_clock(seen, peaks, 1 / config.camera_fps)
    clock = replace(
        found.clock, camera_s=found.clock.camera_s + logs.camera_zero, suit_s=found.clock.suit_s + logs.watch_zero
    )
    return SwingClock(clock, found.std_s)


def _about(config: DictConfig) -> dict[str, Any]:
    """Provenance of the calibration: its input files and settings."""
    keys = (
        "board",
        "tpose",
        "swings_in",
        "marks",
        "distances_m",
        "mark_height_m",
        "standing",
        "facing_deg",
        "swings",
        "camera_fps",
    )
    given = OmegaConf.to_container(OmegaConf.masked_copy(config, [*keys]))
    assert isinstance(given, dict)
    files = {key: Path(config[key]).name for key in ("left", "right", "camera") if config[key] is not None}
    return files | {str(key): value for key, value in given.items() if value is not None}


def _base(where: Path) -> Recording:
    """The recording that the streams go into: an empty one for a file that does not exist yet."""
    if where.suffix == ".safetensors" and not where.exists():
        return Recording(where.stem)
    return load_recording(where)


def _store(found: WornCalibration, logs: Logs, recording: Recording, where: Path) -> None:
    """Add the calibrated streams to a recording, in its data set or in a separate file."""
    imu = {}
    for joint, stream in logs.watches.items():
        imu[joint] = found.watches[joint].apply(stream)
        if joint in found.clocks:
            imu[joint] = replace(imu[joint], timestamps=found.clocks[joint].clock.to_camera(stream.timestamps))
    if not found.clocks:
        show("[yellow]note: without arm swings the watches stay on their own clock[/]")
    recording = replace(recording, imu=recording.imu | imu)
    if logs.slam is not None and found.camera is not None and found.head is not None:
        head = found.head.apply(found.camera.apply(logs.slam))
        # The world's z = 0 is the floor that the wearer stands on: MocapEvery's h_0.
        floor = recording.floor or FloorTrack(head.timestamps[:1], torch.zeros(1))
        recording = replace(recording, head=head, floor=floor)
    if where.suffix == ".safetensors":
        save_recording(recording, where)
        return
    with folder_lock(where.parent, "calibrate"):
        store = RecordingStore.open(where.parent)
        entry = store.entries[where.name]
        store.add(recording, split=entry.split, config_hash=entry.config_hash)


def _show_report(checks: Sequence[StepCheck]) -> None:
    table = Table()
    for column in ("step", "", "measured", "limit", "ok"):
        table.add_column(column, justify="right" if column in ("measured", "limit") else "left")
    for check in checks:
        verdict = "yes" if check.ok else "[red]no[/]"
        table.add_row(check.step, check.what, f"{check.measured:.3g} {check.unit}", check.expected, verdict)
    show(table)


def _guide(config: DictConfig, logs: Logs) -> None:
    """Print each step, whether its segment is configured, and where the logs probably contain it."""
    proposed = _proposed(logs)
    keys = [key for key in STEPS if key not in OF_CAMERA or logs.slam is not None]
    for number, key in enumerate(keys, 1):
        if config[key] is not None:
            state = f"given: {key}={config[key]}"
        elif key in proposed:
            state = f"the logs seem to have it: {key}={proposed[key]}"
        elif key == "swings":
            state = f"camera's frames: {key}=[…]"
        else:
            state = f"not found in the logs: {key}=[from,to]"
        show(f"{number}. {escape(STEPS[key])}\n   {escape(state)}")
    if logs.slam is None:
        show("With a head camera, give camera=TRAJ.txt for its steps.")
    if hints := [f"{key}={proposed[key]}" for key in keys if key in proposed and config[key] is None]:
        print("try: " + " ".join(hints))  # unwrapped, to be copied


def _proposed(logs: Logs) -> dict[str, str]:
    """Segments for the command line, by key."""
    found = {}
    for key, stretch in zip(("board", "tpose"), propose_steps(logs.watches)):
        if stretch is not None:
            found[key] = _written(stretch, logs.watch_zero)
    if logs.slam is not None:
        still = still_intervals(logs.slam.timestamps, logs.slam.R_world_body, min_s=1.5, still_deg=1.0)
        steady = still_intervals(logs.slam.timestamps, logs.slam.R_world_body, STAND_S)
        if len(still) >= 4:
            found["marks"] = "[" + ",".join(_written(stretch, logs.camera_zero) for stretch in still[:4]) + "]"
            steady = [stretch for stretch in steady if stretch[0] > still[3][1]]
        if steady:
            found["standing"] = _written(steady[0], logs.camera_zero)
    return found


def _written(stretch: Stretch, zero: float) -> str:
    return f"[{stretch[0] - zero:.2f},{stretch[1] - zero:.2f}]"


def main(arguments: list[str]) -> None:
    hydra_main(
        "calibrate_watches", run, ["guide=true" if argument == "--guide" else argument for argument in arguments]
    )
