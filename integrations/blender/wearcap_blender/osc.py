"""OSC 1.0 datagrams taken apart in plain Python, bounded in depth, number and size, and frames of the VMC protocol in them."""

import math
import struct

import numpy as np

from .motion_file import Motion, matrices

MAX_DEPTH, MAX_MESSAGES, MAX_ARGUMENTS = 4, 1024, 32
MAX_PLACE_M = 1e4
_NUMBERS = {"i": ">i", "f": ">f", "d": ">d", "h": ">q"}
UNITY = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Unity's left-handed axes (x right, y up, z forward) in ours (x forward, y left, z up)."""
PARENTS = {
    "Hips": "", "Spine": "Hips", "Chest": "Spine", "UpperChest": "Chest", "Neck": "UpperChest", "Head": "Neck",
    **{f"{side}{bone}": parent if parent in ("Hips", "UpperChest") else f"{side}{parent}"
       for side in ("Left", "Right") for bone, parent in (
           ("Shoulder", "UpperChest"), ("UpperArm", "Shoulder"), ("LowerArm", "UpperArm"), ("Hand", "LowerArm"),
           ("UpperLeg", "Hips"), ("LowerLeg", "UpperLeg"), ("Foot", "LowerLeg"), ("Toes", "Foot"))},
    **{f"{side}{finger}{bone}": f"{side}{parent.format(finger)}" for side in ("Left", "Right")
       for finger in ("Thumb", "Index", "Middle", "Ring", "Little")
       for bone, parent in (("Proximal", "Hand"), ("Intermediate", "{}Proximal"), ("Distal", "{}Intermediate"))},
}  # fmt: skip
"""Unity's humanoid bones with their parents, which come first; eyes and the jaw are passed over."""
ROOT, STILL = "", np.array([0.0, 0, 0, 0, 0, 0, 1])
"""Key of the root's pose, in which the hips lie, among those of bones; and that pose unless it is sent."""


def messages(data):
    """(address, arguments) of the messages in a datagram. Raises ValueError or struct.error for what is no OSC, or too much."""
    found, parts = [], [(0, len(data), 0)]
    while parts:
        start, stop, depth = parts.pop(0)
        if data[start : start + 8] == b"#bundle\0":
            if depth >= MAX_DEPTH:
                raise ValueError("bundles nested too deeply")
            at = start + 16
            while at < stop:
                (size,) = struct.unpack_from(">i", data, at) if at + 4 <= stop else (-1,)
                if not 0 < size <= stop - at - 4:
                    raise ValueError("no OSC")
                parts.append((at + 4, at + 4 + size, depth + 1))
                at += 4 + size
            if len(parts) + len(found) > MAX_MESSAGES:
                raise ValueError("too many messages")
        elif data[start : start + 1] == b"/":
            found.append(_message(data[start:stop]))
        else:
            raise ValueError("no OSC")
    return found


def _message(data):
    """Address and arguments of one message; an argument of another type ends them."""

    def text(at):
        end = data.find(b"\0", at)
        if end < 0:
            raise ValueError("a text without an end")
        return data[at:end].decode("utf-8"), end // 4 * 4 + 4

    address, at = text(0)
    tags, at = text(at) if at < len(data) else (",", at)
    values = []
    for tag in tags[1 : 1 + MAX_ARGUMENTS]:
        if tag == "s":
            value, at = text(at)
        elif tag in _NUMBERS:
            (value,) = struct.unpack_from(_NUMBERS[tag], data, at)
            at += struct.calcsize(_NUMBERS[tag])
        else:
            break
        values.append(value)
    return address, values


class Frames:
    """Frames of the VMC protocol: datagrams in, poses of all bones out; a frame may come in one datagram or in several."""

    def __init__(self):
        self.poses = {}
        self.time_s = None
        self.refused = 0

    def take(self, data, arrived_s):
        """The frame (time, places, quaternions x y z w) that a datagram completes; None where it completes none."""
        seen = False
        try:
            for address, values in messages(data):
                if address == "/VMC/Ext/T" and values and isinstance(values[0], float) and math.isfinite(values[0]):
                    self.time_s = values[0]
                elif address in ("/VMC/Ext/Bone/Pos", "/VMC/Ext/Root/Pos") and len(values) >= 8:
                    bone = ROOT if address == "/VMC/Ext/Root/Pos" else values[0]
                    numbers = np.array(values[1:8], np.float64)
                    sound = np.isfinite(numbers).all() and np.abs(numbers).max() < MAX_PLACE_M
                    if sound and np.linalg.norm(numbers[3:]) > 0.5 and (bone == ROOT or bone in PARENTS):
                        self.poses[bone] = numbers
                        seen |= bone != ROOT
        except (ValueError, TypeError, struct.error):
            self.refused += 1
            return None
        if not seen or "Hips" not in self.poses:
            return None
        return (arrived_s if self.time_s is None else self.time_s), dict(self.poses)


def motion_of(frames):
    """A motion of frames, with the bones of the first one that they all have; lengths are the first frame's."""
    names = [name for name in PARENTS if all(name in poses for _, poses in frames)]
    parents = []
    for name in names:
        above = PARENTS[name]
        while above and above not in names:
            above = PARENTS[above]
        parents.append(names.index(above) if above else -1)
    values = np.array([[poses.get(name, STILL) for name in [ROOT, *names]] for _, poses in frames])
    t = values[..., :3] @ UNITY.T
    R = UNITY @ matrices(values[..., 3:]) @ UNITY.T
    t_hips = t[:, 0] + (R[:, 0] @ t[:, 1, :, None])[..., 0]
    R[:, 1] = R[:, 0] @ R[:, 1]
    offsets = t[0, 1:].copy()
    offsets[0] = 0
    return Motion(
        names, parents, offsets, np.array([time for time, _ in frames]), R[:, 1:], t_hips, shifts=t[:, 1:] - offsets
    )
