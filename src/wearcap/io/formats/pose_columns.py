"""Columns of poses in a text: what a header or the numbers themselves say of their places, unit of time and axes."""

import re
from collections.abc import Sequence

import numpy as np
import torch

from wearcap.io.formats.poses import NORM_TOLERANCE, are_rotations

SLOTS = ("time", "x", "y", "z", "qw", "qx", "qy", "qz")
EUROC = dict(zip(SLOTS, range(8)))
TUM = {"time": 0, "x": 1, "y": 2, "z": 3, "qx": 4, "qy": 5, "qz": 6, "qw": 7}
FIRST_CAMERA = "-y", "camera"
"""Axes of a SLAM whose world is its first camera."""
MATRIX_WITHIN = 0.02
_ALIASES = {
    "time": ("timestamp", "time", "t", "ts", "stamp", "timestamps"),
    **{axis: (f"t{axis}", f"p{axis}", axis, f"pos{axis}", f"position{axis}", f"prsr{axis}") for axis in "xyz"},
    **{f"q{axis}": (f"q{axis}", f"quat{axis}", f"rot{axis}", f"orientation{axis}", f"qrs{axis}") for axis in "wxyz"},
}
_OPENVINS = ["timestamp(s)", "q", "p"]
STATES = "tracking_state", "trackingstate", "tracking state", "state", "status"
LOST = "lost", "notavailable", "not_available", "not available", "unavailable", "paused", "stopped"
"""Columns that hold the state of tracking, and its values in rows without a pose."""
_USUAL = (("tracker_confidence", ("y", "openxr")), ("pose.pose.position", ("z", "head")))
"""Words in the headers of RealSense's T265 and of odometry in ROS bags, and their axes: up, and the device's."""


def words_of(line: str) -> list[str]:
    """Fields between commas, else between spaces."""
    return [word.strip() for word in line.split(",")] if "," in line else line.split()


def is_number(word: str) -> bool:
    """Whether a field is a number; NaN is one."""
    try:
        float(word)
    except ValueError:
        return False
    return True


def places_of(words: Sequence[str]) -> dict[str, int] | None:
    """Columns of a header that names time, position and quaternion; None for any other line.

    OpenVINS' JPL quaternion of the world in the body has the numbers of Hamilton's of the body in the world.
    """
    if [word.lower() for word in words[:3]] == _OPENVINS:
        return {"time": 0} | {name: place for place, name in enumerate(("qx", "qy", "qz", "qw", "x", "y", "z"), 1)}
    ends = [re.sub(r"^.*\.(position|orientation)\.", r"\1", word.lower()) for word in words]  # ROS' nested messages
    plain = [re.sub(r"\[[^\[\]]*\]|\([^()]*\)|[^a-z]", "", word) for word in ends]
    plain = [re.sub(r"^(time|timestamp)(?:ns|us|ms|sec|seconds|s)$", r"\1", word) for word in plain]
    found = {}
    for slot, names in _ALIASES.items():
        place = next((plain.index(name) for name in names if name in plain), None)
        if place is not None:
            found[slot] = place
    return found if found.keys() == set(SLOTS) else None


def first_column(header: str) -> str:
    """Name of a header's first column, which may hold spaces, in small letters."""
    return re.split(r"[,\s]\s*(?=[a-z])", header.lower().lstrip("# \t"), maxsplit=1)[0]


def quaternion_first(table: np.ndarray) -> np.ndarray:
    """Columns in the order of `SLOTS`, of (row, 8) that were taken for TUM's.

    Some recorders (ARCore's) put the quaternion, scalar last, before the place; the one with unit norm in all rows shows.
    """
    for places, order in (([4, 5, 6, 7], range(8)), ([1, 2, 3, 5], [0, 6, 7, 4, 5, 1, 2, 3])):
        if np.allclose(np.square(table[:, places].clip(-2, 2)).sum(1), 1.0, rtol=0, atol=2 * NORM_TOLERANCE):
            return table[:, order]
    return table


def usual_axes(heading: str, first: np.ndarray) -> tuple[str, str] | None:
    """The format's usual axes (up, device) by its header and its first row, in the order of `SLOTS`; None: it has none.

    A path that begins with the identity is a SLAM's, whose world is its first camera, unless its header names bare x, y, z
    as odometry of vehicles and inertial sensors does.
    """
    named = next((axes for word, axes in _USUAL if word in heading), None)
    identity = bool((np.abs(first[1:] - [0, 0, 0, 1, 0, 0, 0]) < 1e-6).all())
    return named or (FIRST_CAMERA if identity and not re.search(r"\bx\b", heading) else None)


def is_matrix(words: Sequence[str]) -> bool:
    """Whether numbers are a time and [R | t] by row, or a 4×4 matrix by row or column, which a time may precede."""
    if len(words) not in (13, 16, 17) or not all(map(is_number, words)):
        return False
    values = np.array([float(word) for word in words[len(words) % 4 :]])
    if len(words) == 13:
        return bool(are_rotations(torch.from_numpy(values.reshape(3, 4)[:, :3].copy()), MATRIX_WITHIN))
    return any(np.array_equal(last, [0, 0, 0, 1]) for last in (values[12:], values[3::4]))
