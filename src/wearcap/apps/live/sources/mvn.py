"""Xsens MVN's network stream over UDP: poses as quaternions (type 02) and the wearer's size (type 13).

Datagrams begin with 24 bytes: "MXTP" and the type, sample counter, datagram counter (its highest bit: the sample's last),
number of items, time code (ms), character, numbers of body segments, props and finger segments, reserved, size. MVN's
segments are the joints of `xsens23` (see `io.formats.mvnx`). The stream holds no foot contacts.

Axes, by the "MVN real-time network streaming Protocol Specification" (MV0305P): type 02 is z up and right-handed by default,
"or Y-Up" by a setting of the network streamer (`?up=y`); nothing in a datagram says which. Type 13 is always z up. The
specification names no other axis of type 02 with y up. MVN's right-handed y up of types 01 and 03 is x left, y up, z forward:
Xsens' own reader of these (`Datagram::convertFromYupToZup` and `EulerDatagram` of its network streaming SDK) takes positions
(x, y, z) to (z, x, y), and quaternions (w, x, y, z) to (w, z, x, y). The same is done here. Type 05, "Unity 3D", is
left-handed, has another order of segments, and poses relative to their parents: it is not read.
"""

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.apps.live.packets import HANDS, SUIT, Packet
from wearcap.apps.live.source import Address, DatagramSource, Fault, counted, require
from wearcap.apps.live.sources.parts import UNIT_TOLERANCE
from wearcap.body.hands import HAND_JOINTS
from wearcap.body.kinematics import local_rotations
from wearcap.body.skeleton import Site, Skeleton, xsens23
from wearcap.errors import require_choice
from wearcap.geometry.rotation import matrix_from_quat_wxyz
from wearcap.io.formats.mvnx import BONE_CHANGE_M, JOINT_OF, SITE_OF, bone_offsets, glove_stream, plain_label
from wearcap.recording import Motion
from wearcap.sensors.packets import MAX_POSITION_M, NOT_A_ROTATION, NOT_FINITE, OUT_OF_RANGE
from wearcap.sensors.samples import HandSample, SuitPiece

SEGMENTS = tuple(
    JOINT_OF[name]
    for name in (
        *("pelvis", "l5", "l3", "t12", "t8", "neck", "head"),
        *("rightshoulder", "rightupperarm", "rightforearm", "righthand"),
        *("leftshoulder", "leftupperarm", "leftforearm", "lefthand"),
        *("rightupperleg", "rightlowerleg", "rightfoot", "righttoe"),
        *("leftupperleg", "leftlowerleg", "leftfoot", "lefttoe"),
    )
)
"""Joints of the segments 1…23."""
FINGER_SEGMENTS = ["wrist", *(name for name in HAND_JOINTS[1:] if not name.endswith("_tip"))]
"""Joints of a hand's 20 segments (the SDK's `XsFingerAnimationSegment`: carpus, then each finger's from the thumb on). The left
hand's follow those of body and props, the right hand's the left one's."""
MAX_SEGMENTS = 128
SCALE_WAIT_S = 1.0
"""How long a character's poses wait for its size; without it, the bones are those of a pose."""
MAX_JOINED = 4
"""Samples of a character that may be incomplete at once."""
MAX_POINTS = 256
_HEADER = struct.Struct(">6sIBBIBBBBHH")
_POSE = np.dtype([("id", ">i4"), ("position", ">f4", 3), ("quat_wxyz", ">f4", 4)])
_Y_UP = [2, 0, 1]
"""Which coordinates of a world with y up (x left, z forward) are x, y, z of one with z up."""
_BONES_M = (1.5, 15.0)
"""Sum of all bones' lengths of a small child and of a giant; an adult's is 4.4 m."""

NO_MVN = "no MVN datagram"
OTHER_TYPE = "datagrams of other types"
TRUNCATED = "truncated"
INCOMPLETE = "incomplete sample"
REPEATED = "repeated"
NO_SIZE_YET = "waiting for the size"
NOT_UPRIGHT = "size that is not z up"


@dataclass
class _Sample:
    """What has arrived of one sample."""

    poses: np.ndarray = field(default_factory=lambda: np.zeros(MAX_SEGMENTS, _POSE))
    seen: set[int] = field(default_factory=set)
    """Segments that have arrived, from 0."""
    parts: set[int] = field(default_factory=set)
    """Numbers of the datagrams that have arrived."""
    last: int | None = None
    """Number of the sample's last datagram."""


@dataclass
class _Character:
    """State of one wearer's stream."""

    first_s: float
    samples: dict[int, _Sample] = field(default_factory=dict)
    """By sample counter, the oldest first."""
    newest: int = -1
    """Counter of the newest complete sample."""
    offsets_m: Float[Tensor, "joint 3"] | None = None
    """The wearer's bones by type 13."""
    sites: dict[str, Site] = field(default_factory=dict)
    """The wearer's heels, toe tips, … by type 13."""
    size_metres: float = 1.0
    """Metres per unit of type 13."""
    skeleton: Skeleton | None = None
    """What the poses are given on, once the first is."""


class MvnSource(DatagramSource):
    """Suits that Xsens MVN Analyze or Animate streams; each character is a wearer of their own."""

    scheme, port, hz = "mvn", 9763, 60.0
    convention = (
        "Xsens MVN, types 02 and 13: metres (or centimetres), quaternion w x y z; z up, x forward, y left (up=y: y up)"
    )

    own_options = ("up",)

    def __init__(self, address: Address):
        super().__init__(address)
        self.up = address.options.get("up", "z")
        require_choice(self.up, ("z", "y"), f"up={self.up[:20]}")
        self._characters: dict[int, _Character] = {}
        self._xsens23 = xsens23()
        self._order = [SEGMENTS.index(name) for name in self._xsens23.joint_names]

    def packets(self, data: bytes, arrived_s: float, refuse: Callable[[str], None]) -> Iterator[Packet]:
        require(NO_MVN if len(data) < _HEADER.size or data[:4] != b"MXTP" else None)
        kind, counter, part, items, time_ms, number, _, props, fingers, *_ = _HEADER.unpack_from(data)
        require(None if kind in (b"MXTP02", b"MXTP13") else OTHER_TYPE)
        character = self._characters.setdefault(number, _Character(arrived_s))
        if kind == b"MXTP13":
            self._take_size(character, data[_HEADER.size :], arrived_s)
        elif (sample := self._joined(character, counter, part, data, items)) is not None:
            motion = self._motion(character, sample.poses, time_ms / 1000, arrived_s)
            wearer = self.wearer if number == 0 else f"{self.wearer or 'character'} {number}"
            yield Packet(wearer, SUIT, self.name, time_ms / 1000, arrived_s, SuitPiece(motion))
            for k, device in enumerate(HANDS if fingers == 2 * len(FINGER_SEGMENTS) else ()):
                first = len(SEGMENTS) + props + k * len(FINGER_SEGMENTS)
                with counted(refuse):  # a glove that fails takes no body with it
                    hand = self._hand(sample, first, HANDS[device], time_ms / 1000)
                    yield Packet(wearer, device, self.name, time_ms / 1000, arrived_s, hand)

    def _joined(self, character: _Character, counter: int, part: int, data: bytes, items: int) -> _Sample | None:
        """The sample that a datagram completes, if it does."""
        require(TRUNCATED if len(data) < _HEADER.size + items * _POSE.itemsize else None)
        require(REPEATED if counter == character.newest else None)
        sample = character.samples.setdefault(counter, _Sample())
        poses = np.frombuffer(data, _POSE, items, _HEADER.size)
        body = poses[(poses["id"] >= 1) & (poses["id"] <= MAX_SEGMENTS)]
        sample.poses[body["id"] - 1] = body
        sample.seen.update((body["id"] - 1).tolist())
        sample.parts.add(part & 0x7F)
        if part & 0x80:
            sample.last = part & 0x7F
        if sample.last is None or len(sample.parts) <= sample.last:
            if len(character.samples) > MAX_JOINED:
                del character.samples[next(iter(character.samples))]
                raise Fault(INCOMPLETE)
            return None
        del character.samples[counter]
        require(None if sample.seen >= set(range(len(SEGMENTS))) else INCOMPLETE)
        character.newest = counter
        return sample

    def _hand(self, sample: _Sample, first: int, side: str, time_s: float) -> HandSample:
        """A glove's hand, whose segments begin at a number from 0. Raises Fault for one that is not whole."""
        require(None if sample.seen >= set(range(first, first + len(FINGER_SEGMENTS))) else INCOMPLETE)
        R_world, t_world = self._upright(sample.poses[first : first + len(FINGER_SEGMENTS)])
        at = torch.tensor([time_s], dtype=torch.float64)
        return HandSample(side, time_s, glove_stream(at, FINGER_SEGMENTS, t_world[None], R_world[None]))

    def _upright(self, poses: np.ndarray) -> tuple[Float[Tensor, "segment 3 3"], Float[Tensor, "segment 3"]]:
        """Rotations and positions of segments in a world with z up. Raises Fault for what is none."""
        quat_wxyz = torch.from_numpy(poses["quat_wxyz"].astype(np.float32)).double()
        t_world = torch.from_numpy(poses["position"].astype(np.float32)).double()
        require(None if quat_wxyz.isfinite().all() and t_world.isfinite().all() else NOT_FINITE)
        require(None if ((quat_wxyz.norm(dim=-1) - 1).abs() <= UNIT_TOLERANCE).all() else NOT_A_ROTATION)
        if self.up == "y":  # the segments' own axes are turned like the world's
            quat_wxyz = torch.cat([quat_wxyz[:, :1], quat_wxyz[:, 1:][:, _Y_UP]], -1)
            t_world = t_world[:, _Y_UP]
        return matrix_from_quat_wxyz(quat_wxyz), t_world

    def _motion(self, character: _Character, poses: np.ndarray, time_s: float, arrived_s: float) -> Motion:
        """One frame of motion."""
        R_world, t_world = self._upright(poses[self._order])
        offsets = bone_offsets(self._xsens23, R_world, t_world)
        metres = _metres(offsets)
        t_root = t_world[0] * metres
        require(None if (t_root.abs() <= MAX_POSITION_M).all() else OUT_OF_RANGE)
        if character.skeleton is None:
            require(NO_SIZE_YET if arrived_s - character.first_s < SCALE_WAIT_S else None)
            bones = offsets * metres if character.offsets_m is None else character.offsets_m
            skeleton = self._xsens23.with_offsets(bones.float())
            character.skeleton = replace(skeleton, sites=skeleton.sites | character.sites)
        return Motion(
            torch.tensor([time_s], dtype=torch.float64),
            character.skeleton,
            local_rotations(self._xsens23, R_world).float()[None],
            t_root.float()[None],
            provenance={"source": "Xsens MVN", "format": "mvn"},
        )

    def _take_size(self, character: _Character, payload: bytes, arrived_s: float) -> None:
        """Bones or points of a character. A skeleton stays as it began unless another person's bones arrive."""
        try:
            origins, points = _size(payload)
        except (struct.error, ValueError) as error:
            raise Fault(TRUNCATED) from error
        if origins:
            require(INCOMPLETE if set(SEGMENTS) - set(origins) else None)
            t = torch.tensor([origins[name] for name in self._xsens23.joint_names], dtype=torch.float64)
            spine = t[self._xsens23.index("head")] - t[0]
            require(None if spine[2] > spine[:2].norm() else NOT_UPRIGHT)
            offsets = bone_offsets(self._xsens23, torch.eye(3, dtype=torch.float64).expand(len(t), 3, 3), t)
            metres = _metres(offsets)
            offsets = offsets * metres
            known = character.skeleton.t_parent_joint[1:] if character.skeleton is not None else None
            if known is not None and (known - offsets[1:]).norm(dim=-1).max() > BONE_CHANGE_M:
                character.skeleton, character.first_s, character.sites = None, arrived_s, {}
            character.offsets_m, character.size_metres = offsets, metres
        for segment, label, at in points if character.offsets_m is not None else ():
            if label in SITE_OF and 1 <= segment <= len(SEGMENTS) and max(map(abs, at)) * character.size_metres < 1.0:
                place = tuple(character.size_metres * value for value in at)
                character.sites[SITE_OF[label]] = Site(SEGMENTS[segment - 1], place)


def _metres(offsets: Float[Tensor, "joint 3"]) -> float:
    """Metres per unit of a person's bones, which are given in metres or centimetres. Raises Fault for nobody's bones."""
    total = offsets[1:].norm(dim=-1).sum().item()
    for metres in (1.0, 0.01):
        if _BONES_M[0] < total * metres < _BONES_M[1]:
            return metres
    raise Fault(OUT_OF_RANGE)


def _size(payload: bytes) -> tuple[dict[str, tuple[float, ...]], list[tuple[int, str, tuple[float, ...]]]]:
    """Origins of the segments in a T-pose by joint, and points: segment's number, label, place in the segment.

    Raises ValueError or struct.error for what is truncated or too much.
    """
    origins, points, at = {}, [], 4
    count = struct.unpack_from(">i", payload)[0]
    if not 0 <= count <= MAX_POINTS:
        raise ValueError(f"{count} segments")
    for _ in range(count):
        name, at = _text(payload, at)
        origins[JOINT_OF.get(name, name)] = _finite(struct.unpack_from(">3f", payload, at))
        at += 12
    if at == len(payload):  # without a number of points
        return origins, points
    count = struct.unpack_from(">i", payload, at)[0]
    if not 0 <= count <= MAX_POINTS:
        raise ValueError(f"{count} points")
    at += 4
    for _ in range(count):
        segment = struct.unpack_from(">H", payload, at)[0]
        name, at = _text(payload, at + 4)
        points.append((segment, name, _finite(struct.unpack_from(">3f", payload, at + 4))))
        at += 16
    return origins, points


def _text(payload: bytes, at: int) -> tuple[str, int]:
    """A string and where it ends."""
    size = struct.unpack_from(">i", payload, at)[0]
    if not 0 <= size <= len(payload) - at - 4:
        raise ValueError(f"a string of {size} bytes")
    return plain_label(payload[at + 4 : at + 4 + size].decode("utf-8")), at + 4 + size


def _finite(values: tuple[float, ...]) -> tuple[float, ...]:
    if not all(abs(value) <= MAX_POSITION_M for value in values):
        raise ValueError("not finite")
    return values
