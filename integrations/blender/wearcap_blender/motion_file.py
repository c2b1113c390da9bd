"""Motions in NumPy arrays, and wearcap's motion.npz read without wearcap.

Metres, seconds, z up: the axes of wearcap and of Blender are the same.
"""

import json
import zipfile
from dataclasses import dataclass, field

import numpy as np
from mathutils import Matrix, Quaternion

MAX_BYTES = 1 << 31
"""Unpacked bytes of a motion's file: hours of motion."""


@dataclass
class Track:
    """Poses of an object over time: world rotations, and places."""

    times: np.ndarray
    R: np.ndarray
    t: np.ndarray


@dataclass
class Motion:
    """A body's motion; its rest pose has no rotations."""

    names: list
    parents: list
    offsets: np.ndarray
    """Of each joint in its parent's axes (joint 3)."""
    times: np.ndarray
    R: np.ndarray
    """Rotations relative to the parent, of the root in the world (time joint 3 3)."""
    t: np.ndarray
    """Places of the root (time 3)."""
    ends: dict = field(default_factory=dict)
    """Points by name: (joint, place in its axes); heels, fingertips, crown."""
    objects: dict = field(default_factory=dict)
    shifts: object = None
    """How far joints lie from their offsets (time joint 3), where bones change their length; None: nowhere."""


def read_motion(path):
    """Read a motion.npz. Raises ValueError for a file that is none, or damaged, and OSError for one that cannot be read."""
    try:
        with zipfile.ZipFile(path) as packed:
            if sum(item.file_size for item in packed.infolist()) > MAX_BYTES:
                raise ValueError(f"it unpacks to more than {MAX_BYTES >> 30} GiB")
        with np.load(path, allow_pickle=False) as file:
            tree = json.loads(str(file["wearcap"]))["motion"]
            skeleton, arrays = tree["skeleton"], {name: file[name] for name in file.files if name != "wearcap"}
        motion = Motion(
            [str(name) for name in skeleton["joint_names"]["$tuple"]],
            [int(parent) for parent in skeleton["parents"]["$tuple"]],
            *(np.asarray(arrays[key], np.float64) for key in
              ("skeleton.t_parent_joint", "timestamps", "R_parent_joint", "t_world_root")),
        )  # fmt: skip
        for name, site in (skeleton.get("sites") or {}).items():
            motion.ends[str(name)] = (str(site["joint"]), np.array(site["t_joint_site"]["$tuple"], np.float64))
        for name in tree.get("object_motion") or {}:
            keys = (f"object_motion.{name}.{part}" for part in ("timestamps", "R_world_body", "t_world_body"))
            motion.objects[str(name)] = Track(*(np.asarray(arrays[key], np.float64) for key in keys))
    except (KeyError, TypeError, AttributeError, zipfile.BadZipFile, EOFError, json.JSONDecodeError) as error:
        raise ValueError(f"no motion.npz of wearcap ({error})") from error
    check(motion)
    return motion


def check(motion):
    """Raise ValueError for arrays that do not fit each other."""
    joints, frames = len(motion.names), len(motion.times)
    fits = motion.R.shape == (frames, joints, 3, 3) and motion.t.shape == (frames, 3)
    fits = fits and motion.offsets.shape == (joints, 3) and min(joints, frames) > 0
    fits = fits and len(motion.parents) == joints and len(set(motion.names)) == joints
    if not fits or not all(-1 <= parent < max(joint, 1) for joint, parent in enumerate(motion.parents)):
        raise ValueError("its joints and arrays do not fit each other")
    parts = [motion.R, motion.t, motion.offsets, motion.times]
    for track in motion.objects.values():
        count = len(track.times)
        if track.R.shape != (count, 3, 3) or track.t.shape != (count, 3):
            raise ValueError("an object's poses do not fit its times")
        parts += [track.R, track.t, track.times]
    if not all(np.isfinite(part).all() for part in parts):
        raise ValueError("it holds numbers that are not finite")


def quaternions(R):
    """Unit quaternions w x y z (…, 4) of rotation matrices; along the first axis their signs do not flip."""
    found = np.array([Matrix(each).to_quaternion() for each in R.reshape(-1, 3, 3).tolist()]).reshape(*R.shape[:-2], 4)
    found[1:] *= np.cumprod(np.where((found[1:] * found[:-1]).sum(-1) < 0, -1.0, 1.0), axis=0)[..., None]
    return found


def matrices(xyzw):
    """Rotation matrices of quaternions x y z w of any length (…, 4)."""
    wxyz = np.roll(xyzw / np.linalg.norm(xyzw, axis=-1, keepdims=True), 1, axis=-1)
    found = [Quaternion(each).to_matrix() for each in wxyz.reshape(-1, 4).tolist()]
    return np.array(found).reshape(*xyzw.shape[:-1], 3, 3)
