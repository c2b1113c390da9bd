"""Baselines of HMD²: the mean pose, and the training window with the most similar head path.

Both have HMD²'s inputs (the head's path, the floor, the body's size) and are anchored to the measured head.
"""

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from wearcap.body.skeleton import Skeleton
from wearcap.data.windows import MIN_SCALE
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.recording import Motion, Recording, RecordingStore
from wearcap.runtime.system import Captured, CaptureInput, StageOptions, System
from wearcap.systems.hmd2.features import HeadFeatures
from wearcap.tracking.anchor import anchored_to_head
from wearcap.tracking.head_path import HeadPath, head_path

QUERY_BATCH = 256


class Baseline(System):
    """A method that is fitted to a training split and captures each recording by itself; seeds have no effect."""

    @classmethod
    @abstractmethod
    def fit(cls, stores: Sequence[RecordingStore]) -> "Baseline":
        """Fit to the training splits of data sets."""

    @abstractmethod
    def motion(self, recording: Recording) -> Motion:
        """Motion of one recording."""

    def capture(
        self, recordings: Sequence[Recording | CaptureInput], seeds: Sequence[int], options: StageOptions | None = None
    ) -> list[Captured]:
        """One capture per recording."""
        return [Captured(self.motion(CaptureInput.of(recording).recording)) for recording in recordings]


@dataclass(frozen=True, eq=False)
class MeanPose(Baseline):
    """One pose for every frame: the chordal mean over the training split, turned to the head's heading."""

    joint_names: tuple[str, ...]
    fps: float
    R_parent_joint: Float[Tensor, "joint 3 3"]
    """The root's entry is its rotation in the head's heading frame (yaw of the head, z up)."""

    @classmethod
    def fit(cls, stores: Sequence[RecordingStore]) -> "MeanPose":
        """Average the training splits. Raises WearcapError when they are empty or their skeletons differ."""
        total: Tensor = torch.zeros(())
        names, fps = (), 0.0
        for path, R_parent_joint in _training_motions(stores):
            total = total + _in_heading(R_parent_joint, path.T_world_head.R).double().sum(0)
            names, fps = path.skeleton.joint_names, _fps_of(path)
        return cls(names, fps, torch.stack([rotation.mean_rotation(R[None]) for R in total]).float())

    def motion(self, recording: Recording) -> Motion:
        """The mean pose anchored to the recording's head."""
        path = _query_path(recording, self.joint_names, self.fps)
        R = self.R_parent_joint.repeat(len(path.timestamps), 1, 1, 1)
        return _anchored(path, R, "mean_pose")


@dataclass(frozen=True, eq=False)
class NearestWindow(Baseline):
    """Pastes, for each window of the head's path, the poses of the training window with the nearest head path.

    Windows overlap by half and are cross-faded. A path is described in the frame of its window's first head (yaw and
    horizontal position removed), with the head's height as a share of the wearer's, sampled every `sample` frames;
    every channel is standardised, and the distance is Euclidean.
    """

    joint_names: tuple[str, ...]
    fps: float
    window: int
    sample: int
    mean: Float[Tensor, "channel"]
    scale: Float[Tensor, "channel"]
    descriptor: Float[Tensor, "window feature"]
    first_frame: Int64[Tensor, "window"]
    last_frame: Int64[Tensor, "window"]
    """Last frame of a window's recording; windows of shorter recordings repeat their last pose."""
    pose: Float[Tensor, "frame motion"]
    """6D rotations of all training frames, the root's in the head's heading frame; half precision."""

    @classmethod
    def fit(
        cls, stores: Sequence[RecordingStore], window_s: float = 1.0, stride_s: float = 0.05, sample_s: float = 0.1
    ) -> "NearestWindow":
        """Describe the training splits' windows, `stride_s` apart. Raises WearcapError as `MeanPose.fit` does.

        The defaults are the best of 0.5, 0.75, 1, 1.5, 2 and 4 s on the validation split of CMU.
        """
        channels, poses, first, last = [], [], [], []
        names, fps, window, sample, frames = (), 0.0, 0, 0, 0
        for path, R_parent_joint in _training_motions(stores):
            names, fps = path.skeleton.joint_names, _fps_of(path)
            window, sample = round(window_s * fps), max(1, round(sample_s * fps))
            starts = torch.arange(0, max(len(path.timestamps) - window, 0) + 1, max(1, round(stride_s * fps)))
            channels.append(_describe(path, starts, window, sample))
            R_heading = _in_heading(R_parent_joint, path.T_world_head.R)
            poses.append(rotation.rot6d_from_matrix(R_heading).flatten(-2).half())
            first.append(starts + frames)
            frames += len(path.timestamps)
            last.append(torch.full_like(starts, frames - 1))
        raw = torch.cat(channels)
        flat = raw.flatten(0, 1)
        mean, scale = flat.mean(0), flat.std(0).clamp_min(MIN_SCALE)
        descriptor = ((raw - mean) / scale).flatten(1)
        return cls(
            names, fps, window, sample, mean, scale, descriptor, torch.cat(first), torch.cat(last), torch.cat(poses)
        )

    def motion(self, recording: Recording) -> Motion:
        """The pasted motion anchored to the recording's head."""
        path = _query_path(recording, self.joint_names, self.fps)
        count = len(path.timestamps)
        end = max(count - self.window, 0)
        starts = torch.unique(torch.cat([torch.arange(0, end, max(1, self.window // 2)), torch.tensor([end])]))
        found = self.nearest(_describe(path, starts, self.window, self.sample))
        # Poses are cross-faded, each weighted by a triangle over its window.
        offset = torch.arange(self.window)
        source = torch.minimum(self.first_frame[found, None] + offset, self.last_frame[found, None])
        target = starts[:, None] + offset
        inside = target < count
        weight = (torch.minimum(offset + 1, self.window - offset).float() / self.window).expand_as(target)[inside]
        total = torch.zeros(count).index_add(0, target[inside], weight)
        blended = torch.zeros(count, self.pose.shape[1]).index_add(
            0, target[inside], self.pose[source[inside]].float() * weight[:, None]
        )
        pose = blended / total[:, None]
        return _anchored(path, rotation.matrix_from_rot6d(pose.unflatten(-1, (-1, 6))), "nearest_window")

    def nearest(self, raw: Float[Tensor, "query sample channel"]) -> Int64[Tensor, "query"]:
        """Index of the training window nearest to each described window."""
        query = ((raw - self.mean) / self.scale).flatten(1)
        half_squares = 0.5 * self.descriptor.square().sum(-1)
        return torch.cat([(part @ self.descriptor.T - half_squares).argmax(-1) for part in query.split(QUERY_BATCH)])


def _training_motions(stores: Sequence[RecordingStore]) -> Iterator[tuple[HeadPath, Tensor]]:
    """(head path, R_parent_joint) of every training recording, both at the recording's own frame rate."""
    first: tuple[tuple[str, ...], float] | None = None
    for store in stores:
        for name in store.names("train"):
            # Images, and clouds beside a known floor, are not read.
            file, fps = store.open_file(name), store.entries[name].fps
            floor = file.part("floor")
            points = file.part("points") if floor is None else None
            recording = Recording(name, head=file.part("head"), motion=file.part("motion"), floor=floor, points=points)
            if recording.head is None or recording.motion is None or len(recording.motion) < 2:
                continue
            path = head_path(recording, recording.motion.skeleton, fps)
            kind = (recording.motion.skeleton.joint_names, fps)
            first = first or kind
            if kind != first or len(path.timestamps) != len(recording.motion):
                what = f"recording {name!r} does not fit the others"
                expected = f"the joints of the first at {first[1]} Hz, head and motion on one clock"
                raise WearcapError(what, where=store.root, expected=expected, fix="Prepare the data sets alike.")
            yield path, recording.motion.R_parent_joint
    if first is None:
        what = "no training recordings with head and motion"
        where = ", ".join(str(store.root) for store in stores)
        raise WearcapError(what, where=where, expected="a training split of recordings with both")


def _fps_of(path: HeadPath) -> float:
    return round(1.0 / path.timestamps.diff().median().item(), 4)


def _query_path(recording: Recording, joint_names: tuple[str, ...], fps: float) -> HeadPath:
    skeleton: Skeleton | None = recording.skeleton or (recording.motion.skeleton if recording.motion else None)
    if skeleton is None or skeleton.joint_names != joint_names:
        what = "its skeleton is not the one of the training data"
        raise WearcapError(what, where=recording.name, expected=f"joints {', '.join(joint_names)}")
    return head_path(recording, skeleton, fps)


def _in_heading(
    R_parent_joint: Float[Tensor, "time joint 3 3"], R_world_head: Float[Tensor, "time 3 3"]
) -> Float[Tensor, "time joint 3 3"]:
    """Local rotations, the root's relative to the head's heading."""
    R_heading_world = rotation.about_axis("z", -rotation.yaw_of(R_world_head))
    return torch.cat([(R_heading_world @ R_parent_joint[:, 0])[:, None], R_parent_joint[:, 1:]], 1)


def _describe(
    path: HeadPath, starts: Int64[Tensor, "window"], window: int, sample: int
) -> Float[Tensor, "window sample channel"]:
    """Head features (thesis §6.1) of windows of one path, every `sample`-th frame of each."""
    frames = (starts[:, None] + torch.arange(window)).clamp_max(len(path.timestamps) - 1)
    features = HeadFeatures(frame="window", height="stature")
    stature = torch.full((len(starts), 1), path.stature)
    T_world_head = path.T_world_head[frames]
    channels = features.condition(T_world_head.R, T_world_head.t, path.floor_height[frames], stature, _fps_of(path))
    return channels[:, ::sample]


def _anchored(path: HeadPath, R_heading: Float[Tensor, "time joint 3 3"], name: str) -> Motion:
    """Rotate the root from the head's heading frame into the world and anchor the body to the head."""
    R_world_heading = rotation.about_axis("z", rotation.yaw_of(path.T_world_head.R))
    R = torch.cat([(R_world_heading @ R_heading[:, 0])[:, None], R_heading[:, 1:]], 1)
    origin = torch.zeros(len(path.timestamps), 3)
    motion = Motion(path.timestamps, path.skeleton, R, origin, provenance={"pipeline": name})
    return anchored_to_head(motion, path.T_world_head)


BASELINES: dict[str, type[Baseline]] = {"mean pose": MeanPose, "nearest window": NearestWindow}
"""Trivial methods by their names in tables."""
