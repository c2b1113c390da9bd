"""wearcap's motion file: one .npz that holds a Motion exactly, readable with NumPy alone; frames on an even time grid.

Arrays by the Motion's field names (`timestamps`, `R_parent_joint`, `skeleton.t_parent_joint`, …), `wearcap` (JSON with
everything that is no array), and for tools that know AMASS' keys `trans`, `poses` (axis-angle of each joint in its
parent, in this skeleton's joints and axes), `mocap_framerate` and `joint_names`.
"""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int64
from torch import Tensor

from wearcap.boundary.arrays import read_npz
from wearcap.boundary.texts import parse_json
from wearcap.errors import WearcapError
from wearcap.files import atomic_path
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import nearest_frames
from wearcap.recording.motion import HANDS, Motion
from wearcap.recording.serialize import dumps, flatten, unflatten
from wearcap.recording.timing import joined

SCHEMA = 1
SECTION = re.compile(r"motion-[0-9]{6}\.npz")
"""Names of consecutive parts of one motion."""


def write_motion(motion: Motion, path: str | Path) -> None:
    """Write a motion atomically; equal motions give equal bytes.

    Raises WearcapError when it cannot be written, or holds NaN or infinite values.
    """
    tree, tensors = flatten(motion)
    _require_finite(tensors, path)
    arrays = {key: tensor.numpy() for key, tensor in sorted(tensors.items())}
    arrays["wearcap"] = np.array(dumps({"schema": SCHEMA, "motion": tree}))
    arrays["trans"] = arrays["t_world_root"]
    arrays["poses"] = rotation.log(motion.R_parent_joint.double()).flatten(1).float().numpy()
    arrays["joint_names"] = np.array(motion.skeleton.joint_names)
    if len(motion) > 1:
        arrays["mocap_framerate"] = np.array(nominal_fps(motion.fps))
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def read_motion(path: str | Path) -> Motion:
    """Read what `write_motion` wrote. Raises WearcapError when it is missing, damaged, not finite or foreign."""
    arrays = read_npz(path)
    if "wearcap" not in arrays:
        fix = "AMASS files are read by io.formats.amass."
        raise WearcapError("an .npz file, but not of ours", path, "one that write_motion wrote", fix)
    try:
        tree = parse_json(str(arrays.pop("wearcap")), path)
        version = tree["schema"]
        if version != SCHEMA:
            raise WearcapError(f"schema version {version}", path, f"version {SCHEMA}")
        motion = unflatten(tree["motion"], lambda key: torch.from_numpy(arrays[key]))
        _check(motion, path)
    except WearcapError as error:
        if error.where:
            raise
        raise _damaged(error, path) from error
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, RecursionError) as error:
        raise _damaged(error, path) from error
    return motion


def motion_files(folder: str | Path) -> list[Path]:
    """Files of a motion in a folder, in order of time: motion.npz, else the sections of a live capture that did not end."""
    folder = Path(folder)
    whole = folder / "motion.npz"
    return (
        [whole]
        if whole.is_file()
        else sorted(path for path in folder.glob("motion-*.npz") if SECTION.fullmatch(path.name))
    )


def read_sections(paths: Sequence[Path]) -> Motion:
    """The motion of consecutive files. Raises WearcapError as `read_motion` does, for no file, and for other skeletons."""
    motions = [read_motion(path) for path in paths]
    if any(each.skeleton != motions[0].skeleton for each in motions):
        raise WearcapError("sections of several skeletons", paths[0].parent, "the files of one wearer")
    if (whole := joined(motions)) is None:
        raise WearcapError("no recorded motion", expected="motion.npz, or motion-000000.npz, …")
    return whole


def _damaged(error: Exception, path: str | Path) -> WearcapError:
    return WearcapError(f"its description is damaged ({error})", path, fix="Capture it again.")


def _check(motion: Motion, path: str | Path) -> None:
    """Raise WearcapError or ValueError for a motion with arbitrary content; `unflatten` has checked types and axes."""
    if not isinstance(motion, Motion):
        raise WearcapError("holds no motion", path)
    _require_finite(flatten(motion)[1], path)
    skeleton, interactions = motion.skeleton, motion.interactions
    sizes = {
        "R_parent_joint": (motion.R_parent_joint, len(skeleton)),
        "hand_contact_prob": (motion.hand_contact_prob, len(HANDS)),
        "joint_std": (motion.joint_std, len(skeleton)),
        "fingers_measured": (motion.fingers_measured, len(HANDS)),
        "interactions.hands": (None if interactions is None else interactions.hands, len(HANDS)),
    }
    for name, (value, size) in sizes.items():
        if value is not None and value.shape[1] != size:
            raise WearcapError(f"array {name!r} has shape {tuple(value.shape)}", path, f"{size} in the second place")
    if interactions is not None and {len(interactions.objects), len(interactions.classes)} != {len(interactions)}:
        raise ValueError(f"names that do not match {len(interactions)} interactions")
    if motion.joint_dof is not None and not 0 < motion.joint_dof < np.inf:
        raise ValueError(f"{motion.joint_dof} degrees of freedom")
    for site in skeleton.sites.values():
        skeleton.index(site.joint)
        if not np.isfinite(site.t_joint_site).all():
            raise ValueError("a site without a finite position")


def _require_finite(tensors: dict[str, Tensor], path: str | Path) -> None:
    if bad := [key for key, tensor in tensors.items() if not tensor.isfinite().all()]:
        raise WearcapError(f"{bad[0]!r} holds NaN or infinite values", path, "a finite motion")


STILL_FPS = 30.0
"""Rate (Hz) written for a motion of a single frame, which has none."""


def even_frames(motion: Motion) -> tuple[Int64[Tensor, "time"], float]:
    """Index of the nearest frame at each step of the motion's nominal rate, and that rate (Hz).

    An even motion keeps every frame once; over a gap the nearest frame is repeated, so that nothing shifts in time.
    Raises WearcapError for a motion without frames or with a gap of more than a minute.
    """
    if len(motion) == 0:
        raise WearcapError("the motion has no frames", expected="at least one frame to write")
    if len(motion) == 1:
        return torch.zeros(1, dtype=torch.int64), STILL_FPS
    steps, fps = motion.timestamps.diff(), nominal_fps(motion.fps)
    if not (steps > 0).all() or steps.max() > 60:
        what = "timestamps fall, repeat or leave a gap of over a minute"
        raise WearcapError(what, expected="rising timestamps in s", fix="Cut the motion at the gap.")
    start, duration = motion.timestamps[0], motion.timestamps[-1] - motion.timestamps[0]
    grid = start + torch.arange(round(duration.item() * fps) + 1, dtype=torch.float64) / fps
    return nearest_frames(motion.timestamps, grid), fps


def nominal_fps(fps: float) -> float:
    """Nearest integer rate if the rate was only rounded (120.0005 Hz from a step of .0083333 s), else the rate itself."""
    return float(round(fps)) if round(fps) and abs(fps - round(fps)) < 1e-4 * fps else fps
