"""Datagrams of Xsens MVN's network stream, written by hand after its protocol specification."""

import struct

import numpy as np
from scipy.spatial.transform import Rotation

BODY = (
    *("Pelvis", "L5", "L3", "T12", "T8", "Neck", "Head"),
    *("Right Shoulder", "Right Upper Arm", "Right Forearm", "Right Hand"),
    *("Left Shoulder", "Left Upper Arm", "Left Forearm", "Left Hand"),
    *("Right Upper Leg", "Right Lower Leg", "Right Foot", "Right Toe"),
    *("Left Upper Leg", "Left Lower Leg", "Left Foot", "Left Toe"),
)
PARENT = (-1, 0, 1, 2, 3, 4, 5, 4, 7, 8, 9, 4, 11, 12, 13, 0, 15, 16, 17, 0, 19, 20, 21)
T_POSE = np.array(
    [
        *[(0, 0, 0.95), (0, 0, 1.04), (0, 0, 1.14), (0, 0, 1.23), (0, 0, 1.32), (0, 0, 1.46), (0.01, 0, 1.55)],
        *[(0, -0.03, 1.41), (0, -0.17, 1.41), (0, -0.46, 1.41), (0, -0.71, 1.41)],
        *[(0, 0.03, 1.41), (0, 0.17, 1.41), (0, 0.46, 1.41), (0, 0.71, 1.41)],
        *[(0, -0.09, 0.93), (0, -0.09, 0.51), (0, -0.09, 0.09), (0.15, -0.09, 0.02)],
        *[(0, 0.09, 0.93), (0, 0.09, 0.51), (0, 0.09, 0.09), (0.15, 0.09, 0.02)],
    ]
)
"""Origins of the segments (m) of a person in a T-pose who looks along x."""


def posed(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Quaternions w x y z and positions (m) of the segments, in the world: some pose of the person."""
    random = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(random.normal(scale=0.5, size=(23, 3)))
    position = np.zeros((23, 3))
    position[0] = random.normal(size=3)
    for segment in range(1, 23):
        parent = PARENT[segment]
        position[segment] = position[parent] + turn[parent].apply(T_POSE[segment] - T_POSE[parent])
    return turn.as_quat()[:, [3, 0, 1, 2]], position


def header(kind: str, counter: int, part: int, items: int, time_ms: int, character: int, payload: bytes) -> bytes:
    head = struct.pack(">6sIBBI", f"MXTP{kind}".encode(), counter, part, items, time_ms)
    return head + struct.pack(">BBBBHH", character, 23, 0, 0, 0, len(payload) % 65536) + payload


def y_up(quat: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses of a z-up world (x forward, y left) in one with y up (z forward, x left), world and segments alike."""
    M = Rotation.from_matrix([[0, 1, 0], [0, 0, 1], [1, 0, 0]])
    turned = M * Rotation.from_quat(quat[:, [1, 2, 3, 0]]) * M.inv()
    return turned.as_quat()[:, [3, 0, 1, 2]], M.apply(position)


def pose(
    counter: int, seed: int = 0, time_ms: int = 0, character: int = 0, parts: int = 1, unit: float = 1.0, up: str = "z"
) -> list[bytes]:
    """A sample of type 02 in so many datagrams, with a prop behind the body."""
    quat, position = posed(seed) if up == "z" else y_up(*posed(seed))
    items = [struct.pack(">i3f4f", k + 1, *position[k] / unit, *quat[k]) for k in range(23)]
    items.append(struct.pack(">i3f4f", 25, 1, 2, 3, 1, 0, 0, 0))
    cut = [list(chunk) for chunk in np.array_split(np.arange(24), parts)]
    return [
        header(
            *("02", counter, part | (0x80 if part == parts - 1 else 0), len(chunk), time_ms, character),
            b"".join(items[k] for k in chunk),
        )
        for part, chunk in enumerate(cut)
    ]


def text(value: str) -> bytes:
    return struct.pack(">i", len(value)) + value.encode()


def size(character: int = 0, scale: float = 1.0, unit: float = 1.0) -> list[bytes]:
    """Type 13: first the segments, then some points."""
    origins = b"".join(text(name) + struct.pack(">3f", *scale * T_POSE[k] / unit) for k, name in enumerate(BODY))
    points = (
        struct.pack(">HH", 22, 1) + text("pLeftHeelFoot") + struct.pack(">I3f", 0, *np.array([-0.06, 0, -0.09]) / unit)
    )
    return [
        header("13", 0, 0, 1, 0, character, struct.pack(">i", 23) + origins + struct.pack(">i", 0)),
        header("13", 0, 0x81, 1, 0, character, struct.pack(">ii", 0, 1) + points),
    ]
