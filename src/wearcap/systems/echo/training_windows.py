"""Training windows for ECHO: three tracked points with ground-truth body, active object and contacts."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.utils.data import Dataset

from wearcap.body.anny_body import anny_body
from wearcap.body.contact_points import TOUCH_M, contact_points, mirrored_points
from wearcap.body.skeleton import FOOT_PATCHES, Skeleton
from wearcap.data.datamodule import SeededWindows
from wearcap.data.features import body_size
from wearcap.data.windows import MIRROR, Source, joint_twins, mirrored_rotations, requested, share_out
from wearcap.diffusion.levels import DRAWS
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.io.formats.environment import read_environment
from wearcap.models.point_encoder import PointNeXt, load_object_encoder
from wearcap.recording.acts import NO_OBJECT, active_at, true_acts
from wearcap.recording.recording import Recording
from wearcap.recording.store import RecordingFile, RecordingStore
from wearcap.scene.environment import Environment
from wearcap.systems.echo.features import CONTACTS, OBJECT_SIZE, POINTS, Body, EchoFeatures, ThreePoints
from wearcap.systems.echo.objects import ObjectReader, ObjectShape, body_contact, foot_patches, object_poses

MIN_FRAMES = 6
"""Length of the shortest training window (frames)."""


class EchoWindow(NamedTuple):
    """One window, or a batch of them (a leading "batch" axis on every field); frames beyond the end are padding."""

    R_world_point: Float[Tensor, "*batch time point 3 3"]
    t_world_point: Float[Tensor, "*batch time point 3"]
    floor_height: Float[Tensor, "*batch time"]
    size: Float[Tensor, "*batch limb"]
    """`body_size` of the wearer (m)."""
    t_parent_joint: Float[Tensor, "*batch joint 3"]
    R_parent_joint: Float[Tensor, "*batch time joint 3 3"]
    t_world_root: Float[Tensor, "*batch time 3"]
    contact: Float[Tensor, "*batch time contact"]
    """64 body points on the active object, then `FOOT_PATCHES` on the floor: 1 for contact."""
    has_object: Bool[Tensor, "*batch time"]
    """Whether an object is active; otherwise object pose and body contacts are arbitrary."""
    object_code: Float[Tensor, "*batch time code"]
    """Class, extents and feature of the active object (`ObjectShape.code`)."""
    R_world_object: Float[Tensor, "*batch time 3 3"]
    t_world_object: Float[Tensor, "*batch time 3"]
    object_mean: Float[Tensor, "*batch time 3"]
    object_spread: Float[Tensor, "*batch time 3 3"]
    """Mean (m) and second moment (m²) of the object's points about its centre (`ObjectShape`)."""
    valid: Bool[Tensor, "*batch time"]
    """False for padding."""
    noise: Float[Tensor, "*batch time feature"]
    level_draws: Float[Tensor, "*batch time 4"]
    draws: Float[Tensor, "*batch draw"]
    """Diffusion noise and uniform draws for noise levels: functions of seed and step, whatever the worker process."""

    @property
    def points(self) -> ThreePoints:
        """The three tracked points."""
        return ThreePoints(self.R_world_point, self.t_world_point)

    @property
    def body(self) -> Body:
        """The ground-truth body."""
        return Body(self.R_parent_joint, self.t_world_root)

    @property
    def T_world_object(self) -> Rigid:
        """The ground-truth pose of the active object's centre."""
        return Rigid(self.R_world_object, self.t_world_object)


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


def three_points(recording: Recording, take: Tensor) -> ThreePoints:
    """The measured head and the ground-truth wrists at frames `take` of the motion.

    Recordings without a head stream of the motion's length get the ground-truth head.
    """
    motion, head = recording.motion, recording.head
    assert motion is not None
    body = motion.T_world_joint
    chosen = motion.skeleton.indices(*POINTS)
    R, t = body.R[take][:, chosen].clone(), body.t[take][:, chosen].clone()
    if head is not None and len(head.timestamps) == len(motion):
        T_world_head = head.T_world_head[take]
        R[:, 0], t[:, 0] = T_world_head.R, T_world_head.t
    return ThreePoints(R, t)


def echo_track(
    recording: Recording, environment: Environment | None, reader: ObjectReader, every: int, within_m: float
) -> EchoTrack:
    """Every `every`-th frame of a recording with ground truth; contact is a distance of at most `within_m` (m)."""
    motion = recording.motion
    assert motion is not None
    take = torch.arange(0, len(motion), every)
    times = motion.timestamps[take]
    points = three_points(recording, take)
    surface = contact_points(anny_body(motion.skeleton, recording.shape or None))
    acts = true_acts(recording) if environment is not None and recording.object_motion else []
    names = list(dict.fromkeys(act.object for act in acts))
    objects = [reader(environment.by_name(name)) for name in names] if environment is not None else []
    active = active_at(acts, names, times)
    R, t = torch.eye(3).repeat(len(take), 1, 1), torch.zeros(len(take), 3)
    contact = torch.zeros(len(take), CONTACTS)
    for number, shape in enumerate(objects):
        rows = (active == number).nonzero()[:, 0]
        if not len(rows) or environment is None:
            continue
        T = object_poses(recording, environment, names[number], shape, take[rows])
        R[rows], t[rows] = T.R, T.t
        skin = surface.vertices(motion.T_world_joint[take[rows]])
        contact[rows, : CONTACTS - len(FOOT_PATCHES)] = body_contact(skin, shape, T, within_m).float()
    contact[:, CONTACTS - len(FOOT_PATCHES) :] = foot_patches(recording)[take].float()
    floor = recording.floor.height[take] if recording.floor is not None else torch.zeros(len(take))
    return EchoTrack(
        points,
        floor.float(),
        motion.skeleton,
        body_size(motion.skeleton),
        Body(motion.R_parent_joint[take], motion.t_world_root[take]),
        contact,
        objects,
        active,
        Rigid(R, t),
    )


class EchoDataset(Dataset):
    """Windows of one split of one or more data sets whose frame rates are integer multiples of the model's.

    Recordings without objects are of humans alone. An item's index is (window, seed), or the window alone. Tracks are
    built on first access and cached.
    """

    def __init__(
        self,
        sources: list[Source],
        split: str,
        *,
        features: EchoFeatures,
        encoder: PointNeXt | None,
        window: int,
        stride: int,
        mirror: bool = False,
        balance: float = 1.0,
        beginnings: float = 0.0,
        within_m: float = TOUCH_M,
        objects: bool = True,
    ):
        """`beginnings` is the share of windows that are not full, as the first and last ones of a capture; with
        `objects` False all recordings are of humans alone."""
        self.features, self.encoder = features, encoder
        self.window, self.stride, self.mirror = window, stride, mirror
        self.beginnings, self.within_m, self.objects = beginnings, within_m, objects
        self._reader = ObjectReader(features, encoder)
        self._tracks: dict[int, EchoTrack] = {}
        self.recordings: list[tuple[RecordingStore, str, int]] = []
        starts, weights = [], []
        for source in sources:
            every = _every(source, split, features.fps)
            rows, first, share = share_out(
                [source],
                split,
                window=window * every,
                stride=stride * every,
                fps=features.fps * every,
                balance=balance,
                min_frames=2 * MIN_FRAMES * every,
            )
            first = torch.stack([first[:, 0] + len(self.recordings), first[:, 1] // every, first[:, 2] // every], 1)
            self.recordings += [(store, name, every) for store, name in rows]
            starts.append(first)
            weights.append(share)
        self.starts, self.weights = torch.cat(starts), torch.cat(weights)

    def __len__(self) -> int:
        return len(self.starts)

    def track(self, number: int) -> EchoTrack:
        """The track of a whole recording, by its index in `recordings`."""
        if number not in self._tracks:
            self._tracks[number] = self._read_track(number)
        return self._tracks[number]

    def _read_track(self, number: int) -> EchoTrack:
        store, name, every = self.recordings[number]
        recording = RecordingFile(store.path_of(name)).load()
        file = recording.environment if self.objects else None
        environment = None if file is None else _environment(store.root / file)
        return echo_track(recording, environment, self._reader, every, self.within_m)

    def __getitem__(self, item: tuple[int, int] | int) -> EchoWindow:
        index, random = requested(item)
        number, start, frames = self.starts[index].tolist()
        shift, mirrored, cut, end = torch.rand(4, generator=random).tolist()
        if self.mirror:
            start = min(start + int(shift * self.stride), max(frames - self.window, 0))
        length = self.window if cut >= self.beginnings else MIN_FRAMES + int(end * (self.window - MIN_FRAMES))
        mirrored = self.mirror and mirrored < 0.5
        track = self.track(number)
        window = self._cut(track, start, length, mirrored, random)
        return mirror_window(window, track.skeleton) if mirrored else window

    def _cut(self, track: EchoTrack, start: int, length: int, mirrored: bool, random: torch.Generator) -> EchoWindow:
        """Frames start…start+length-1, padded to a full window by repeating the last one; with the codes of the
        mirrored objects if the window will be mirrored."""
        stop = min(start + length, len(track.floor_height))
        take = start + torch.arange(self.window).clamp_max(stop - start - 1)
        active = track.active[take]
        nothing = (torch.zeros(self.features.object_condition_size), torch.zeros(3), torch.zeros(3, 3))
        shapes = [
            (shape.code_mirrored if mirrored else shape.code, shape.mean, shape.spread) for shape in track.objects
        ]
        code, mean, spread = (torch.stack(rows)[active] for rows in zip(*shapes, nothing))
        noise = torch.randn(self.window, self.features.human_size + OBJECT_SIZE + CONTACTS, generator=random)
        return EchoWindow(
            track.points.R_world_point[take],
            track.points.t_world_point[take],
            track.floor_height[take],
            track.size,
            track.skeleton.t_parent_joint,
            track.body.R_parent_joint[take],
            track.body.t_world_root[take],
            track.contact[take],
            active != NO_OBJECT,
            code,
            track.T_world_object.R[take],
            track.T_world_object.t[take],
            mean,
            spread,
            torch.arange(self.window) < stop - start,
            noise,
            torch.rand(self.window, 4, generator=random),
            torch.rand(DRAWS, generator=random),
        )


def _every(source: Source, split: str, fps: float) -> int:
    """Frames of a data set per frame of the model. Raises WearcapError for a rate that is not an integer multiple."""
    store = RecordingStore.open(source.root)
    rates = {store.entries[name].fps for name in store.names(split)}
    rate = next(iter(rates), fps)
    if len(rates) > 1 or abs(rate / fps - round(rate / fps)) > 0.01:
        raise WearcapError(
            f"recordings of {', '.join(f'{each:g}' for each in sorted(rates))} frames per second",
            where=source.root,
            expected=f"one rate that is a whole multiple of {fps:g}",
            fix="Prepare the data set at such a rate.",
        )
    return round(rate / fps)


def mirror_window(window: EchoWindow, skeleton: Skeleton) -> EchoWindow:
    """The window mirrored left to right; object codes are those of the mirrored objects already.

    An object is also mirrored along its own y axis, so that its pose stays a rotation.
    """
    flip = torch.tensor(MIRROR)
    turn = torch.outer(flip, flip)
    points = [0, 2, 1]
    patches = [len(mirrored_points()) + k for k in (2, 3, 0, 1)]
    return window._replace(
        R_world_point=window.R_world_point[:, points] * turn,
        t_world_point=window.t_world_point[:, points] * flip,
        t_parent_joint=window.t_parent_joint[joint_twins(skeleton)] * flip,
        R_parent_joint=mirrored_rotations(window.R_parent_joint, skeleton),
        t_world_root=window.t_world_root * flip,
        contact=window.contact[:, [*mirrored_points().tolist(), *patches]],
        R_world_object=window.R_world_object * turn,
        t_world_object=window.t_world_object * flip,
        object_mean=window.object_mean * flip,
        object_spread=window.object_spread * turn,
    )


@cache
def _environment(path: Path) -> Environment:
    return read_environment(path)


class EchoWindows(SeededWindows):
    """Windows for Lightning."""

    def __init__(
        self,
        sources: dict[str, dict | None],
        features: EchoFeatures,
        window: int,
        stride: int,
        batch_size: int,
        steps_per_epoch: int | None = None,
        val_windows: int | None = None,
        workers: int = 0,
        seed: int = 0,
        augment: bool = True,
        balance: float = 1.0,
        beginnings: float = 0.0,
        within_m: float = TOUCH_M,
        objects: bool = True,
        encoder: PointNeXt | str | None = "object_encoder",
        val_sources: dict[str, dict | None] | None = None,
    ):
        """See `SeededWindows` and `EchoDataset`; augmentation is for training alone.

        `encoder` is a checkpoint of experiment=object_encoder, or another PointNeXt; None: no shape feature.
        """
        super().__init__(sources, batch_size, steps_per_epoch, val_windows, workers, seed, val_sources)
        self.features, self.window, self.stride = features, window, stride
        self.encoder = load_object_encoder(encoder) if isinstance(encoder, str) else encoder
        self.augment, self.balance, self.beginnings = augment, balance, beginnings
        self.within_m, self.objects = within_m, objects

    def dataset(self, split: str) -> EchoDataset:
        """Windows of a split."""
        train = split == "train"
        return EchoDataset(
            self.sources if train else self.val_sources,
            split,
            features=self.features,
            encoder=self.encoder,
            window=self.window,
            stride=self.stride,
            mirror=self.augment and train,
            balance=self.balance if train else 1.0,
            beginnings=self.beginnings if train else 0.0,
            within_m=self.within_m,
            objects=self.objects,
        )
