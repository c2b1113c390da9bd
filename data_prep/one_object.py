"""Common form of data sets of a person who handles one object: body, object trajectory and mesh on one clock."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from data_prep.shared.engine import NOTE
from data_prep.shared.mocap import About, MocapSettings, mocap_recording, on_xsens23, without_glitches
from wearcap.errors import WearcapError, nearest
from wearcap.geometry.mesh import Mesh
from wearcap.geometry.trajectory import Trajectory, resample
from wearcap.io.formats.environment import FILE_NAME, write_environment
from wearcap.recording.motion import Motion
from wearcap.recording.recording import Recording
from wearcap.scene.objects import Environment, Freedom, SceneObject

_NAMES: dict[str, tuple[str, ...]] = {
    "backpack": (),
    "ball": ("basketball", "yogaball"),
    "bottle": (),
    "box": ("boxlarge", "boxlong", "boxmedium", "boxsmall", "boxtiny", "largebox", "plasticbox", "smallbox"),
    "cabinet_door": (),
    "chair": ("chairblack", "chairwood", "whitechair", "woodchair"),
    "clothesstand": (),
    "container": ("plasticcontainer",),
    "door": (),
    "drawer": (),
    "floorlamp": (),
    "keyboard": (),
    "monitor": (),
    "mop": (),
    "sofa": (),
    "stool": (),
    "suitcase": (),
    "table": ("largetable", "smalltable", "tablesmall", "tablesquare"),
    "tool": (),
    "toolbox": (),
    "trashcan": ("trashbin",),
    "tripod": (),
    "vacuum": (),
    "window": (),
    "yogamat": (),
}
"""All classes in alphabetical order, with BEHAVE's and OMOMO's other names for them."""

OBJECT_CLASSES: tuple[str, ...] = tuple(_NAMES)
"""A class's index is its position here."""

_CLASS_OF = {name: kind for kind, others in _NAMES.items() for name in (kind, *others)}


def object_class(name: str) -> str:
    """The class (of `OBJECT_CLASSES`) of an object by a data set's name, such as "largebox".

    Raises WearcapError, which lists the accepted names, for any other.
    """
    if name not in _CLASS_OF:
        near = nearest(name, _CLASS_OF)
        hint = near if near.startswith("Did you mean") else ""
        expected = f"one of {', '.join(sorted(_CLASS_OF))}"
        fix = f"{hint} A new name belongs into data_prep/one_object.py.".strip()
        raise WearcapError(f"no class for the object {name!r}", expected=expected, fix=fix)
    return _CLASS_OF[name]


@dataclass(frozen=True, eq=False)
class OneObject:
    """One take: the body, and the object that is handled throughout. Timestamps of both agree; they may have gaps."""

    name: str
    motion: Motion
    object_name: str
    """Name of the object in the data set."""
    path: Trajectory
    """Poses of the mesh's axes in the world."""
    mesh: Mesh
    """Mesh in metres, with the mean of its vertices at the origin."""
    shape: dict[str, float]
    subject: str
    activity: str
    location: str = ""

    def turned(self, R_new_old: Float[Tensor, "3 3"]) -> "OneObject":
        """The take in rotated world axes with the same origin."""
        R_joints = self.motion.R_parent_joint
        R_new = R_new_old.to(R_joints.dtype)
        R_joints = torch.cat([R_new @ R_joints[:, :1], R_joints[:, 1:]], 1)
        motion = replace(self.motion, R_parent_joint=R_joints, t_world_root=self.motion.t_world_root @ R_new.mT)
        path = self.path
        turned = Trajectory(path.timestamps, R_new @ path.R_world_body, path.t_world_body @ R_new.mT)
        return replace(self, motion=motion, path=turned)

    def frames(self, chosen: slice | Bool[Tensor, "time"]) -> "OneObject":
        """The take with the selected frames of body and object, by slice or mask."""
        rows = {name: getattr(self.motion, name)[chosen] for name in ("timestamps", "R_parent_joint", "t_world_root")}
        return replace(self, motion=replace(self.motion, **rows), path=self.path[chosen])


VERSION = 2
"""Version of both conversions, increased when the same source and settings yield another recording."""


MAX_GAP_S = 0.2
"""Longest gap (s) that is interpolated; at longer ones the take is cut."""


_UPSIDE_DOWN_M = 0.2


def one_object_recording(
    read: Callable[[], OneObject], source: str, license: str, settings: MocapSettings, output: str | Path
) -> Recording:
    """Like `mocap_recording`, with the object's path on the motion's clock and an environment of that one object.

    The environment is written to `output`/scenes/NAME; the object is free to move and handled throughout, so there
    are no `interactions`. Of the segments between gaps and glitches the longest is kept, as noted in the motion's
    provenance. Raises WearcapError for an object of unknown class and for a body that is upside down.
    """
    take = read()
    about, kind = About(take.name, take.subject, source, license, take.activity), object_class(take.object_name)
    kept, cut, frames = take, "", len(take.motion)
    gaps = (take.motion.timestamps.diff() > MAX_GAP_S).nonzero()[:, 0].tolist()
    if gaps:
        edges = [0, *(frame + 1 for frame in gaps), frames]
        start, stop = max(pairwise(edges), key=lambda span: span[1] - span[0])
        kept = take.frames(slice(start, stop))
        cut = f"kept frames {start} to {stop - 1} of {frames}: {len(gaps)} gaps of more than {MAX_GAP_S} s"
    motion, note = without_glitches(on_xsens23(kept.motion), settings.limits)
    feet = torch.stack([motion.joint(f"{side}_ankle").t[:, 2] for side in ("left", "right")]).mean(0)
    above = float((motion.joint("head").t[:, 2] - feet).median())
    if above < -_UPSIDE_DOWN_M:
        what = f"the head is {-above:.2f} m below the feet"
        fix = "The source's axes are others than published."
        raise WearcapError(what, where=about.name, expected="a world whose z is up", fix=fix)
    recording = mocap_recording(motion, about, settings)
    assert recording.motion is not None
    notes = "; ".join(text for text in (cut, note) if text)
    provenance = recording.motion.provenance | ({NOTE: notes} if notes else {})
    after = recording.motion  # the object's path goes to its clock, with the same shift by the floor's height
    track = resample(kept.path, motion.timestamps[0] + after.timestamps)
    shift = after.t_world_root[0] - motion.t_world_root[0]
    path = Trajectory(after.timestamps, track.R_world_body, track.t_world_body + shift)
    item = SceneObject(take.object_name, kind, take.mesh, path.R_world_body[0], path.t_world_body[0], Freedom("free"))
    file = Path("scenes") / about.name / FILE_NAME
    write_environment(Environment((item,)), Path(output) / file)
    return replace(
        recording,
        motion=replace(recording.motion, provenance=provenance),
        object_motion={take.object_name: path},
        environment=file.as_posix(),
        shape=take.shape,
        location=take.location,
    )
