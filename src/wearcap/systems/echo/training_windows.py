"""Training windows for ECHO: three tracked points with ground-truth body, active object and contacts."""

from functools import cache
from itertools import pairwise
from typing import Any, ClassVar, NamedTuple

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from wearcap.body.anny_body import anny_body
from wearcap.body.contact_points import BODY_POINTS, TOUCH_M, contact_points
from wearcap.body.skeleton import MIRROR
from wearcap.data.batch import Batch
from wearcap.data.bodies import bones_in_parts, head_in_parts, places_in_parts, size_in_parts
from wearcap.data.features import on_level_ground
from wearcap.data.packing import Track
from wearcap.data.transforms import joint_twins
from wearcap.data.view import HandsInView
from wearcap.data.windows import Content
from wearcap.diffusion.levels import DRAWS
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.io.formats.environment import read_environment
from wearcap.models.checkpoint import load_network
from wearcap.models.point_encoder import PointNeXt
from wearcap.recording.active_objects import NO_OBJECT, active_at, true_spans
from wearcap.recording.recording import Recording
from wearcap.recording.store import RecordingFile, RecordingStore
from wearcap.scene.objects import Environment
from wearcap.systems.echo.features import (
    CONTACTS,
    EXTENTS,
    OBJECT_SIZE,
    POINTS,
    TWIN_CONTACTS,
    TWIN_POINTS,
    Body,
    EchoFeatures,
    ThreePoints,
)
from wearcap.systems.echo.observations import ObjectReader, ObjectShape
from wearcap.systems.echo.scores import body_contact, foot_patches

MIN_FRAMES = 6
"""Length of the shortest training window (frames)."""
CANONICAL = "canonical", "canonical_mirrored"
"""Names of the objects' canonical poses, for windows as they are and for mirrored ones."""
MOMENTS = 12
"""Numbers of an object's mean and second moment."""
ASKEW_DEG = 22.5
"""Angle between the wearer's heading and the orientation to which the canonical ones are nearest."""


class EchoWindow(NamedTuple):
    """A batch of windows; frames beyond the end are padding."""

    R_world_point: Float[Tensor, "batch time point 3 3"]
    t_world_point: Float[Tensor, "batch time point 3"]
    seen: Bool[Tensor, "batch time point"]
    """Which of the points are tracked in each frame."""
    floor_height: Float[Tensor, "batch time"]
    size: Float[Tensor, "batch limb"]
    """`body_size` of the wearer (m)."""
    t_parent_joint: Float[Tensor, "batch joint 3"]
    R_parent_joint: Float[Tensor, "batch time joint 3 3"]
    t_world_root: Float[Tensor, "batch time 3"]
    contact: Float[Tensor, "batch time contact"]
    """64 body points on the active object, then `FOOT_PATCHES` on the floor: 1 for contact."""
    has_object: Bool[Tensor, "batch time"]
    """Whether an object is active; otherwise object pose and body contacts are arbitrary."""
    object_code: Float[Tensor, "batch time code"]
    """Class, extents and feature of the active object (`ObjectShape.code`)."""
    R_world_object: Float[Tensor, "batch time 3 3"]
    t_world_object: Float[Tensor, "batch time 3"]
    R_world_canonical: Float[Tensor, "batch time 3 3"]
    """The object's pose, or another that looks the same (`canonical`)."""
    t_world_canonical: Float[Tensor, "batch time 3"]
    object_mean: Float[Tensor, "batch time 3"]
    object_spread: Float[Tensor, "batch time 3 3"]
    """Mean (m) of the object's points about its centre, and second moment (m²), which gives their mean squared
    displacement by a rotation."""
    valid: Bool[Tensor, "batch time"]
    """False for padding."""
    noise: Float[Tensor, "batch time feature"]
    level_draws: Float[Tensor, "batch time 4"]
    draws: Float[Tensor, "batch draw"]
    """Diffusion noise and uniform draws for noise levels: functions of seed and step, whatever the worker process."""

    @property
    def points(self) -> ThreePoints:
        """The three tracked points."""
        return ThreePoints(self.R_world_point, self.t_world_point, self.seen)

    @property
    def body(self) -> Body:
        """The ground-truth body."""
        return Body(self.R_parent_joint, self.t_world_root)

    @property
    def T_world_object(self) -> Rigid:
        """The ground-truth pose of the active object's centre."""
        return Rigid(self.R_world_object, self.t_world_object)


def echo_track(
    recording: Recording, environment: Environment | None, reader: ObjectReader, every: int, within_m: float
) -> Track:
    """Every `every`-th frame of a recording with ground truth; contact is a distance of at most `within_m` (m).

    The head is the measured one, or without a head stream of the motion's length the ground truth; wrists are true.
    """
    motion, head = recording.motion, recording.head
    assert motion is not None
    take = torch.arange(0, len(motion), every)
    chosen = motion.skeleton.indices(*POINTS)
    R_world_point, t_world_point = motion.T_world_joint.R[:, chosen], places_in_parts(motion, POINTS)
    if head is not None and len(head.timestamps) == len(motion):
        R_world_point[:, 0] = head.T_world_head.R
        t_world_point[:, 0] = head_in_parts(motion, head.T_world_head.t)
    found = found_objects(recording, environment, reader, take, within_m)
    canonical_poses = [
        canonical(found.pose, found.shapes, R_world_point[take, 0], found.touch.any(1), found.active, side)
        for side in (1.0, -1.0)
    ]
    poses = dict(zip(("object", *CANONICAL), (found.pose, *canonical_poses)))
    floor = torch.zeros(len(motion)) if recording.floor is None else recording.floor.height
    values = {
        "R_world_point": R_world_point[take],
        "t_world_point": t_world_point[take],
        "floor_height": floor[take].float(),
        "R_parent_joint": motion.R_parent_joint[take],
        "t_world_root": motion.t_world_root[take],
        "contact": torch.cat([found.touch, foot_patches(recording)[take]], 1),
        "object": found.active.int(),
        **{f"{kind}_world_{name}": getattr(T, kind) for name, T in poses.items() for kind in "Rt"},
    }
    constants = {"t_parent_joint": bones_in_parts(motion.skeleton), "size": size_in_parts(motion.skeleton)}
    rows = [_described(shape) for shape in found.shapes]
    none = torch.zeros(0, 2, reader.features.object_condition_size + MOMENTS)
    return Track(values, constants, {"object": torch.stack(rows) if rows else none})


class FoundObjects(NamedTuple):
    """A recording's objects, and at some of its frames the active one."""

    shapes: list[ObjectShape]
    active: Int64[Tensor, "time"]
    """Index of the active object in `shapes`, `NO_OBJECT` without one."""
    pose: Rigid
    """Pose of the active object's centre; the identity without one."""
    touch: Bool[Tensor, "time point"]
    """Which points of the body touch it."""


def found_objects(
    recording: Recording,
    environment: Environment | None,
    reader: ObjectReader,
    take: Int64[Tensor, "time"],
    within_m: float,
) -> FoundObjects:
    """The objects that are handled in a recording, at its frames `take`; contact is a distance of at most `within_m` (m)."""
    motion = recording.motion
    assert motion is not None
    spans = true_spans(recording) if environment is not None and recording.object_motion else []
    names = list(dict.fromkeys(span.object for span in spans))
    shapes = [reader(environment.by_name(name)) for name in names] if environment is not None else []
    # The body's surface takes a quarter of a second, and is asked for where there is something to touch alone.
    surface = contact_points(anny_body(motion.skeleton, recording.shape or None)) if shapes else None
    active = active_at(spans, names, motion.timestamps[take])
    R, t = torch.eye(3).repeat(len(take), 1, 1), torch.zeros(len(take), 3)
    touch = torch.zeros(len(take), BODY_POINTS, dtype=torch.bool)
    for number, shape in enumerate(shapes):
        rows = (active == number).nonzero()[:, 0]
        if not len(rows) or environment is None or surface is None:
            continue
        # The motion and an object's trajectory share their clock; an object without one stays where it was.
        track, still = recording.object_motion.get(names[number]), environment.by_name(names[number]).T_world_object
        if track is None:
            T = Rigid(still.R.expand(len(rows), 3, 3), still.t.expand(len(rows), 3))
        else:
            T = track.T_world_body[take[rows]]
        T = shape.centred(T)
        R[rows], t[rows] = T.R, T.t
        skin = surface.vertices(motion.T_world_joint[take[rows]])
        touch[rows] = body_contact(skin, shape, T, within_m)
    return FoundObjects(shapes, active, Rigid(R, t), touch)


def _described(shape: ObjectShape) -> Float[Tensor, "side value"]:
    """Code, mean and second moment of an object, as it is and mirrored along its own y axis."""
    flip = torch.tensor(MIRROR)
    mean, spread = shape.cloud.mean(0), shape.cloud.mT @ shape.cloud / len(shape.cloud)
    own = torch.cat([shape.code, mean, spread.flatten()])
    return torch.stack(
        [own, torch.cat([shape.code_mirrored, mean * flip, (spread * torch.outer(flip, flip)).flatten()])]
    )


def canonical(
    T_world_object: Rigid,
    objects: list[ObjectShape],
    R_world_head: Float[Tensor, "time 3 3"],
    touched: Bool[Tensor, "time"],
    active: Int64[Tensor, "time"],
    side: float = 1.0,
) -> Rigid:
    """Poses of the active object's centre that look the same and that a network can know: of all orientations that are alike
    by the object's symmetry, the one nearest to the wearer's heading when the object is first touched, for as long as it is
    active.

    The heading is turned by `ASKEW_DEG` to the left (`side` 1) or right (-1, for mirrored windows), as objects are often
    held along or across it, and the choice must not lie on an edge.
    """
    R, t = T_world_object.R.clone(), T_world_object.t.clone()
    askew = torch.tensor(side * ASKEW_DEG).deg2rad()
    begins = [0, *(active.diff().nonzero()[:, 0] + 1).tolist(), len(active)]
    for start, stop in pairwise(begins):
        if active[start] == NO_OBJECT:
            continue
        shape = objects[int(active[start])]
        first = start + int(touched[start:stop].float().argmax())
        heading = rotation.about_axis("z", rotation.yaw_of(R_world_head[first]) + askew)
        before = shape.of_mesh(T_world_object[first])
        # The turn in the mesh's axes that this moment asks for is the whole span's.
        turn = before.to(torch.float64).inverse() @ shape.symmetry.nearest(before, heading)
        pose = shape.centred(shape.of_mesh(T_world_object[start:stop]).to(torch.float64) @ turn)
        R[start:stop], t[start:stop] = pose.R.to(R), pose.t.to(t)
    return Rigid(R, t)


class EchoContent(Content):
    """Windows of recordings whose frame rates are integer multiples of the model's.

    Recordings without objects are of humans alone.
    """

    any_body = own_rate = True
    sensed = frozenset({"R_world_point", "t_world_point", "floor_height"})
    parts = frozenset({"t_world_point", "t_parent_joint", "size"})
    jumps: ClassVar[dict[str, str]] = {
        f"{kind}_world_{name}": "object" for name in ("object", *CANONICAL) for kind in "Rt"
    }

    def __init__(
        self,
        features: EchoFeatures,
        encoder: PointNeXt | str | None = "object_encoder",
        within_m: float = TOUCH_M,
        objects: bool = True,
        canonical: bool = True,
        view: HandsInView | None = None,
    ):
        """`view`: where wrists are found, for features with `gaps`; None: everywhere. `encoder` is a checkpoint of experiment=object_encoder, or another PointNeXt; None: no shape feature.

        A body point is in contact within `within_m` of the object's surface. With `objects` False all recordings are of
        humans alone. `canonical`: objects' poses that nobody observed are to be found modulo their symmetry (ours). Raises WearcapError when the checkpoint is missing, damaged or another network's.
        """
        self.features, self.within_m, self.objects, self.canonical = features, within_m, objects, canonical
        self.view = view if features.gaps else None
        if isinstance(encoder, str):
            encoder = load_network(encoder, PointNeXt, "object_encoder", part="net.encoder").requires_grad_(False)
        self.encoder = encoder
        self._reader = ObjectReader(features, self.encoder)

    def settings(self) -> Any:
        return self.features, self.encoder, self.within_m, self.objects

    def min_frames(self, window: int, stretch: float) -> int:
        return 2 * MIN_FRAMES

    def usable(self, store: RecordingStore, name: str) -> bool:
        return on_level_ground(RecordingFile(store.path_of(name)))

    def twins(self, file: RecordingFile) -> dict[str, list[int]]:
        joints = joint_twins(file.part("motion").skeleton)
        points = {"R_world_point": TWIN_POINTS, "t_world_point": TWIN_POINTS}
        return {"R_parent_joint": joints, "t_parent_joint": joints, "contact": TWIN_CONTACTS} | points

    def track(self, store: RecordingStore, name: str, recording: Recording, every: int) -> Track:
        file = recording.environment if self.objects else None
        environment = None if file is None else _environment(store.root / file)
        return echo_track(recording, environment, self._reader, every, self.within_m)

    def batch(self, batch: Batch) -> EchoWindow:
        """The windows with their objects' codes and moments, and the numbers that their diffusion draws."""
        values, draws = dict(batch.values), batch.draws
        row, flipped = values.pop("object"), batch.mirrored
        side = torch.zeros_like(batch.track) if flipped is None else flipped.long()
        described = batch.packed.tables["object"][row, side[:, None]]
        code, mean, spread = described.split([described.shape[-1] - MOMENTS, 3, 9], -1)
        spread = spread.unflatten(-1, (3, 3))
        if (scale := batch.scale) is not None:
            first = len(self.features.classes)
            code[..., first : first + EXTENTS] *= scale[:, None, None]
            mean, spread = mean * scale[:, None, None], spread * scale.square()[:, None, None, None]
        for kind in "Rt":
            own, other = (values.pop(f"{kind}_world_{name}") for name in CANONICAL)
            which = side.bool().reshape(-1, *[1] * (own.ndim - 1))
            known = torch.where(which, other, own) if self.canonical else values[f"{kind}_world_object"]
            values[f"{kind}_world_canonical"] = known
        values["contact"] = values["contact"].float()
        t_world_point = values["t_world_point"]
        seen = torch.ones_like(t_world_point[..., 0], dtype=torch.bool)
        if self.view is not None:
            T_world_head = Rigid(values["R_world_point"][:, :, 0], t_world_point[:, :, 0])
            seen[..., 1:] = self.view(T_world_head, t_world_point[:, :, 1:], batch)
        return EchoWindow(
            **values,
            seen=seen,
            has_object=row != NO_OBJECT,
            object_code=code,
            object_mean=mean,
            object_spread=spread,
            valid=batch.valid,
            noise=draws.normal("noise", batch.count, self.features.human_size + OBJECT_SIZE + CONTACTS),
            level_draws=draws.uniform("levels", batch.count, 4),
            draws=draws.uniform("draws", DRAWS),
        )


_environment = cache(read_environment)
