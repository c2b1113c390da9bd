"""Examine one recording, or everything in a path: data sets, files, MPS folders, scenes, environments, motion capture."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Float64
from torch import Tensor

from wearcap.body.skeleton import xsens23
from wearcap.boundary.arrays import read_npz
from wearcap.boundary.texts import read_json_object
from wearcap.doctor.agreement import (
    check_camera,
    check_claps,
    check_files,
    check_head_against_body,
    check_head_cue,
    check_imu,
    check_localization,
    check_points,
)
from wearcap.doctor.body import check_contact_prob, check_motion
from wearcap.doctor.logs import as_head, is_kit, log_files, read_kit, read_table
from wearcap.doctor.places import is_map, is_place, read_environment_file, read_map, read_place
from wearcap.doctor.report import SEVERITIES, Check, Finding, Report, has_error, refusal
from wearcap.doctor.streams import check_clock, check_spans, check_track
from wearcap.errors import WearcapError
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.datasets.adt import is_adt, read_adt
from wearcap.io.datasets.amass import read_amass
from wearcap.io.datasets.hps import hps_names, read_hps_sequence
from wearcap.io.datasets.nymeria import is_nymeria, read_nymeria, read_xdata
from wearcap.io.datasets.totalcapture import is_totalcapture, read_totalcapture, totalcapture_files
from wearcap.io.devices.aria_mps import find_mps_file, is_mps_folder, read_closed_loop, read_mps
from wearcap.io.devices.headset_log import is_headset_log
from wearcap.io.formats.motion_npz import read_motion
from wearcap.io.formats.mvnx import read_mvnx
from wearcap.io.formats.pcd import read_pcd
from wearcap.io.formats.ply import read_ply
from wearcap.io.formats.trajectory import read_trajectory_file, trajectory_file
from wearcap.prepare.foreign import read_foreign_motion
from wearcap.recording import FloorTrack, HeadStream, Motion, PointCloud, Recording, RecordingStore
from wearcap.recording.store import RecordingFile
from wearcap.scene.floor import estimate_floor
from wearcap.tracking.stature import estimate_stature

UNUSUAL_M = 0.10
"""Difference of heights beyond which a wearer's body is doubtful."""


def examine(
    source: Recording | str | Path,
    progress: Callable[[int, int], None] | None = None,
    preflight: Callable[[Recording, Path | None], list[Finding]] | None = None,
) -> Report:
    """Examine a recording, or all in a data set, recording file, MPS folder, motion capture file or folder of them.

    Unreadable files are errors in the report; `progress(done, all)` is called after each recording. `preflight` adds
    findings on a recording and the folder of its files.
    Raises WearcapError when there is nothing to examine.
    """
    if isinstance(source, Recording):
        return Report(source.name, {source.name: tuple(examine_recording(source))})
    found = _patients(Path(source))
    findings: dict[str, tuple[Finding, ...]] = {}
    for done, (name, load) in enumerate(found.items(), 1):
        try:
            recording, read = load()
        except WearcapError as error:
            findings[name] = (refusal(error),)
        else:
            if preflight is not None:
                read = [*read, *preflight(recording, _folder_of(Path(source)))]
            only_read = read and recording.points is None and not _clocks(recording)  # with the reader's errors
            findings[name] = tuple(read if only_read else [*read, *examine_recording(recording)])
        if progress:
            progress(done, len(found))
    return Report(str(source), findings)


def examine_recording(recording: Recording) -> list[Finding]:
    """All findings of one recording, the worst first."""
    clocks = _clocks(recording)
    if not clocks and recording.points is None:
        return [Check("recording").error("is empty", "", "It holds no stream.")]
    if not clocks:
        return check_points(recording.points, None)
    findings = [finding for name, times in clocks.items() for finding in check_clock(name, times)]
    broken = {f.check.split(":")[0] for f in findings if f.severity == "error" and f.what != "dropped frames"}
    usable = {name for name, times in clocks.items() if name not in broken and len(times) > 1}
    findings += check_spans({name: times for name, times in clocks.items() if name in usable})
    # Each usable stream, then pairs of streams; streams with errors are not compared.
    head = recording.head if "head" in usable else None
    on_head: list[Finding] = []
    if head is not None:
        on_head = check_track("head", Trajectory(head.timestamps, head.R_world_device, head.t_world_device))
    tracked = None if has_error(on_head) else head
    floor = recording.floor
    if floor is None and recording.points is not None and tracked is not None:
        with suppress(WearcapError):
            below = estimate_floor(recording.points.points_world, tracked.t_world_device)
            floor = FloorTrack(tracked.timestamps, below.height) if below.confidence.median() > 0.3 else None
    bodies = {}
    for name, motion in (("motion", recording.motion), ("suit", recording.suit)):
        if motion is not None and name in usable:
            found = [*check_motion(name, motion, floor), *check_contact_prob(name, motion)]
            findings += found
            if not has_error(found):
                bodies[name] = motion
    body = bodies.get("motion", bodies.get("suit"))
    if head is not None and body is not None and has_error(on_head):
        on_head = _explained_by(body, head, on_head)
    findings += on_head
    head = None if has_error(on_head) else head
    if head is not None and body is not None:
        findings += check_head_against_body(head, body)
    if head is not None:
        findings += _check_height(recording)
    if head is not None and "head" in recording.cues:
        findings.append(check_head_cue(head, recording.cues["head"]))
    for name, imu in recording.imu.items():
        if f"imu {name}" in usable:
            path = None
            if body is not None and imu.joint in body.skeleton:
                T, times = body.joint(imu.joint), body.timestamps
                path = Trajectory(times, T.R, T.t)
            elif head is not None and imu.joint == "head":
                path = Trajectory(head.timestamps, head.T_world_head.R, head.T_world_head.t)
            findings += check_imu(f"imu {name}", imu, path)
    if recording.points is not None:
        findings += check_points(recording.points, head)
    if recording.camera is not None:
        findings += check_camera(recording.camera)
    if recording.localization is not None and "localization" in usable:
        findings += check_localization(recording.localization, bodies.get("suit", body))
    findings += check_claps(recording)
    return sorted(findings, key=lambda finding: -SEVERITIES.index(finding.severity))


def _check_height(recording: Recording) -> list[Finding]:
    """The wearer's height as the head's height over a known floor tells it, against that of the skeleton, if there is one."""
    own = recording.skeleton or (None if recording.motion is None else recording.motion.skeleton)
    found, check = estimate_stature(recording, own or xsens23()), Check("height")
    if found is None:
        return []
    if own is None:
        fix = "Give height=… (m) where it is known better."
        return [check.note(str(found), "no skeleton in the recording", fix)]
    evidence = f"{found}; the skeleton is {own.stature:.2f} m tall"
    if abs(found.height_m - own.stature) > UNUSUAL_M:
        return [
            check.warning(
                "the body does not fit how high the head is carried", evidence, f"Give height={found.height_m:.2f}."
            )
        ]
    return [check.ok("the body fits how high the head is carried", evidence)]


def _explained_by(body: Motion, head: HeadStream, findings: list[Finding]) -> list[Finding]:
    """Findings of a head that is not upright, no errors where it rides on a sound body that bends down or lies."""
    if any(f.severity in ("error", "warning") for f in check_head_against_body(head, body)):
        return findings
    fix = "Its wearer bends down or lies, as the body does."
    return [
        replace(f, severity="warning", fix=fix) if f.severity == "error" and f.check == "head: up axis" else f
        for f in findings
    ]


def require_sound(recording: Recording) -> None:
    """Raise WearcapError with the first of a recording's errors."""
    for finding in examine_recording(recording):
        if finding.severity == "error":
            fix = f"{finding.fix} check=false writes it as it is.".strip()
            raise WearcapError(f"the doctor finds, {finding.check}: {finding.what} ({finding.evidence})", fix=fix)


def _clocks(recording: Recording) -> dict[str, Float64[Tensor, "_"]]:
    streams = {name: getattr(recording, name) for name in ("head", "motion", "suit", "camera", "localization")}
    streams |= {f"imu {name}": imu for name, imu in recording.imu.items()}
    return {name: stream.timestamps for name, stream in streams.items() if stream is not None}


Loaded = tuple[Recording, list[Finding]]


def _patients(path: Path) -> dict[str, Callable[[], Loaded]]:
    """What loads each recording in a path, by name; it returns the reader's findings, too (of a file's raw clock, say).

    Raises WearcapError when there is nothing to examine.
    """
    if not path.exists() and (path.parent / "manifest.json").is_file():
        store = RecordingStore.open(path.parent)
        store.require(path.name)
        return {path.name: partial(_read_stored, store, path.name)}
    if not path.exists():
        raise WearcapError("no such file or folder", where=path)
    if path.is_file():
        if _kind(path) is None:
            raise WearcapError("a kind of file that the doctor does not know", where=path, expected=", ".join(_READERS))
        return {path.name: partial(_read_file, path)}
    if (path / "manifest.json").is_file():
        store = RecordingStore.open(path)
        return {name: partial(_read_stored, store, name) for name in store.names()}
    for is_kind, read in (*_FOLDERS, (is_kit, read_kit), (trajectory_file, _read_trajectory)):
        if is_kind(path):
            return {path.resolve().name: partial(read, path)}
    if names := hps_names(path):
        return {name: partial(_read_hps, path, name) for name in names}
    files = [file for file in sorted(path.rglob("*")) if file.is_file() and _kind(file) in _MOTIONS]
    files = files or list(log_files(path))
    if not files:
        raise WearcapError(
            "nothing to examine here",
            where=path,
            expected=f"a data set (manifest.json), an MPS, Nymeria, ADT, TotalCapture or HPS folder, a scene (pointcloud.ply, photos.json), an environment (environment.json), logs of watches, headsets or trajectories, or files like {', '.join(_MOTIONS)}",
        )
    return {file.relative_to(path).as_posix(): partial(_read_file, file) for file in files}


def _kind(path: Path) -> str | None:
    """Suffix that determines a file's format, without compression."""
    suffixes = [suffix.lower() for suffix in path.suffixes if suffix.lower() not in (".gz", ".xz")]
    return suffixes[-1] if suffixes and suffixes[-1] in _READERS else None


def _read_file(path: Path) -> Loaded:
    content = _READERS[_kind(path) or ""](path)
    name = path.name
    if isinstance(content, tuple):
        return content
    if isinstance(content, Recording):
        return content, []
    if isinstance(content, Motion):
        return Recording(name=name, motion=content, skeleton=content.skeleton), []
    return Recording(name=name, points=PointCloud(torch.from_numpy(content.points))), []


def _read_stored(store: RecordingStore, name: str) -> Loaded:
    """A recording of a data set, with its bytes rehashed."""
    store.verify_one(name)
    recording = store.load(name)
    return recording, check_files(recording, store.root)


def _read_hps(root: Path, name: str) -> Loaded:
    recording = read_hps_sequence(root, name)
    return recording, check_files(recording, root)


def _read_mps(folder: Path) -> Loaded:
    """An MPS folder at 60 Hz, with findings about the raw file's clock, its quality score and the service's own report."""
    path = find_mps_file(folder, ("closed_loop_trajectory.csv",))
    assert path is not None, "is_mps_folder has seen it"
    track, scores = read_closed_loop(path)
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
    check, path = Check("MPS summary"), find_mps_file(folder, ("summary.json",))
    if path is None:
        return recording, findings
    try:
        parts = read_json_object(path)
    except WearcapError as error:
        return recording, [*findings, check.warning("cannot be read", str(error))]
    states = {name: part.get("status", "SUCCESS") for name, part in parts.items() if isinstance(part, dict)}
    failed = [name for name, state in states.items() if state != "SUCCESS"]
    if failed:
        return recording, [*findings, check.error("MPS reports failures", ", ".join(failed), "Request MPS again.")]
    services = ", ".join(name for name in parts if name != "version")
    return recording, [*findings, check.ok("MPS reports success", services)]


def _read_foreign(path: Path) -> Loaded:
    """A motion file of any origin, with what was detected."""
    found = read_foreign_motion(path)
    recording = Recording(name=path.name, motion=found.motion, skeleton=found.motion.skeleton)
    return recording, [Check("file").ok("a body was found", " ".join(found.report.lines()))]


def _read_trajectory(path: Path) -> Loaded:
    """A trajectory of any format, also a folder of COLMAP's or DROID-SLAM's."""
    return as_head(read_trajectory_file(path), path.resolve().name)


def _read_json(path: Path) -> Loaded:
    return read_table(path) if is_headset_log(path) else read_environment_file(path)


def _folder_of(path: Path) -> Path | None:
    """Folder of the files that recordings at a path name: that of their data set."""
    if path.is_dir():
        return path
    return path.parent if path.parent.is_dir() else None


def _read_npz(path: Path) -> Recording | Motion | Loaded:
    """A wearcap motion, Nymeria's suit data, an AMASS file, or DROID-SLAM's poses, recognised by its arrays."""
    if path.name == "xdata.npz":
        return read_xdata(path)[0]
    if read_npz(path, ("traj_est", "tstamps", "tstamp")):
        return _read_trajectory(path)
    return read_motion(path) if read_npz(path, ("wearcap",)) else read_amass(path)


def _totalcapture(folder: Path) -> Recording:
    """A sequence in Vicon's skeleton; where the sensors are mounted is not known."""
    read = read_totalcapture(totalcapture_files(folder)[0])
    return Recording(folder.name, motion=read.motion, imu=read.imu, source="TotalCapture")


_FOLDERS: tuple[tuple[Callable[[Path], bool], Callable[[Path], Loaded]], ...] = (
    (is_nymeria, lambda folder: (read_nymeria(folder), [])),
    (is_mps_folder, _read_mps),
    (is_adt, lambda folder: (read_adt(folder), [])),
    (is_totalcapture, lambda folder: (_totalcapture(folder), [])),
    (is_place, read_place),
)
_MOTIONS = {".amc": _read_foreign, ".bvh": _read_foreign, ".mvnx": read_mvnx, ".npz": _read_npz}
_READERS: dict[str, Callable] = {
    **_MOTIONS,
    ".safetensors": lambda path: read_map(path) if is_map(path) else RecordingFile(path).load(),
    ".csv": read_table,
    ".txt": read_table,
    ".tum": read_table,
    ".log": read_table,
    ".jsonl": read_table,
    ".npy": _read_trajectory,
    ".bin": _read_trajectory,
    ".ply": read_ply,
    ".pcd": read_pcd,
    ".json": _read_json,
}
