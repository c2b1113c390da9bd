"""A wearer's own logs, known by their content: watches' and other inertial logs, trajectories, headsets'; and kits of them."""

import re
from pathlib import Path

import torch

from wearcap.body.skeleton import WRISTS
from wearcap.doctor.report import Check, Finding, refusal
from wearcap.errors import WearcapError
from wearcap.io.devices.aria_mps import head_stream, read_closed_loop
from wearcap.io.devices.axes import device_axes, to_head_axes
from wearcap.io.devices.headset_log import is_headset_log, read_headset_log
from wearcap.io.devices.watch_log import is_watch_log, read_inertial_log, read_watch_log
from wearcap.io.formats.csv_table import read_header
from wearcap.io.formats.trajectory import TrajectoryFile, read_trajectory_file, trajectory_format
from wearcap.recording import FloorTrack, HeadStream, Recording
from wearcap.recording.recording import ImuStream
from wearcap.sensors.watches import watch_gaps

_SIDES = {
    "left_wrist": re.compile(r"(^|[^a-z])(left|l|links)([^a-z]|$)"),
    "right_wrist": re.compile(r"(^|[^a-z])(right|r|rechts)([^a-z]|$)"),
}
_TABLES = {".csv", ".txt", ".tum", ".log", ".json", ".jsonl", ".npy"}
_MOST = 200
"""Most files of a folder that are looked into."""
Loaded = tuple[Recording, list[Finding]]


def log_kind(path: Path) -> str | None:
    """ "watch", "headset" or "trajectory"; None for any other file. Raises WearcapError for one that cannot be opened."""
    if path.suffix == ".npy":
        return "trajectory" if trajectory_format(path) else None
    if not {".json", ".jsonl"} & set(path.suffixes) and is_watch_log(path):
        return "watch"
    if is_headset_log(path):
        return "headset"
    return "trajectory" if trajectory_format(path) else None


def read_table(path: Path) -> Loaded:
    """A log of any kind. Raises WearcapError for a table that is none, with what the doctor knows."""
    kind = log_kind(path)
    if kind == "watch":
        return _watch(path)
    if kind == "headset":
        return _headset(path)
    if "aria_trajectory" in path.name or (kind == "trajectory" and trajectory_format(path) == "MPS"):
        track = read_closed_loop(path, up="y" if "aria_trajectory" in path.name else "z")[0]
        return Recording(name=path.name, head=head_stream(track, fps=None), source="Aria MPS"), []
    return as_head(read_trajectory_file(path), path.name)


def as_head(read: TrajectoryFile, name: str) -> Loaded:
    """A trajectory as a head stream, its axes as they seem to be."""
    what = f"{read.format}, {len(read.trajectory)} poses, times in {read.time_unit}"
    findings = [Check("trajectory").ok(what, "" if read.metric else "its unit of length is not known")]
    track, check = read.trajectory, Check("head: axes")
    evidence = "a trajectory file does not name its axes"
    try:
        axes = device_axes(track, device="camera" if read.of_camera else "auto", where=name)
    except WearcapError:
        fix = "x forward, y left, z up is assumed; say which axes it has: wearcap prepare trajectory up=… axes=…"
        findings.append(check.note("taken as the head's own pose", evidence, fix))
    else:
        track = to_head_axes(track, axes)
        words = f"{axes.up} is up, the device has {axes.device}'s axes"
        findings.append(check.note(f"detected: {words}", f"upright by {axes.upright:.2f}; {evidence}"))
    if not read.metric:
        fix = "Give scale=METRES, or points, head_imu or walks (wearcap prepare trajectory)."
        findings.append(Check("head: unit").note("metres are assumed", f"{read.format} knows no unit", fix))
    head = HeadStream(track.timestamps, track.R_world_body, track.t_world_body, torch.eye(3), torch.zeros(3))
    return Recording(name=name, head=head), findings


def _side(path: Path) -> str | None:
    """Wrist that a log's name, or its folder's, tells."""
    for word in (path.name.lower(), path.parent.name.lower()):
        found = [joint for joint, pattern in _SIDES.items() if pattern.search(word)]
        if len(found) == 1:
            return found[0]
    return None


def _read_watch(path: Path, joint: str) -> tuple[ImuStream, Finding]:
    inertial = not {"quaternionW", "motionQuaternionW(R)"} & set(read_header(path))
    stream = read_inertial_log(path, joint) if inertial else read_watch_log(path, joint)
    names = {"R_world_imu": "attitude", "acc_imu": "acceleration", "gyro_imu": "turn rate"}
    has = [word for name, word in names.items() if getattr(stream, name) is not None]
    missing = [word for name, word in names.items() if getattr(stream, name) is None]
    kind = "x-IMU3's log" if inertial else "a watch's log"
    evidence = f"{len(stream.timestamps)} samples, {(stream.timestamps[-1] - stream.timestamps[0]).item():.1f} s"
    check = Check(f"log {path.name}")
    what = f"{kind} with {', '.join(has)}"
    if missing:
        return stream, check.warning(
            f"{what}, without {', '.join(missing)}", evidence, "Export these, too, for a capture."
        )
    return stream, check.ok(what, evidence)


def _watch(path: Path) -> Loaded:
    joint = _side(path)
    stream, found = _read_watch(path, joint or WRISTS[0])
    findings = [found]
    if joint is None:
        fix = "Put left or right into the file's name."
        findings.append(Check("worn on").note("the left wrist is assumed", "its name tells no side", fix))
    return Recording(name=path.name, imu={stream.joint: stream}), findings


def _headset(path: Path) -> Loaded:
    log = read_headset_log(path)
    check = Check("headset's log")
    findings = [check.ok(f"head and {len(log.wrists)} hands", "; ".join(log.notes))]
    if not log.wrists:
        findings.append(check.note("no hands", "the head alone", "Log both controllers or hands for ECHO."))
    head = HeadStream(log.head.timestamps, log.head.R_world_body, log.head.t_world_body, torch.eye(3), torch.zeros(3))
    floor = FloorTrack(head.timestamps[:1], torch.zeros(1)) if log.floor else None
    return Recording(name=path.name, head=head, tracked=log.wrists, floor=floor), findings


# --- kits ----------------------------------------------------------------------------------------------------------


def log_files(folder: Path) -> dict[Path, str]:
    """Logs of a folder with their kinds; of a sensor's files in a folder of its own the inertial one."""
    found = {}
    for path in sorted(folder.iterdir())[:_MOST]:
        if path.is_file() and {suffix.lower() for suffix in path.suffixes} & _TABLES:
            try:
                kind = log_kind(path)
            except WearcapError:
                continue
            if kind is not None and not (path.name == "Quaternion.csv" and path.with_name("Inertial.csv").is_file()):
                found[path] = kind
    return found


def is_kit(folder: Path) -> bool:
    """Whether a folder holds the logs of one session: watches', or one headset's."""
    kinds = list(log_files(folder).values())
    return "watch" in kinds or kinds.count("headset") == 1


def read_kit(folder: Path) -> Loaded:
    """The logs of one session in one recording: two watches and a trajectory, or a headset's log.

    What cannot be read, is missing or stands beside is a finding.
    """
    logs, findings = log_files(folder), list[Finding]()
    parts = Recording(name=folder.resolve().name)
    watches = [path for path, kind in logs.items() if kind == "watch"]
    sides = _sides(watches, findings)
    for path, kind in logs.items():
        try:
            if kind == "watch":
                if path not in sides:
                    continue
                stream, found = _read_watch(path, sides[path])
                parts.imu[stream.joint] = stream
                findings.append(found)
                continue
            if parts.head is not None:
                what = "a second path of the head"
                findings.append(Check(f"log {path.name}").warning(what, "it is left out", "Move it to another folder."))
                continue
            read, found = read_table(path)
            findings += found
            parts = Recording(parts.name, head=read.head, imu=parts.imu, tracked=read.tracked, floor=read.floor)
        except WearcapError as error:
            findings.append(refusal(error, f"log {path.name}"))
    if parts.imu and parts.head is None:
        fix = "Put the head camera's trajectory beside (TUM, EuRoC, COLMAP, hloc, DROID-SLAM)."
        findings.append(Check("kit").error("no path of the head", f"{len(parts.imu)} watches", fix))
    if parts.head is not None:
        for gap in watch_gaps(parts.imu, parts.head.timestamps):
            findings.append(Check("watches").warning("silent for a while", gap))
    return parts, findings


def _sides(watches: list[Path], findings: list[Finding]) -> dict[Path, str]:
    """Wrists of the watches' logs, by their names, else in their order."""
    check = Check("watches")
    if len(watches) == 1:
        fix = "MocapEvery needs two: put the other's log beside."
        findings.append(check.warning("one watch", watches[0].name, fix))
    for path in watches[2:]:
        findings.append(check.warning("more than two watches", f"{path.name} is left out", "Keep one log per wrist."))
    sides = {path: side for path in watches if (side := _side(path)) is not None}
    if len(set(sides.values())) == len(watches) <= 2:
        return sides
    named: dict[Path, str] = dict(zip(watches[:2], WRISTS))
    listed = ", ".join(f"{path.name} on the {joint.replace('_', ' ')}" for path, joint in named.items())
    fix = "Put left and right into the files' names."
    findings.append(check.warning("sides are guessed from the order of the names", listed, fix))
    return named
