"""Training windows for ECHO: three tracked points with ground-truth body, active object and contacts."""

from dataclasses import dataclass
from functools import cache, cached_property

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from benchmarks.rivals.single_windows.bodies import OtherPerson
from benchmarks.rivals.single_windows.transforms import Cut, Draws, Window, joint_twins
from benchmarks.rivals.single_windows.windows import Content, Windows, open_recording
from wearcap.body.anny_body import anny_body
from wearcap.body.contact_points import TOUCH_M, contact_points
from wearcap.body.skeleton import FOOT_PATCHES, MIRROR, Skeleton
from wearcap.data.features import body_size, on_level_ground
from wearcap.diffusion.levels import DRAWS
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
from wearcap.systems.echo.training_windows import EchoWindow, canonical

MIN_FRAMES = 6
"""Length of the shortest training window (frames)."""
CANONICAL = "canonical", "canonical_mirrored"
"""Names of the objects' canonical poses, for windows as they are and for mirrored ones."""


@dataclass(frozen=True, eq=False)
class EchoTrack:
    """Conditioning and ground truth of a whole recording at the model's rate."""

    points: ThreePoints
    floor_height: Float[Tensor, "time"]
    skeleton: Skeleton
    size: Float[Tensor, "limb"]
    body: Body
    contact: Float[Tensor, "time contact"]
    objects: list[ObjectShape]
    active: Int64[Tensor, "time"]
    """Index of the active object in `objects`, -1 without one."""
    T_world_object: Rigid
    """Pose of the active object's centre; the identity without one."""
    T_world_canonical: tuple[Rigid, Rigid]
    """The same, or other poses that look the same (`canonical`): for the windows as they are, and for mirrored ones."""

    @cached_property
    def twins(self) -> dict[str, list[int]]:
        """What a mirror exchanges: joints, wrists, points of the body, heels and toe tips."""
        joints = joint_twins(self.skeleton)
        points = {"R_world_point": TWIN_POINTS, "t_world_point": TWIN_POINTS}
        return {"R_parent_joint": joints, "t_parent_joint": joints, "contact": TWIN_CONTACTS} | points

    @classmethod
    def read(
        cls, recording: Recording, environment: Environment | None, reader: ObjectReader, every: int, within_m: float
    ) -> "EchoTrack":
        """Every `every`-th frame of a recording with ground truth; contact is a distance of at most `within_m` (m).

        The head is the measured one, or without a head stream of the motion's length the ground truth; wrists are true.
        """
        motion, head = recording.motion, recording.head
        assert motion is not None
        take = torch.arange(0, len(motion), every)
        times, body = motion.timestamps[take], motion.T_world_joint
        chosen = motion.skeleton.indices(*POINTS)
        points = ThreePoints(body.R[take][:, chosen].clone(), body.t[take][:, chosen].clone())
        if head is not None and len(head.timestamps) == len(motion):
            T_world_head = head.T_world_head[take]
            points.R_world_point[:, 0], points.t_world_point[:, 0] = T_world_head.R, T_world_head.t
        spans = true_spans(recording) if environment is not None and recording.object_motion else []
        names = list(dict.fromkeys(span.object for span in spans))
        objects = [reader(environment.by_name(name)) for name in names] if environment is not None else []
        # The body's surface takes a quarter of a second, and is asked for where there is something to touch alone.
        surface = contact_points(anny_body(motion.skeleton, recording.shape or None)) if objects else None
        active = active_at(spans, names, times)
        R, t = torch.eye(3).repeat(len(take), 1, 1), torch.zeros(len(take), 3)
        contact = torch.zeros(len(take), CONTACTS)
        for number, shape in enumerate(objects):
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
            skin = surface.vertices(body[take[rows]])
            contact[rows, : CONTACTS - len(FOOT_PATCHES)] = body_contact(skin, shape, T, within_m).float()
        first = points.R_world_point[:, 0], (contact > 0).any(1), active
        alike = [canonical(Rigid(R, t), objects, *first, side) for side in (1.0, -1.0)]
        contact[:, CONTACTS - len(FOOT_PATCHES) :] = foot_patches(recording)[take].float()
        floor = recording.floor.height[take] if recording.floor is not None else torch.zeros(len(take))
        wearer = floor.float(), motion.skeleton, body_size(motion.skeleton)
        truth = Body(motion.R_parent_joint[take], motion.t_world_root[take])
        return cls(points, *wearer, truth, contact, objects, active, Rigid(R, t), (alike[0], alike[1]))


class EchoContent(Content):
    """Windows of recordings whose frame rates are integer multiples of the model's.

    Recordings without objects are of humans alone. Tracks are built at the first use of a recording and kept.
    """

    draws = ("shift", "mirror", "ends", "end")
    any_body = True

    def __init__(
        self,
        features: EchoFeatures,
        encoder: PointNeXt | str | None = "object_encoder",
        within_m: float = TOUCH_M,
        objects: bool = True,
        canonical: bool = True,
    ):
        """`encoder` is a checkpoint of experiment=object_encoder, or another PointNeXt; None: no shape feature.

        A body point is in contact within `within_m` of the object's surface. With `objects` False all recordings are of
        humans alone. `canonical`: objects' poses that nobody observed are to be found modulo their symmetry (ours). Raises WearcapError when the checkpoint is missing, damaged or another network's.
        """
        self.features, self.within_m, self.objects, self.canonical = features, within_m, objects, canonical
        if isinstance(encoder, str):
            encoder = load_network(encoder, PointNeXt, "object_encoder", part="net.encoder").requires_grad_(False)
        self.encoder = encoder
        self._reader = ObjectReader(features, self.encoder)

    def min_frames(self, window: int, stretch: float) -> int:
        return 2 * MIN_FRAMES

    def usable(self, store: RecordingStore, name: str) -> bool:
        return on_level_ground(open_recording(store.path_of(name)))

    def open(self, store: RecordingStore, name: str, every: int, person: OtherPerson | None = None) -> EchoTrack:
        opened = RecordingFile(store.path_of(name))
        recording = opened.load() if person is None else person.recording(opened)
        file = recording.environment if self.objects else None
        environment = None if file is None else _environment(store.root / file)
        return EchoTrack.read(recording, environment, self._reader, every, self.within_m)

    def cut(self, track: EchoTrack, start: int, frames: int, every: int, windows: Windows) -> Cut:
        latest = max(frames // every - windows.window, 0)
        length = len(track.floor_height)
        return Cut(start // every, windows.window, length, windows.stride, latest=latest, stretch=windows.stretch)

    def read(self, track: EchoTrack, cut: Cut, random: Draws) -> Window:
        poses = {"object": track.T_world_object, **dict(zip(CANONICAL, track.T_world_canonical))}
        poses = {f"{kind}_world_{name}": getattr(T, kind) for name, T in poses.items() for kind in "Rt"}
        true = track.body._asdict() | {"contact": track.contact} | poses
        values = {name: cut.take(name, part) for name, part in true.items()}
        low, high, _ = cut.between()
        changes = track.active[low] != track.active[high]
        for name in poses:
            # Nothing is between the poses of two objects.
            values[name][changes] = true[name][cut.frames[changes]]
        R, t, _ = track.points
        sensed = {"R_world_point": R, "t_world_point": t, "floor_height": track.floor_height}
        values |= {name: cut.take(name, part, sensed=True) for name, part in sensed.items()}
        values |= {"size": track.size, "t_parent_joint": track.skeleton.t_parent_joint}
        return Window(values, track.twins)

    def item(self, track: EchoTrack, cut: Cut, window: Window, random: Draws) -> EchoWindow:
        """The window with its objects' codes and moments, and the numbers that its diffusion draws.

        A mirrored object is mirrored along its own y axis, so that its pose stays a rotation.
        """
        active = track.active[cut.frames]
        nothing = (torch.zeros(self.features.object_condition_size), torch.zeros(3), torch.zeros(3, 3))
        shapes = [
            (s.code_mirrored if window.mirrored else s.code, s.cloud.mean(0), s.cloud.mT @ s.cloud / len(s.cloud))
            for s in track.objects
        ]
        code, mean, spread = (torch.stack(rows)[active] for rows in zip(*shapes, nothing))
        if window.mirrored:
            flip = torch.tensor(MIRROR)
            mean, spread = mean * flip, spread * torch.outer(flip, flip)
        if window.scale != 1:
            code[:, len(self.features.classes) :][:, :EXTENTS] *= window.scale
            mean, spread = mean * window.scale, spread * window.scale**2
        features = self.features.human_size + OBJECT_SIZE + CONTACTS
        chosen = CANONICAL[window.mirrored] if self.canonical else "object"
        values = {name: value for name, value in window.values.items() if not name.endswith(CANONICAL)}
        values |= {f"{kind}_world_canonical": window.values[f"{kind}_world_{chosen}"] for kind in "Rt"}
        return EchoWindow(
            **values,
            seen=torch.ones(values["t_world_point"].shape[:-1], dtype=torch.bool),
            has_object=active != NO_OBJECT,
            object_code=code,
            object_mean=mean,
            object_spread=spread,
            valid=cut.valid,
            noise=torch.randn(cut.count, features, generator=random.generator),
            level_draws=torch.rand(cut.count, 4, generator=random.generator),
            draws=torch.rand(DRAWS, generator=random.generator),
        )


_environment = cache(read_environment)
