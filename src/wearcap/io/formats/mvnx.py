"""Xsens MVNX: the suit's pose, foot contacts and sensors, as MVN exports them.

MVN's segment frames are parallel to the world (x forward, y left, z up) in the T-pose, as those of `xsens23` are, and a
segment's position is its joint's, so orientations are taken as they are. Files of takes with gloves list the segments of each
hand (`fingerTrackingSegmentsLeft`), "LeftSecondProximalPhalange" or "LeftSecondPP" for the index finger's first bone.
"""

import io
import warnings
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import torch
from defusedxml.ElementTree import iterparse
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.body.hands import FINGER_NAMES, HAND_JOINTS, in_layout
from wearcap.body.kinematics import local_rotations
from wearcap.body.skeleton import FOOT_PATCHES, SIDES, Site, Skeleton, xsens23
from wearcap.boundary.limits import LIMITS
from wearcap.boundary.opening import open_bytes, understood
from wearcap.boundary.texts import finite_floats, plain_xml, tag_of
from wearcap.errors import WearcapError
from wearcap.geometry.rotation import matrix_from_quat_wxyz
from wearcap.recording import FingerStream, ImuStream, Motion, Recording

_LIMITS = LIMITS["mvnx"]
_CHUNK = 1 << 16
_MAX_NUMBER = 64
"""Most characters of a number."""

_SIDED = {
    "shoulder": "collar",
    "upperarm": "shoulder",
    "forearm": "elbow",
    "hand": "wrist",
    "upperleg": "hip",
    "lowerleg": "knee",
    "foot": "ankle",
    "toe": "toe",
}
JOINT_OF = {name: name for name in ("pelvis", "l5", "l3", "t12", "t8", "neck", "head")} | {
    side + segment: f"{side}_{joint}" for side in ("left", "right") for segment, joint in _SIDED.items()
}
"""Segment or sensor label (lower case, no spaces) to joint."""
_LABEL_OF = {joint: label for label, joint in JOINT_OF.items()}

SITE_OF = {"ptopofhead": "crown"} | {
    f"p{side}{point}": f"{side}_{site}"
    for side in ("left", "right")
    for point, site in (("heelfoot", "heel"), ("toe", "toe_tip"), ("topofhand", "fingertip"))
}
"""Anatomical points of the segments that are wearcap's sites."""

_PHALANGES = {
    "mc": "metacarpal", "metacarpal": "metacarpal", "pp": "proximal", "proximalphalange": "proximal",
    "mp": "intermediate", "middlephalange": "intermediate", "dp": "distal", "distalphalange": "distal",
}  # fmt: skip
FINGER_OF = {"carpus": "wrist"} | {
    number + segment: joint
    for number, finger in zip(("first", "second", "third", "fourth", "fifth"), FINGER_NAMES)
    for segment, bone in _PHALANGES.items()
    if (joint := f"{finger}_{bone}") in HAND_JOINTS
}
"""A hand's segment, without its side, to the joint at its start."""

_FIELDS = {
    "orientation": ("segments", 4),
    "position": ("segments", 3),
    "footContacts": ("contacts", 1),
    "sensorFreeAcceleration": ("sensors", 3),
    "sensorOrientation": ("sensors", 4),
    **{f"orientationFingers{side.title()}": (side, 4) for side in SIDES},
    **{f"positionFingers{side.title()}": (side, 3) for side in SIDES},
}
"""Fields of each frame: the list of items that a field covers, and the number of values per item."""

_REST_TYPES = ("identity", "tpose")
BONE_CHANGE_M = 0.02


@dataclass
class _File:
    """Content read so far."""

    path: Path
    fps: float = 0.0
    segments: list[str] = field(default_factory=list)
    points: dict[str, tuple[str, list[float]]] = field(default_factory=dict)
    """Label of an anatomical point: its segment, and its position in it (m)."""
    sensors: list[str] = field(default_factory=list)
    contacts: list[str] = field(default_factory=list)
    fingers: dict[str, list[str]] = field(default_factory=lambda: {side: [] for side in SIDES})
    """Segments of each hand."""
    hand: str = ""
    """Side of the hand whose segments are being read."""
    rest: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)
    """Fields of the identity and T-pose frames."""
    index: list[int] = field(default_factory=list)
    time_ms: list[float] = field(default_factory=list)
    frames: dict[str, list[np.ndarray]] = field(default_factory=lambda: {name: [] for name in _FIELDS})

    def take(self, element: Element) -> None:
        """Add one element. Raises ValueError or LookupError for what cannot be understood."""
        name = tag_of(element)
        if name == "subject":
            self.fps = float(finite_floats([element.get("frameRate", "")])[0])
            if not 0 < self.fps < 1e5:
                raise ValueError(f"a frame rate of {self.fps} Hz")
        elif name == "segment":
            label = plain_label(element.attrib["label"])
            (self.fingers[self.hand] if self.hand else self.segments).append(label)
            for point in (child for child in element.iter() if tag_of(child) == "point"):
                text = next((child.text or "" for child in point if tag_of(child) == "pos_b"), "")
                self.points[plain_label(point.attrib["label"])] = (label, finite_floats(text.split()).tolist())
        elif name == "frame":
            try:
                self.take_frame(element)
            except ValueError as error:
                label = f"{element.get('type', 'normal')} frame {element.get('index', '')}".strip()
                raise ValueError(f"{label}: {error}") from error
        else:
            items = self.sensors if name == "sensor" else self.contacts
            items.append(plain_label(element.attrib["label"]))

    def take_frame(self, element: Element) -> None:
        kind = element.get("type", "normal")
        if kind not in (*_REST_TYPES, "normal"):
            return
        self.require_segments()
        texts = {name: child.text or "" for child in element if (name := tag_of(child)) in _FIELDS}
        values = {name: self.numbers(name, text) for name, text in texts.items()}
        if kind in _REST_TYPES:
            self.rest[kind] = values
            return
        present = {name for name, column in self.frames.items() if column} if self.index else set(values)
        if set(values) != present or not {"orientation", "position"} <= present:
            needed = sorted(present | {"orientation", "position"})
            raise ValueError(f"a frame with {sorted(values)} where {needed} belong")
        self.index.append(int(element.get("index") or len(self.index)))
        self.time_ms.append(float(element.get("time") or "nan"))
        for name, found in values.items():
            self.frames[name].append(found.astype(np.float32) if name != "position" else found)

    def require_segments(self) -> None:
        if missing := sorted(set(JOINT_OF) - set(self.segments)):
            raise WearcapError(f"segments {missing[:5]} are missing", self.path, "the 23 segments of a full-body suit")

    def numbers(self, name: str, text: str) -> np.ndarray:
        """The numbers of one of a frame's fields."""
        listing, width = _FIELDS[name]
        items = self.fingers[listing] if listing in self.fingers else getattr(self, listing)
        count = width * (len(items) or len(FOOT_PATCHES) * (listing == "contacts"))
        if len(text) > 1000 + _MAX_NUMBER * count:
            raise ValueError(f"{name} with {len(text)} characters where {count} numbers belong")
        found = finite_floats(text.split())
        if len(found) != count:
            raise ValueError(f"{name} with {len(found)} values where {count} belong")
        return found

    def column(self, name: str, width: int) -> Tensor:
        """All frames of a field, "time item feature"."""
        return torch.from_numpy(np.stack(self.frames[name])).unflatten(1, (-1, width))


def read_mvnx(path: str | Path) -> Recording:
    """Read an .mvnx file (plain, .gz or .xz): `motion` (xsens23 with the wearer's bones, contacts in FOOT_PATCHES order)
    and the sensors as `imu` streams named by their joint.

    Raises WearcapError naming file and line or frame for damaged XML, document types and entities, missing segments,
    wrong counts, NaN, and quaternions that are not of unit length. Warns when bones change length; `note` says where
    frame times contradict the rate.
    """
    file = _File(Path(path))
    with (
        understood("cannot be understood", path, "MVNX", errors=(ValueError, LookupError)),
        plain_xml(path, "MVNX file as MVN exports it"),
        open_bytes(path, "mvnx") as source,
    ):
        chunks, frames, kept = _Chunks(source), None, 0
        for event, element in iterparse(chunks, events=("start", "end"), forbid_dtd=True):
            chunks.restart()
            name = tag_of(element)
            kept += event == "start"
            if kept > _LIMITS.items:
                raise ValueError(f"more than {_LIMITS.items} elements beside its frames")
            if name.startswith("fingerTrackingSegments"):
                file.hand = name[22:].lower() if event == "start" and name[22:].lower() in SIDES else ""
            elif event == "start" and name == "frames":
                frames = element
            elif (event == "start" and name == "subject") or (
                event == "end" and name in ("segment", "sensor", "contactDefinition", "frame")
            ):
                file.take(element)
                if name == "frame" and frames is not None:  # forgotten once it is used, so that memory stays flat
                    frames.clear()
                    kept = 0
    return _recording(file)


class _Chunks:
    """Read sizes that double until an element begins or ends: expat rescans a long tag or comment with every read."""

    def __init__(self, source: io.BufferedReader):
        self._source, self._size = source, _CHUNK

    def read(self, _size: int) -> bytes:
        content = self._source.read(self._size)
        self._size *= 2
        if self._size > _LIMITS.line:
            raise ValueError(f"{_LIMITS.line} bytes without an element")
        return content

    def restart(self) -> None:
        self._size = _CHUNK


def plain_label(label: str) -> str:
    """A label as `JOINT_OF` and `SITE_OF` have it."""
    return label.replace(" ", "").replace("_", "").lower()


def _recording(file: _File) -> Recording:
    file.require_segments()
    if not file.fps:
        raise WearcapError("no subject with a frame rate", file.path, '<subject frameRate="60">')
    if not file.index:
        raise WearcapError("no frames of motion", file.path, 'frames of type "normal"')
    timestamps, note = _timestamps(file)
    skeleton, rows = xsens23(), [file.segments.index(_LABEL_OF[name]) for name in xsens23().joint_names]
    R_world = matrix_from_quat_wxyz(_quaternions(file, "orientation"))[:, rows].double()
    t_world = file.column("position", 3)[:, rows]
    skeleton = _fitted(file, skeleton, rows, R_world, t_world)
    contacts = file.column("footContacts", 1)[..., 0] if file.frames["footContacts"] else None
    if contacts is not None and file.contacts:  # without definitions they are in the order of FOOT_PATCHES already
        columns = []
        for patch in FOOT_PATCHES:
            side, part = patch.split("_")[:2]
            found = [k for k, label in enumerate(file.contacts) if side in label and part in label]
            if len(found) != 1:
                raise WearcapError(f"foot contacts {file.contacts}", file.path, "heel and toe of both feet")
            columns += found
        contacts = contacts[:, columns]
    motion = Motion(
        timestamps,
        skeleton,
        local_rotations(skeleton, R_world).float(),
        t_world[:, 0].float(),
        contact_prob=contacts,
        provenance={"source": file.path.name, "format": "mvnx"},
    )
    # One stream per sensor on a known segment, with free acceleration (m/s², world) and orientation
    parts: dict[str, Any] = {}
    if file.frames["sensorFreeAcceleration"]:
        parts["acc_world"] = file.column("sensorFreeAcceleration", 3)
    if file.frames["sensorOrientation"]:
        parts["R_world_imu"] = matrix_from_quat_wxyz(_quaternions(file, "sensorOrientation"))
    known = [(k, JOINT_OF[label]) for k, label in enumerate(file.sensors if parts else []) if label in JOINT_OF]
    imu = {
        joint: ImuStream(timestamps, joint, **{name: part[:, k].contiguous() for name, part in parts.items()})
        for k, joint in known
    }
    name = file.path.name.split(".")[0]
    fingers = {side: hand for side in SIDES if (hand := _fingers(file, side, timestamps)) is not None}
    return Recording(name, motion=motion, skeleton=skeleton, imu=imu, fingers=fingers, source="Xsens MVNX", note=note)


def _fingers(file: _File, side: str, timestamps: Float64[Tensor, "time"]) -> FingerStream | None:
    """A hand that a glove tracks; None without one."""
    position, orientation = f"positionFingers{side.title()}", f"orientationFingers{side.title()}"
    if not (file.frames[position] and file.frames[orientation]):
        return None
    joints = [FINGER_OF.get(label.removeprefix(side), "") for label in file.fingers[side]]
    points, R = file.column(position, 3), matrix_from_quat_wxyz(_quaternions(file, orientation))
    return glove_stream(timestamps, joints, points, R)


def glove_stream(
    timestamps: Float64[Tensor, "time"],
    joints: list[str],
    points: Float[Tensor, "time segment 3"],
    R: Float[Tensor, "time segment 3 3"],
) -> FingerStream:
    """A tracked hand of a glove's segments, each by the joint at its start ("": none)."""
    rotations = torch.stack([in_layout(column, joints) for column in R.float().unbind(-1)], -1)
    valid = torch.ones(len(timestamps), dtype=torch.bool)
    return FingerStream(timestamps, in_layout(points.float(), joints), valid, valid.float(), rotations)


def _timestamps(file: _File) -> tuple[Float64[Tensor, "time"], str]:
    """Timestamps (s), and a note where frame times contradict the stated rate: then the times win.

    Otherwise they come from the frame numbers, which unlike the times are not rounded to milliseconds.
    """
    index = torch.tensor(file.index, dtype=torch.float64)
    if not (index.diff() > 0).all():
        raise WearcapError("frame numbers repeat or fall", file.path, "rising `index`")
    index, times = index - index[0], torch.tensor(file.time_ms, dtype=torch.float64) / 1000
    times, by_rate = times - times[0], index / file.fps
    span_s = times[-1].item()
    if not abs(span_s - by_rate[-1].item()) > 0.01 * span_s + 0.05:  # also where a time is missing
        return by_rate, ""
    stated = f"{len(index)} frames at its stated {file.fps:g} Hz span {by_rate[-1]:.3f} s"
    rate = index[-1].item() / span_s if span_s > 0 else 0.0
    if not (1 <= rate <= 2000 and (times.diff() > 0).all()):
        return (
            by_rate,
            f"{stated}; its frame times, which span {span_s:.4g} s, are no rising milliseconds and are ignored.",
        )
    if (index / rate - times).abs().max() < 0.002:  # even, but for their rounding: as is the rate
        rate = round(rate) if abs(rate - round(rate)) <= rate * 0.001 / span_s else rate
        times = index / rate
    return times, f"{stated}, but its frame times {span_s:.3f} s: the times are believed, {rate:.4g} Hz."


def _quaternions(file: _File, name: str) -> Float[Tensor, "time segment 4"]:
    quat_wxyz = file.column(name, 4)
    wrong = ((quat_wxyz.norm(dim=-1) - 1).abs() > 0.02).nonzero()
    if len(wrong):
        frame, element = wrong[0].tolist()
        what = f"{name} {element} is no unit quaternion"
        raise WearcapError(what, f"{file.path}, frame {file.index[frame]}", "w x y z of length 1")
    return quat_wxyz


def bone_offsets(
    skeleton: Skeleton, R_world: Float[Tensor, "*batch joint 3 3"], t_world: Float[Tensor, "*batch joint 3"]
) -> Float[Tensor, "*batch joint 3"]:
    """Each joint's position in its parent's frame (m); the root's is zero."""
    parents = [max(parent, 0) for parent in skeleton.parents]
    return (R_world[..., parents, :, :].mT @ (t_world - t_world[..., parents, :])[..., None])[..., 0]


def _fitted(
    file: _File,
    skeleton: Skeleton,
    rows: list[int],
    R_world: Float[Tensor, "time joint 3 3"],
    t_world: Float[Tensor, "time joint 3"],
) -> Skeleton:
    """The wearer's bones: from the identity or T-pose frame, else from the median over the motion."""
    moving = bone_offsets(skeleton, R_world, t_world)
    offsets = moving.median(0).values
    for kind in reversed(_REST_TYPES):
        if {"orientation", "position"} <= set(file.rest.get(kind, {})):
            R = matrix_from_quat_wxyz(torch.from_numpy(file.rest[kind]["orientation"]).unflatten(0, (-1, 4)))[rows]
            offsets = bone_offsets(
                skeleton, R, torch.from_numpy(file.rest[kind]["position"]).unflatten(0, (-1, 3))[rows]
            )
    change = (moving - offsets).norm(dim=-1).amax(0)
    if change.max() > BONE_CHANGE_M:
        worst = skeleton.joint_names[int(change.argmax())]
        warnings.warn(
            f"{file.path}: {worst!r} is up to {change.max():.3f} m away from where the wearer's bones put it",
            stacklevel=4,
        )
    fitted = skeleton.with_offsets(offsets.float())
    points = {
        SITE_OF[label]: Site(JOINT_OF[segment], tuple(at))
        for label, (segment, at) in file.points.items()
        if label in SITE_OF and segment in JOINT_OF and len(at) == 3
    }
    return replace(fitted, sites=fitted.sites | points)
