"""Logs of a wearer's own devices, known by their content: watches' and other inertial logs, trajectories, headsets'; Aria's
MPS; and kits, the folders that hold the logs of one session."""

import re
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from wearcap.body.skeleton import WRISTS
from wearcap.boundary.texts import read_json_object
from wearcap.checks.report import Check, Finding, refusal
from wearcap.checks.streams import check_clock
from wearcap.errors import WearcapError
from wearcap.io.conventions import AUTO, Conventions
from wearcap.io.devices.aria_mps import find_mps_file, head_stream, read_closed_loop, read_mps
from wearcap.io.devices.headset_log import is_headset_log
from wearcap.io.devices.watch_log import is_watch_log, read_inertial_log, read_watch, sensor_files
from wearcap.io.formats.csv_table import read_header
from wearcap.io.formats.trajectory import trajectory_format
from wearcap.prepare.logs import HeadsetSettings, TrajectorySettings, log_name, read_path
from wearcap.reading.kinds import Kind, Loaded, known
from wearcap.recording import Recording
from wearcap.recording.recording import ImuStream
from wearcap.sensors.watches import watch_gaps

_SIDES = {
    "left_wrist": re.compile(r"(^|[^a-z])(left|l|links)([^a-z]|$)"),
    "right_wrist": re.compile(r"(^|[^a-z])(right|r|rechts)([^a-z]|$)"),
}
_TABLES = (".csv", ".tsv", ".txt", ".tum", ".log")
OF_HEADSETS = "unit", "axes", "quaternion", "hands", "time_unit"
OF_TRAJECTORIES = "unit", "up", "axes", "time_unit", "fps"
_MOST = 200
"""Most files of a folder that are looked into."""


def load_trajectory(path: Path, how: Conventions) -> Loaded:
    """A head's path of any format, also from a folder of COLMAP's or DROID-SLAM's."""
    settings = TrajectorySettings(
        how.up,
        how.axes,
        None if how.time_unit == AUTO else how.time_unit,
        None if how.fps == AUTO else float(how.fps),
        how.unit,
    )
    recording = read_path(path, path.resolve().name.split(".")[0], {}, settings)
    return Loaded(recording, [Check("trajectory").ok("read", recording.note)])


def load_closed_loop(path: Path) -> Recording:
    """The path in one of MPS' files, at its own rate."""
    head = head_stream(read_closed_loop(path).trajectory, fps=None)
    return Recording(path.resolve().name.split(".")[0], head=head, source="Aria MPS")


def load_headset(path: Path, how: Conventions) -> Loaded:
    """A headset's log, or the folder of a session of one."""
    time_unit = None if how.time_unit == AUTO else how.time_unit
    settings = HeadsetSettings(how.unit, how.axes, how.quaternion, how.hands, time_unit)
    recording = settings.read(path, log_name(path), {})
    check = Check("headset's log")
    findings = [check.ok(f"head and {len(recording.tracked)} hands", recording.note)]
    if not recording.tracked:
        findings.append(check.note("no hands", "the head alone", "Log both controllers or hands for ECHO."))
    return Loaded(recording, findings)


def load_mps(folder: Path) -> Loaded:
    """An MPS folder at 60 Hz, with findings about the raw file's clock, its quality score and the service's own report."""
    path = find_mps_file(folder, ("closed_loop_trajectory.csv",))
    assert path is not None, "is_mps_folder has seen it"
    track, scores, _ = read_closed_loop(path)
    findings = check_clock("closed-loop file", track.timestamps)
    quality = scores.median().item()
    low = (scores < 0.5).float().mean().item()
    check, evidence = Check("closed-loop file: quality"), f"median score {quality:.2f}, {100 * low:.0f} % below 0.5"
    if low > 0.1:
        findings.append(check.warning("MPS trusts its poses little", evidence))
    else:
        findings.append(check.ok("MPS trusts its poses", evidence))
    findings.append(Check("closed-loop file: gravity").ok("points along -z", "9.81 m/s²"))
    recording = read_mps(folder)
    if recording.note:
        findings.append(Check("hands").note("none is used", recording.note))
    check, path = Check("MPS summary"), find_mps_file(folder, ("summary.json",))
    if path is None:
        return Loaded(recording, findings)
    try:
        parts = read_json_object(path)
    except WearcapError as error:
        return Loaded(recording, [*findings, check.warning("cannot be read", str(error))])
    states = {name: part.get("status", "SUCCESS") for name, part in parts.items() if isinstance(part, dict)}
    failed = [name for name, state in states.items() if state != "SUCCESS"]
    if failed:
        found = check.error("MPS reports failures", ", ".join(failed), "Request MPS again.")
    else:
        found = check.ok("MPS reports success", ", ".join(name for name in parts if name != "version"))
    return Loaded(recording, [*findings, found])


def _side(path: Path) -> str | None:
    """Wrist that a log's name, or its folder's, tells."""
    for word in (path.name.lower(), path.parent.name.lower()):
        found = [joint for joint, pattern in _SIDES.items() if pattern.search(word)]
        if len(found) == 1:
            return found[0]
    return None


def _read_watch(path: Path, joint: str) -> tuple[ImuStream, Finding]:
    inertial = "Accelerometer X (g)" in read_header(path) or path.name == "Quaternion.csv"
    stream, notes = (read_inertial_log(path, joint), []) if inertial else read_watch(path, joint)
    names = {"R_world_imu": "attitude", "acc_imu": "acceleration", "gyro_imu": "turn rate"}
    has = [word for name, word in names.items() if getattr(stream, name) is not None]
    missing = [word for name, word in names.items() if getattr(stream, name) is None]
    kind = "x-IMU3's log" if inertial else "a watch's log"
    span = (stream.timestamps[-1] - stream.timestamps[0]).item()
    evidence = "; ".join([f"{len(stream.timestamps)} samples, {span:.1f} s", *notes])
    check = Check(f"log {path.name}")
    what = f"{kind} with {', '.join(has)}"
    if missing:
        return stream, check.warning(
            f"{what}, without {', '.join(missing)}", evidence, "Export these, too, for a capture."
        )
    return stream, check.ok(what, evidence)


def load_watch(path: Path) -> Loaded:
    """One watch's log; the wrist that it was worn on is in its name, or its folder's."""
    joint = _side(path)
    stream, found = _read_watch(path, joint or WRISTS[0])
    findings = [found]
    if joint is None:
        fix = "Put left or right into the file's name."
        findings.append(Check("worn on").note("the left wrist is assumed", "its name tells no side", fix))
    return Loaded(Recording(path.name.split(".")[0], imu={stream.joint: stream}), findings)


_TEXTS = (*_TABLES, ".jsonl", ".json")
LOGS = (
    Kind("headset", load_headset, (".bsor",), stated=OF_HEADSETS),
    Kind("watch", load_watch, _TABLES, is_watch_log),
    Kind("headset", load_headset, _TEXTS, is_headset_log, OF_HEADSETS),
    Kind("trajectory", load_closed_loop, _TEXTS, lambda path: trajectory_format(path) == "MPS"),
    Kind("trajectory", load_trajectory, (*_TEXTS, ".npy"), trajectory_format, OF_TRAJECTORIES),
)
"""Logs of one device, by content."""


def log_files(folder: Path) -> dict[Path, Kind]:
    """Logs of a folder with their kinds; of a sensor's files in a folder of its own the inertial one."""
    found = {}
    for path in sorted(folder.iterdir())[:_MOST]:
        with suppress(WearcapError):
            kind = known(path, LOGS)
            if kind is not None and not (kind.name == "watch" and sensor_files(path)[0] != path):
                found[path] = kind
    return found


def is_kit(folder: Path) -> bool:
    """Whether a folder holds the logs of one session: watches', or one headset's."""
    kinds = [kind.name for kind in log_files(folder).values()]
    return "watch" in kinds or kinds.count("headset") == 1


def load_kit(folder: Path, how: Conventions) -> Loaded:
    """The logs of one session in one recording: two watches and a trajectory, or a headset's log.

    What cannot be read, is missing or stands beside is a finding.
    """
    logs, findings = log_files(folder), list[Finding]()
    parts = Recording(name=folder.resolve().name)
    watches = [path for path, kind in logs.items() if kind.name == "watch"]
    sides = _sides(watches, findings)
    for path, kind in logs.items():
        try:
            if kind.name == "watch":
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
            read, found = kind.load(path, how)
            findings += found
            parts = replace(read, name=parts.name, imu=parts.imu)
        except WearcapError as error:
            findings.append(refusal(error, f"log {path.name}"))
    if parts.imu and parts.head is None:
        fix = "Put the head camera's trajectory beside (TUM, EuRoC, COLMAP, hloc, DROID-SLAM)."
        findings.append(Check("kit").error("no path of the head", f"{len(parts.imu)} watches", fix))
    if parts.head is not None:
        for gap in watch_gaps(parts.imu, parts.head.timestamps):
            findings.append(Check("watches").warning("silent for a while", gap))
    return Loaded(parts, findings)


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
