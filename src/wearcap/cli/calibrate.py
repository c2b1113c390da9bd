"""`wearcap calibrate`: a video or pictures of a checkerboard go in; a camera's intrinsics come out.

`wearcap calibrate steps=watches`: two watches' logs and a camera's path go in; their poses, clocks and scale in the world
come out. The steps are MocapEvery's (appendix C.2): board, T-pose, four camera positions, standing, arm swings.
"""

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from rich import print as show
from rich.markup import escape
from rich.table import Table

from wearcap.body.skeleton import WRISTS, skeleton_of_height
from wearcap.cli.conf import hydra_main
from wearcap.errors import WearcapError, nearest
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.devices.watch_log import read_watch_log
from wearcap.io.formats.camera_json import write_camera
from wearcap.io.formats.trajectory import read_trajectory
from wearcap.io.formats.video import read_pictures
from wearcap.localization.checkerboard import Board, Calibration, calibrate_from_pictures
from wearcap.locks import folder_lock
from wearcap.prepare.logs import read_cloud, read_head_imu
from wearcap.recording import Recording, RecordingStore
from wearcap.recording.store import load_recording, save_recording
from wearcap.sensors.camera_alignment import HeadMount, SlamAlignment, align_by_marks, mark_positions, mount_by_standing
from wearcap.sensors.clock import require_overlap
from wearcap.sensors.slam_alignment import SceneEvidence, align_cleaned, facing, pose_of
from wearcap.sensors.stillness import StepCheck, Stretch, require
from wearcap.sensors.watch_calibration import (
    WatchSession,
    WornCalibration,
    measure_watches,
    require_watches,
    watch_checks,
    write_watch_calibration,
)

ENOUGH = 0.6
"""Coverage below which a hint is printed."""


def run(config: DictConfig) -> Calibration:
    """Calibrate from the config's source and write camera.json."""
    board = Board(config.columns, config.rows, config.square_m)
    pictures = read_pictures(config.source, config.max_pictures)
    found = calibrate_from_pictures(pictures, board, instantiate(config.settings))
    _show_report(found)
    views = [
        {"name": view.name, "rms_px": round(view.rms_px, 4), "used": used}
        for used, group in ((True, found.views), (False, found.rejected))
        for view in group
    ]
    about = {
        "source": Path(str(config.source)).name,
        "board": asdict(board),
        "rms_px": found.rms_px,
        "focal_std_px": found.focal_std_px,
        "coverage": found.coverage,
        "pictures_examined": found.examined,
        "pictures_with_board": found.seen,
        "views": views,
    }
    write_camera(found.camera, config.output, about)
    show(f"camera: {config.output}")
    return found


def _show_report(found: Calibration) -> None:
    camera = found.camera
    table = Table(
        title=f"{len(found.views)} views used, {len(found.rejected)} rejected, of {found.seen} with the board in "
        f"{found.examined} pictures",
        title_justify="left",
    )
    for column in ("view", "residual (px)", "edge blur (px)", ""):
        table.add_column(column, justify="left" if column in ("view", "") else "right")
    for view in sorted((*found.views, *found.rejected), key=lambda view: -view.rms_px)[:8]:
        verdict = "rejected" if view in found.rejected else ""
        table.add_row(view.name, f"{view.rms_px:.3f}", f"{view.blur_px:.1f}", verdict)
    show(table)
    show(
        f"fx {camera.fx:.2f}  fy {camera.fy:.2f}  cx {camera.cx:.2f}  cy {camera.cy:.2f}  k1 k2 p1 p2 "
        + " ".join(f"{value:.5f}" for value in camera.distortion)
    )
    show(
        f"reprojection RMS {found.rms_px:.3f} px, focal length ± {found.focal_std_px:.2f} px, corners in "
        f"{100 * found.coverage:.0f} % of the picture"
    )
    if found.coverage < ENOUGH:
        show("[yellow]note: hold the board into the picture's corners too; distortion there is extrapolated[/]")


STEPS = {
    "board": "Lay both watches on the board for 3 s: backs down, 12 o'clock along the board's y axis. Touch nothing.",
    "tpose": "Put them on, stand in a T-pose that faces the board's y for 3 s: arms level, palms down.",
    "marks": "Put the camera on C1 and C2 (y axis), then C3 and C4 (x axis), for 3 s each, and measure |C1 C2| and |C3 C4|"
    " (distances_m=[…,…]) and the camera's height over the floor (mark_height_m=…). Or, without the board: points=CLOUD.ply"
    " camera_height_m=… (measured while standing), or head_imu=LOG.csv; walks=[[from,to,metres],…] for the scale alone.",
    "standing": "Put the camera on, stand upright for 10 s with hanging arms and look ahead along the board's y.",
    "swings": "Swing the stretched arms from hanging to before the camera and back, ten times, at uneven intervals; note the"
    " times of the frames in which the hands are nearest.",
}
OF_CAMERA = ("marks", "standing", "swings")
_ABOUT = (
    *("board", "tpose", "swings_in", "marks", "distances_m", "mark_height_m", "standing", "facing_deg"),
    *("camera_height_m", "walks"),
)
"""Settings that a calibration's file repeats, followed by those of the swings."""


def run_watches(config: DictConfig) -> WornCalibration | None:
    """Calibrate from the config's logs and segments; write calibration.json and, if configured, a recording.

    With `guide`, or when a segment is missing, prints what to do and where the logs probably contain it.
    """
    if config.steps != "watches":
        raise WearcapError(f"no steps {config.steps!r}", fix=nearest(str(config.steps), ["watches"]))
    watches = {joint: read_watch_log(config[joint.split("_")[0]], joint) for joint in WRISTS}
    fix = "Give the logs of one session; watches count their time since 1970."
    require_overlap({joint: watch.timestamps for joint, watch in watches.items()}, fix)
    slam = None if config.camera is None else read_trajectory(config.camera, fps=float(config.camera_fps))
    if slam is None and (given := [key for key in OF_CAMERA if config[key] is not None]):
        raise WearcapError(f"{', '.join(given)} without a camera", fix="Give its path, too: camera=TRAJ.txt.")
    session = WatchSession(watches, slam)
    # Without the board's marks the floor or the head's sensor tells scale and vertical.
    marked = config.head_imu is None and (config.points is None or config.camera_height_m is None)
    of_board = ("marks", "distances_m") if marked else ()
    needed = ("board", "tpose") if slam is None else ("board", "tpose", *of_board, "standing")
    missing = [key for key in needed if config[key] is None]
    if config.guide or missing:
        _guide(config, session)
    if config.guide:
        return None
    if missing:
        fix = "Give them as " + " ".join(f"{key}=[…]" for key in missing) + "."
        raise WearcapError(f"no {', '.join(missing)}", expected="every step's stretch, as listed above", fix=fix)
    target, recording = None if config.recording is None else Path(config.recording), None
    if target is not None:
        new = target.suffix == ".safetensors" and not target.exists()
        recording = Recording(target.stem) if new else load_recording(target)
        if config.height is not None:
            recording = replace(recording, skeleton=skeleton_of_height(float(config.height)))
    found, session, checks = _measured(config, session)
    _show_checks(checks)
    require(checks)
    files = {key: Path(config[key]).name for key in ("left", "right", "camera") if config[key] is not None}
    settings: Any = OmegaConf.to_container(OmegaConf.masked_copy(config, [*_ABOUT, "swings", "camera_fps"]))
    about = files | {key: value for key, value in settings.items() if value is not None}
    write_watch_calibration(found, config.output, checks, about)
    show(f"calibration: {escape(str(config.output))}")
    if recording is not None and target is not None:
        if not found.clocks:
            show("[yellow]note: without arm swings the watches stay on their own clock[/]")
        points = None if config.points is None else read_cloud(config.points).points_world
        _store(session.added_to(recording, found, points), target)
        show(f"recording: {escape(str(config.recording))}")
    return found


def _measured(config: DictConfig, session: WatchSession) -> tuple[WornCalibration, WatchSession, list[StepCheck]]:
    """The calibration, the session with the camera's path without outliers, and all checks."""
    board, t_pose = (_stretch(key, config[key], session.watch_zero) for key in ("board", "tpose"))
    watches = measure_watches(session.watches, board, t_pose)
    limits = instantiate(config.watch_limits)
    checks = watch_checks(watches, limits)
    if not all(check.ok for check in checks):
        _show_checks(checks)
    # Swings of a wrongly calibrated watch would mislead.
    require_watches(session.watches, watches, t_pose, limits)
    camera, head, clocks = None, None, {}
    if session.slam is not None:
        camera, head, clean, more = _camera(config, session.slam, session.camera_zero)
        session = replace(session, slam=clean)
        checks += more
        if config.swings is not None:
            seen_s = torch.tensor(_numbers(config, "swings"), dtype=torch.float64)
            for joint, stream in session.watches.items():
                stretch = t_pose[1], stream.timestamps[-1].item()
                if config.swings_in is not None:
                    stretch = _stretch("swings_in", config.swings_in, session.watch_zero)
                watch = watches[joint].apply(stream)
                clocks[joint] = session.swing_clock(watch, seen_s, stretch, config.camera_fps)
            checks += [check for joint, clock in clocks.items() for check in clock.checks(joint)]
    return WornCalibration(watches, clocks, camera, head), session, checks


def _camera(
    config: DictConfig, slam: Trajectory, zero: float
) -> tuple[SlamAlignment, HeadMount, Trajectory, list[StepCheck]]:
    """Alignment of the camera's world by the board's marks, else by the floor or the head's sensor; mount; clean path."""
    limits = instantiate(config.camera_limits)
    standing = _stretch("standing", config.standing, zero)
    stretches = [] if config.marks is None else [_stretch("marks", mark, zero) for mark in config.marks]
    evidence = None if stretches else _evidence(config, standing, zero)

    def align(path: Trajectory) -> SlamAlignment:
        if evidence is not None:
            return facing(evidence.align(path), path, standing, config.facing_deg)
        first, second = _numbers(config, "distances_m", 2)
        return align_by_marks(mark_positions(path, stretches)[0], (first, second), config.mark_height_m)

    burst = float(config.max_acceleration), float(config.max_burst_s)
    camera, clean, outliers = align_cleaned(slam, align, *burst)
    if outliers:
        show(outliers)
    moved, turned = None, []
    if stretches:
        _, moved, turned = mark_positions(clean, stretches)
        moved = camera.scale * moved
    x, y, z = _numbers(config, "t_head_cam", 3)
    head = mount_by_standing(camera.apply(clean), standing, config.facing_deg, (x, y, z))
    return camera, head, clean, camera.checks(moved, turned, limits) + head.checks(limits)


def _evidence(config: DictConfig, standing: Stretch, zero: float) -> SceneEvidence:
    """What shows scale and vertical without the board."""
    try:
        walks = tuple((float(a) + zero, float(b) + zero, float(metres)) for a, b, metres in config.walks or ())
    except (TypeError, ValueError) as error:
        raise WearcapError(f"walks={config.walks}", expected="[[from,to,metres],…]") from error
    height = None if config.camera_height_m is None else float(config.camera_height_m)
    imu = None if config.head_imu is None else read_head_imu(config.head_imu)
    points = None if config.points is None else read_cloud(config.points).points_world
    return SceneEvidence(points, standing, height, imu, pose_of(config.T_cam_imu, "T_cam_imu"), walks)


def _stretch(key: str, value: Any, zero: float) -> Stretch:
    """A segment of the config on the log's clock."""
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


def _store(recording: Recording, where: Path) -> None:
    """Write a recording into its data set or its separate file."""
    if where.suffix == ".safetensors":
        save_recording(recording, where)
        return
    with folder_lock(where.parent, "calibrate"):
        store = RecordingStore.open(where.parent)
        entry = store.entries[where.name]
        store.add(recording, split=entry.split, config_hash=entry.config_hash)


def _show_checks(checks: Sequence[StepCheck]) -> None:
    table = Table()
    for column in ("step", "", "measured", "limit", "ok"):
        table.add_column(column, justify="right" if column in ("measured", "limit") else "left")
    for check in checks:
        verdict = "yes" if check.ok else "[red]no[/]"
        table.add_row(check.step, check.what, f"{check.measured:.3g} {check.unit}", check.expected, verdict)
    show(table)


def _guide(config: DictConfig, session: WatchSession) -> None:
    """Print each step, whether its segment is configured, and where the logs probably contain it."""
    proposed = {}
    for key, stretches in session.proposed().items():
        listed = ",".join(f"[{start:.2f},{stop:.2f}]" for start, stop in stretches)
        proposed[key] = f"[{listed}]" if key == "marks" else listed
    keys = [key for key in STEPS if key not in OF_CAMERA or session.slam is not None]
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
    if session.slam is None:
        show("With a head camera, give camera=TRAJ.txt for its steps.")
    if hints := [f"{key}={proposed[key]}" for key in keys if key in proposed and config[key] is None]:
        print("try: " + " ".join(hints))  # unwrapped, to be copied


def main(arguments: list[str]) -> None:
    if any(argument.startswith("steps=") for argument in arguments):
        hydra_main("calibrate_watches", run_watches, arguments)
    else:
        hydra_main("calibrate", run, arguments)
