"""The Motion (output of a pipeline, or ground truth), and interactions: which hands hold which object at which time."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from scipy import special
from torch import Tensor

from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import Skeleton
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory

HANDS = ("left", "right")


@dataclass(frozen=True)
class Interactions:
    """Time intervals in which a fixed set of hands holds one object, ordered by start."""

    start_s: Float64[Tensor, "interval"]
    stop_s: Float64[Tensor, "interval"]
    hands: Bool[Tensor, "interval hand"]
    """Whether each of `HANDS` holds the object."""
    objects: tuple[str, ...]
    """Names of the objects in the environment; "" if unknown."""
    classes: tuple[str, ...]
    """Contact class of each interval, of `scene.objects.CONTACT_CLASSES`; "" if unknown."""

    @classmethod
    def of(cls, rows: Iterable[tuple]) -> "Interactions":
        """Interactions from rows of start and stop (s), the hands' values, the object's name and its contact class."""
        columns = list(zip(*rows)) or [()] * 5
        times = (torch.tensor(edge, dtype=torch.float64) for edge in columns[:2])
        return cls(*times, torch.tensor(columns[2], dtype=torch.bool).reshape(-1, len(HANDS)), *columns[3:])

    @property
    def rows(self) -> list[tuple[float, float, list[bool], str, str]]:
        """Inverse of `of`."""
        return list(zip(self.start_s.tolist(), self.stop_s.tolist(), self.hands.tolist(), self.objects, self.classes))

    def __len__(self) -> int:
        return len(self.start_s)

    def hand_contact(
        self, timestamps: Float64[Tensor, "time"], contact_class: str | None = None
    ) -> Bool[Tensor, "time hand"]:
        """Whether each hand holds an object (of `contact_class`, if given) at each time (start ≤ t < stop)."""
        times = timestamps[:, None]
        within = (self.start_s <= times) & (times < self.stop_s)
        if contact_class is not None:
            within = within & torch.tensor([name == contact_class for name in self.classes], dtype=torch.bool)
        return (within[..., None] & self.hands).any(1)


def reach(share: float, dof: float | None) -> float:
    """Distance within which a share (0…1) of errors is, divided by that of 68.3 %, under Student's t distribution of `dof`
    degrees of freedom; None: under the normal distribution."""
    dof = math.inf if dof is None else dof
    return float(special.stdtrit(dof, (1 + share) / 2) / special.stdtrit(dof, special.ndtr(1.0)))


ESTIMATES = ("contact_prob", "hand_contact_prob", "body_contact_prob", "joint_std", "fingers_measured")
"""Optional fields of a Motion with a row per frame."""
PER_FRAME = ("timestamps", "R_parent_joint", "t_world_root", *ESTIMATES)


@dataclass(frozen=True)
class Motion:
    """A body's motion: timestamps (s), rotation of each joint relative to its parent (root: world), root position
    (m)."""

    timestamps: Float64[Tensor, "time"]
    skeleton: Skeleton
    R_parent_joint: Float[Tensor, "time joint 3 3"]
    t_world_root: Float[Tensor, "time 3"]
    contact_prob: Float[Tensor, "time patch"] | None = None
    """Probability of floor contact of `FOOT_PATCHES`."""
    hand_contact_prob: Float[Tensor, "time hand"] | None = None
    """Probability that each of `HANDS` holds an object."""
    body_contact_prob: Float[Tensor, "time point"] | None = None
    """Probability that each of the body's contact points (`body.contact_points`) touches the active object."""
    object_motion: dict[str, Trajectory] | None = None
    """Poses of the objects by name, with their own timestamps."""
    interactions: Interactions | None = None
    provenance: dict[str, str] = field(default_factory=dict)
    """Pipeline, checkpoint and config hash, or the source of a ground truth."""
    joint_std: Float[Tensor, "time joint"] | None = None
    """Distance (m) along each axis within which the system expects 68.3 % of the errors of every joint's position: of normal
    errors the standard deviation."""
    joint_dof: float | None = None
    """Degrees of freedom of Student's t distribution that these errors follow; None: they are normal."""
    fingers_measured: Float[Tensor, "time hand"] | None = None
    """1 where the fingers of each of `HANDS` follow a tracked hand; 0 where they are bridged, or at rest. None without fingers."""

    def __len__(self) -> int:
        return len(self.timestamps)

    @property
    def fps(self) -> float:
        """Nominal frame rate (Hz): the inverse of the median time step."""
        if len(self) < 2:
            raise ValueError("a motion of one frame has no frame rate")
        return 1.0 / self.timestamps.diff().median().item()

    @cached_property
    def T_world_joint(self) -> Rigid:
        """Poses of all joints: R "time joint 3 3", t "time joint 3"."""
        return forward_kinematics(self.skeleton, self.R_parent_joint, self.t_world_root)

    def joint_within(self, share: float) -> Float[Tensor, "time joint"] | None:
        """Distance (m) along each axis within which this share (0…1) of every joint's errors is expected; None of a motion
        that does not say how sure it is."""
        return None if self.joint_std is None else reach(share, self.joint_dof) * self.joint_std

    def joint(self, name: str) -> Rigid:
        """Pose of one joint over time."""
        return self.T_world_joint[:, self.skeleton.index(name)]

    def sliced(self, start: int, stop: int) -> "Motion":
        """Frames start…stop-1; object trajectories keep their own clocks and are cut to the same time span."""
        rows = {name: getattr(self, name) for name in PER_FRAME if getattr(self, name) is not None}
        cut = replace(self, **{name: row[start:stop] for name, row in rows.items()})
        if self.object_motion is None or not len(cut):
            return cut
        objects = {}
        for name, track in self.object_motion.items():
            first = int(torch.searchsorted(track.timestamps, cut.timestamps[0].item()))
            last = int(torch.searchsorted(track.timestamps, cut.timestamps[-1].item(), right=True))
            objects[name] = track[first:last]
        return replace(cut, object_motion=objects)

    def between(self, start_s: float, stop_s: float | None) -> "Motion":
        """The frames from one second to another (None: to the end), counted from the first frame.

        Raises WearcapError where there are none.
        """
        since = (self.timestamps - self.timestamps[0]).numpy()
        first = int(np.searchsorted(since, start_s))
        stop = len(since) if stop_s is None else int(np.searchsorted(since, stop_s, side="right"))
        if stop <= first:
            what = f"no frames from {start_s} s to {stop_s} s"
            raise WearcapError(what, expected=f"times from 0 to {since[-1]:.1f} s")
        return self.sliced(first, stop)

    def moved(self, T_new_world: Rigid) -> "Motion":
        """The motion and its objects in the coordinates of another world frame."""
        R_new, t_new = T_new_world.R, T_new_world.t
        R = self.R_parent_joint.clone()
        R[:, 0] = R_new @ R[:, 0]
        objects = self.object_motion
        if objects is not None:
            objects = {
                name: Trajectory(track.timestamps, R_new @ track.R_world_body, track.t_world_body @ R_new.mT + t_new)
                for name, track in objects.items()
            }
        return replace(self, R_parent_joint=R, t_world_root=self.t_world_root @ R_new.mT + t_new, object_motion=objects)
