"""ECHO's inputs and outputs as features (ECHO §3.1): three tracked points in; body, object and contacts out."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.body.contact_points import BODY_POINTS, HAND_POINTS, mirrored_points
from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.data.features import LIMBS
from wearcap.errors import WearcapError, require_choice
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid

POINTS = ("head", "left_wrist", "right_wrist")
"""The tracked joints, in this order."""
FRAMES = ("own", "window", "world")
"""Coordinate frames that features can be expressed in (`EchoFeatures.frame`)."""
CONTACTS = BODY_POINTS + len(FOOT_PATCHES)
"""Number of contact labels per frame."""
TWIN_POINTS = [0, 2, 1]
"""Index of each tracked point's mirror twin."""
TWIN_CONTACTS = [*mirrored_points().tolist(), *(BODY_POINTS + k for k in (2, 3, 0, 1))]
"""Index of each contact label's mirror twin."""
HANDS = {"left_wrist": slice(0, HAND_POINTS), "right_wrist": slice(BODY_POINTS // 2, BODY_POINTS // 2 + HAND_POINTS)}
"""Points of the body that are each hand's."""
OBJECT_SIZE = 9
"""Features of an object's pose in one frame: translation and 6D rotation."""
EXTENTS = 6
"""Features of an object's size: half extents along its canonical axes and its bounding box's centre (m)."""


class ThreePoints(NamedTuple):
    """World poses of head and wrists at the model's frame rate."""

    R_world_point: Float[Tensor, "*batch time point 3 3"]
    t_world_point: Float[Tensor, "*batch time point 3"]
    seen: Bool[Tensor, "*batch time point"] | None = None
    """Which points are tracked in each frame; None: all are."""


class Body(NamedTuple):
    """A body's motion: local joint rotations and the root's position in the world (m)."""

    R_parent_joint: Float[Tensor, "*batch time joint 3 3"]
    t_world_root: Float[Tensor, "*batch time 3"]


@dataclass(frozen=True)
class EchoFeatures:
    """Encodes three tracked points, bodies and objects in world or head-centred coordinates.

    frame "window": gravity-aligned, at the head of the window's first frame (ECHO). "own" (ours): each frame in its
    own head-centred, yaw-aligned coordinates, so that features do not depend on the position within the window and
    need not be re-expressed when the window advances. "world": as recorded (ECHO's ablation without canonical frame).
    """

    frame: str = "own"
    body: bool = True
    """Whether the wearer's size and the head's height above the floor are part of the condition (ours)."""
    classes: Sequence[str] = ()
    """Names of the object classes, in the order of their one-hot code."""
    shape_size: int = 256
    """Size of the object encoder's feature; 0: class and extents alone describe an object."""
    joints: int = 23
    """Number of joints of the skeleton."""
    fps: float = 30.0
    """Frame rate of the model (Hz)."""
    points: Sequence[str] = POINTS
    """Tracked points that the condition has, the head first: all, or for a baseline the head alone."""
    gaps: bool = False
    """Whether wrists may be missing at any frame (ours): zeros then, and a feature of each says whether it is there."""

    def __post_init__(self):
        require_choice(self.frame, FRAMES, f"ECHO has no frame {self.frame!r}")
        if tuple(self.points) not in (POINTS[:1], POINTS):
            what = f"tracked points {', '.join(self.points) or '(none)'}"
            raise WearcapError(what, expected=f"{', '.join(POINTS)}, or the head alone")

    @property
    def condition_size(self) -> int:
        """Features per frame: 18 for each point (ECHO: 54), 2 of the heading if frame is "own", the head's height and
        limb lengths, and with `gaps` one for each wrist."""
        flags = len(self.points) - 1 if self.gaps else 0
        return 18 * len(self.points) + (2 if self.frame == "own" else 0) + (1 + len(LIMBS) if self.body else 0) + flags

    @property
    def human_size(self) -> int:
        """Features of a body's pose: root translation and 6D rotations of all joints."""
        return 3 + 6 * self.joints

    @property
    def object_condition_size(self) -> int:
        """Features of an object: one-hot class, extents, and the encoder's feature."""
        return len(self.classes) + EXTENTS + self.shape_size

    @property
    def moves(self) -> bool:
        """Whether outputs must be re-expressed when the window advances."""
        return self.frame == "window"

    def class_code(self, name: str) -> Float[Tensor, "class"]:
        """One-hot code of a class. Raises WearcapError for a class that the model was not built for."""
        if name not in self.classes:
            what = f"the model has no object class {name!r}"
            fix = "Give the object's category the name of the class that is most like it."
            raise WearcapError(what, expected=f"one of {', '.join(self.classes)}", fix=fix)
        return torch.nn.functional.one_hot(torch.tensor(list(self.classes).index(name)), len(self.classes)).float()

    def canonical(self, points: ThreePoints) -> Rigid:
        """World poses of the canonical frames of windows: R "batch #time 3 3", t "batch #time 3"."""
        R, t = points.R_world_point[:, :, 0], points.t_world_point[:, :, 0]
        if self.frame == "world":
            return Rigid(torch.eye(3).to(R).expand(len(R), 1, 3, 3), torch.zeros_like(t[:, :1]))
        if self.frame == "window":
            R, t = R[:, :1], t[:, :1]
        return Rigid(rotation.about_axis("z", rotation.yaw_of(R)), t)

    def condition(
        self,
        points: ThreePoints,
        floor_height: Float[Tensor, "batch time"],
        size: Float[Tensor, "batch limb"],
        frame: Rigid | None = None,
    ) -> Float[Tensor, "batch time condition"]:
        """[R, ω, J, v] of the three points (ECHO eq. 4): ω is the rotation since the previous frame as 6D, v the
        velocity (m/s).

        `frame`: the canonical frame of the points, if it was computed already.
        """
        frame = self.canonical(points) if frame is None else frame
        R, t = (part[:, :, : len(self.points)] for part in points[:2])
        R_canonical_world = frame.R.mT[:, :, None]
        turn = torch.cat([torch.eye(3).to(R).expand_as(R[:, :1]), R[:, :-1].mT @ R[:, 1:]], 1)
        step = t.diff(dim=1) * self.fps
        step = torch.cat([step[:, :1] if step.shape[1] else torch.zeros_like(t), step], 1)
        positions = (R_canonical_world @ (t - frame.t[:, :, None])[..., None])[..., 0]
        # The yaw-aligned frame of the window's first head pose.
        first = Rigid(rotation.about_axis("z", rotation.yaw_of(R[:, :1, 0])), t[:, :1, 0])
        parts = [
            rotation.rot6d_from_matrix(R_canonical_world @ R),
            rotation.rot6d_from_matrix(turn),
            positions,
            (R_canonical_world @ step[..., None])[..., 0],
        ]
        seen = torch.ones_like(t[..., 0], dtype=torch.bool) if points.seen is None else points.seen
        if self.gaps:
            both = seen & torch.cat([seen[:, :1], seen[:, :-1]], 1)
            parts = [torch.where(where[..., None], part, 0.0) for where, part in zip((seen, both, seen, both), parts)]
        parts = [part.flatten(-2) for part in parts]
        if self.frame == "own":
            # The head is at its own origin: its position and heading are relative to the window's first head instead.
            parts[2] = torch.cat([first.inverse() @ t[:, :, 0], parts[2][..., 3:]], -1)
            parts.append((first.R.mT @ frame.R)[..., :2, 0])
        if self.body:
            height = (t[:, :, 0, 2] - floor_height)[..., None] / size[:, None, :1]
            parts += [height, size[:, None].expand(-1, t.shape[1], -1)]
        if self.gaps:
            parts.append(seen[..., 1:].to(t))
        return torch.cat(parts, -1)

    def encode_body(self, body: Body, frame: Rigid) -> Float[Tensor, "batch time human"]:
        """Root translation and 6D joint rotations, with the root's pose in coordinates of `frame`."""
        root = frame.inverse().chain(Rigid(body.R_parent_joint[:, :, 0], body.t_world_root))
        R = torch.cat([root.R[:, :, None], body.R_parent_joint[:, :, 1:]], 2)
        return torch.cat([root.t, rotation.rot6d_from_matrix(R).flatten(-2)], -1)

    def decode_body(self, human: Float[Tensor, "batch time human"], frame: Rigid) -> Body:
        """The inverse of `encode_body`."""
        R = rotation.matrix_from_rot6d(human[..., 3:].unflatten(-1, (-1, 6)))
        root = frame.chain(Rigid(R[:, :, 0], human[..., :3]))
        return Body(torch.cat([root.R[:, :, None], R[:, :, 1:]], 2), root.t)

    def encode_object(self, T_world_object: Rigid, frame: Rigid) -> Float[Tensor, "batch time 9"]:
        """Translation and 6D rotation of an object in coordinates of `frame`."""
        T = frame.inverse().chain(T_world_object)
        return torch.cat([T.t, rotation.rot6d_from_matrix(T.R)], -1)

    def decode_object(self, value: Float[Tensor, "batch time 9"], frame: Rigid) -> Rigid:
        """The inverse of `encode_object`."""
        return frame.chain(Rigid(rotation.matrix_from_rot6d(value[..., 3:]), value[..., :3]))
