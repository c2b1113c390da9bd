"""Motion files of any origin on our skeleton: BVH and ASF/AMC, their conventions found in the file.

The body is found by names or by its tree, unit and up axis by its size and by how it stands; our skeleton takes the
bones' lengths, repeats the rotations, and is fitted to the places of the file's joints in every frame.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.anatomy import at_landmarks, crown_over_head
from wearcap.body.foreign_tree import ForeignTree, foreign_tree, joint_roles, standing_rotation, straightness
from wearcap.body.joint_matching import convention
from wearcap.body.position_fit import fit_positions
from wearcap.body.retarget import fit_offsets, retarget
from wearcap.body.skeleton import ancestors, xsens23
from wearcap.boundary.opening import placed
from wearcap.errors import WearcapError
from wearcap.io.conventions import AUTO, DETECTED, Conventions
from wearcap.io.formats.bvh import axes_rotation
from wearcap.prepare.foreign_conventions import (
    Mapping,
    find_axes,
    find_body,
    find_unit,
    is_mirrored,
    read_mapping,
    with_thorax,
    with_toes,
)
from wearcap.prepare.foreign_files import Take, read_take
from wearcap.prepare.levels import Levels, face_in, levels_in, pelvis_in, walking_face, with_levels
from wearcap.recording.motion import Motion

LEAST_STRAIGHT = 0.12
"""Straightness that a clip's straightest frame has where joints' axes that follow from it are not in doubt."""
SIBLINGS, SIBLING_FRAMES = 6, 150
"""Number of straight clips of a skeleton from which its joints' axes follow, and of frames used of each."""


@dataclass(frozen=True)
class ForeignReport:
    """What was detected in a file, and how near the result is to it."""

    source: str
    convention: str
    found_by: str
    unit: str
    unit_m: float
    height_m: float
    up: str
    facing: str
    frames: str
    """Where the joints' frames come from: the bind pose or the motion."""
    joints: dict[str, str]
    """Names in the file by xsens23's names."""
    residual_m: dict[str, tuple[float, float]]
    """Mean and worst distance to the file's joints, by xsens23's names."""
    notes: tuple[str, ...] = ()

    def lines(self) -> list[str]:
        """The report in plain sentences."""
        mean = sum(mean for mean, _ in self.residual_m.values()) / len(self.residual_m)
        worst = max(self.residual_m, key=lambda name: self.residual_m[name][1])
        each = (f"{name} {1000 * m:.1f} ({1000 * w:.1f})" for name, (m, w) in self.residual_m.items())
        return [
            f"Joint names are {self.convention}; the body was found by {self.found_by}.",
            f"The unit is {self.unit} ({self.unit_m:.6g} m): a person of about {self.height_m:.2f} m.",
            f"Up is {self.up}, {self.facing}.",
            f"The joints' frames come from {self.frames}.",
            "Joints: " + ", ".join(f"{ours} = {theirs}" for ours, theirs in self.joints.items()) + ".",
            f"The fit is {1000 * mean:.1f} mm from the file's joints on average, at worst "
            f"{1000 * self.residual_m[worst][1]:.1f} mm ({worst}).",
            "By joint, mean (worst) in mm: " + ", ".join(each) + ".",
            *self.notes,
        ]

    def summary(self) -> str:
        """The report in one line."""
        mean = sum(mean for mean, _ in self.residual_m.values()) / len(self.residual_m)
        worst = max(worst for _, worst in self.residual_m.values())
        frames = self.frames.split(",")[0]
        return (
            f"names {self.convention}, {self.unit}, {self.up} up, frames from {frames}; {1000 * mean:.1f} mm from the "
            f"file's joints (worst {1000 * worst:.1f})" + "".join(f"; {note}" for note in self.notes)
        )


@dataclass(frozen=True)
class ForeignMotion:
    """A file's motion on xsens23 (z up, metres, the file's times), and what was found out about the file."""

    motion: Motion
    report: ForeignReport


def read_foreign_motion(
    path: str | Path,
    mapping: str | Path | Mapping | None = None,
    *,
    amc_fps: float | int = 120,
    asf: Path | None = None,
    levels: Levels | None = None,
    siblings: Sequence[Take] = (),
    how: Conventions = DETECTED,
) -> ForeignMotion:
    """Read a .bvh, or an .amc with `asf` or the skeleton file beside it (plain, .xz or .gz), onto xsens23.

    `mapping` (a YAML file with any of joints, unit, up, forward) overrides what is detected, and `how` both; `levels`
    replaces what the frames show of how head and feet are level. Conventions and joints' axes follow from the frames of
    the file and of `siblings`, clips of the same skeleton. Raises WearcapError for a file that is damaged or holds no
    body with head, arms and legs, saying what is missing.
    """
    path = Path(path)
    given = mapping if isinstance(mapping, Mapping) else Mapping() if mapping is None else read_mapping(mapping)
    given = replace(given, unit_m=how.unit_m or given.unit_m, up=given.up if how.up == AUTO else how.up)
    own = read_take(path, amc_fps, asf)
    take = _joined(own, siblings)
    found, found_by = find_body(take, given, path)
    take, found = with_toes(take, found)
    take = take.mirrored() if is_mirrored(take, found) else take
    unit, unit_m, _ = find_unit(take, found, given, path)
    take = with_thorax(take, unit_m)
    R_ours_rest, odd = standing_rotation(take.rest, found)
    up, forward = find_axes(take, found, R_ours_rest, given, unit_m)
    R_world_file, naming = axes_rotation(path, up, forward), convention(take.names)
    t_world = take.t @ R_world_file.T * unit_m
    with placed(path):
        tree = foreign_tree(path.name.split(".")[0], take.parents, R_world_file @ take.R, t_world, found, R_ours_rest)
        # CMU's head frames are those of markers, in whatever format.
        trusted = R_ours_rest is not None and not naming.startswith("CMU")
        tree = _levelled(tree, take.timestamps, len(own.t), trusted, levels)
        above_head = [joint for joint in range(len(take.parents)) if found.head in ancestors(take.parents, joint)[1:]]
        tree = at_landmarks(tree, crown_over_head(tree, t_world[:, above_head]), naming)
        motion = _fitted(tree, take.timestamps)
    shown = levels or levels_in([motion.sliced(len(own.t), len(motion)) if siblings else motion])
    motion = with_levels(motion, Levels(None, shown.R_joint_sole)).sliced(0, len(own.t))
    if not (motion.R_parent_joint.isfinite().all() and motion.t_world_root.isfinite().all()):
        raise WearcapError("no skeleton can be fitted to its joints", path, "joints apart from one another")
    roles, straight = joint_roles(found), straightness(take.t, found).max().item() if odd else 1.0
    motion_of = f"the motion of {len(siblings)} clips" if siblings else "the motion"
    report = ForeignReport(
        path.name,
        naming,
        found_by,
        unit,
        unit_m,
        motion.skeleton.stature,
        up,
        f"{forward} is ahead in the bind pose" if odd == "" else f"{forward} is our x",
        "the bind pose" if odd == "" else f"{motion_of}, for in the bind pose {odd}",
        {ours: take.names[joint] for ours, joint in roles.items()},
        _residuals(motion, {name: tree.place(name)[: len(motion)] for name in roles if name in tree.skeleton}),
        _notes(take, straight, how),
    )
    return ForeignMotion(replace(motion, provenance={"source": path.name, "format": take.format}), report)


def _joined(take: Take, siblings: Sequence[Take]) -> Take:
    """The take, followed by its siblings' frames."""
    for other in siblings:
        times = other.timestamps + take.timestamps[-1] + 1  # a second between them
        pairs = ((take.R, other.R), (take.t, other.t), (take.timestamps, times))
        R, t, timestamps = (torch.cat(pair) for pair in pairs)
        take = replace(take, R=R, t=t, timestamps=timestamps)
    return take


@cache
def straightest(files: tuple[Path, ...], joints: tuple[tuple[str, str], ...] = ()) -> tuple[Take, ...]:
    """The clips in which people stand straightest, thinned, of BVH files of one skeleton; unreadable ones are left out.

    `joints` are a mapping's.
    """
    takes: list[tuple[float, Take]] = []
    for file in files:
        with suppress(WearcapError):  # reported where the file itself is read
            take = read_take(file, amc_fps=120)
            thin = slice(None, None, max(1, len(take.t) // SIBLING_FRAMES))
            whole, found = with_toes(take, find_body(take, Mapping(dict(joints)), file)[0])
            straight = straightness(whole.t[thin], found).sum().item()
            takes.append((straight, replace(take, R=take.R[thin], t=take.t[thin], timestamps=take.timestamps[thin])))
    return tuple(take for _, take in sorted(takes, key=lambda row: -row[0])[:SIBLINGS])


def _notes(take: Take, straight: float, how: Conventions) -> tuple[str, ...]:
    """What the file's reading found odd, what is stated, and whether the axes of its joints are in doubt."""
    notes = list(take.notes)
    if stated := [f"{name}={value}" for name in ("unit", "up") if (value := getattr(how, name)) != AUTO]:
        notes.append(f"Stated: {', '.join(stated)}.")
    if straight < LEAST_STRAIGHT:
        notes.append(
            f"Nobody stands straight in it (straightness {straight:.2f} of 1): the axes of its joints are uncertain, the "
            "head's by up to 50°. Read it in a folder with other clips of its skeleton."
        )
    return tuple(notes)


def _fitted(tree: ForeignTree, timestamps: Float[Tensor, "time"]) -> Motion:
    """The motion on an xsens23 of its wearer's bones, its joints at the file's."""
    target = fit_offsets(tree.skeleton, xsens23())
    R, t = retarget(tree.skeleton, target, tree.R_parent_joint, tree.t_world_root)
    named = {name: tree.positions[:, k] for k, name in enumerate(tree.skeleton.joint_names) if name in target}
    R, t = fit_positions(target, R, t, named)
    return Motion(timestamps.double(), target, R.float(), t.float())


def _levelled(
    tree: ForeignTree, timestamps: Float[Tensor, "time"], own: int, trusted: bool, levels: Levels | None
) -> ForeignTree:
    """The tree with level axes of head and pelvis, by `levels` or as its frames beyond the file's `own` show them.

    A head whose frame is not trusted is level where its wearer walks in the file itself.
    """
    motion = Motion(timestamps.double(), tree.skeleton, tree.R_parent_joint, tree.t_world_root)
    of_file = motion.sliced(0, own)
    shown = [motion.sliced(own, len(motion)) if len(motion) > own else of_file]
    face = face_in(shown, trusted) if levels is None else levels.R_head_face
    pelvis = pelvis_in(shown) if levels is None else levels.R_pelvis
    if not trusted and face is not None:
        walks = walking_face(of_file)
        face = face if walks is None else walks
    tree = tree if pelvis is None else tree.turned(0, pelvis)
    return tree if face is None else tree.turned(tree.skeleton.index("head"), face)


def _residuals(motion: Motion, goals: dict[str, Float[Tensor, "time 3"]]) -> dict[str, tuple[float, float]]:
    t = motion.T_world_joint.t
    gaps = {name: (t[:, motion.skeleton.index(name)] - goal).norm(dim=-1) for name, goal in goals.items()}
    return {name: (gap.mean().item(), gap.max().item()) for name, gap in gaps.items()}
