"""Training windows of HMD² and of its baseline: head paths with the true pose and what surrounds the wearer."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.rivals.single_windows.bodies import OtherPerson
from benchmarks.rivals.single_windows.surroundings import ConditionWindows
from benchmarks.rivals.single_windows.transforms import Cut, Draws, Window, joint_twins
from benchmarks.rivals.single_windows.windows import Content, open_recording
from wearcap.body.skeleton import FEET
from wearcap.data.features import body_size, on_level_ground, true_foot_contact
from wearcap.errors import WearcapError
from wearcap.recording.store import RecordingFile, RecordingStore
from wearcap.systems.hmd2.conditions import CONDITIONS, side_by_side
from wearcap.systems.hmd2.training_windows import HeadWindow
from wearcap.tracking.floor import floor_from_path, floor_from_points

MIN_FRAMES = 30
"""Fewest frames of a recording that is trained on."""


@dataclass(frozen=True, eq=False)
class _HeadTrack:
    """A recording's open file, and by the names of `HeadWindow` small values per frame and those of all windows."""

    store: RecordingStore
    name: str
    file: RecordingFile
    R_head_device: Float[Tensor, "3 3"]
    values: dict[str, Tensor]
    constants: dict[str, Tensor]
    twins: dict[str, list[int]]
    surrounded: bool
    """Whether what surrounds it belongs to this body."""


class HeadContent(Content):
    """Windows of head paths and motions, with other conditions by their names."""

    draws = ("shift", "mirror", "ends", "end")
    any_body = True

    def __init__(self, conditions: Mapping[str, ConditionWindows] | None = None):
        self.conditions = dict(conditions or {})

    def prepare(self, stores: Sequence[RecordingStore], split: str) -> None:
        for condition in self.conditions.values():
            condition.prepare(stores, split)

    def min_frames(self, window: int, stretch: float) -> int:
        return MIN_FRAMES

    def usable(self, store: RecordingStore, name: str) -> bool:
        file = open_recording(store.path_of(name))
        return "points.points_world" in file.keys or on_level_ground(file)

    def open(self, store: RecordingStore, name: str, every: int, person: OtherPerson | None = None) -> _HeadTrack:
        file = open_recording(store.path_of(name))
        if file.length("head.timestamps") != file.length("motion.timestamps"):
            what, fix = "head and motion have different lengths", "Prepare the recording again."
            raise WearcapError(what, where=file.path, expected="both on one clock", fix=fix)
        recording = file.load() if person is None else person.recording(file)
        head, motion = recording.head, recording.motion
        assert head is not None
        assert motion is not None
        stature, t_world_head = motion.skeleton.height_of("head"), head.T_world_head.t
        from_path = floor_from_path(head.timestamps, t_world_head, stature)
        from_points = floor_from_points(recording.points, t_world_head, stature)
        values = {
            "t_world_head": t_world_head,
            "floor_height": from_path if from_points is None else from_points,
            "floor_from_head": from_path,
            "foot_contact": true_foot_contact(recording).float(),
        }
        constants = {"t_parent_joint": motion.skeleton.t_parent_joint, "size": body_size(motion.skeleton)}
        twins = dict.fromkeys(("R_parent_joint", "t_parent_joint"), joint_twins(motion.skeleton))
        twins |= {"foot_contact": [1, 0]}
        return _HeadTrack(store, name, file, head.R_head_device, values, constants, twins, surrounded=person is None)

    def read(self, track: _HeadTrack, cut: Cut, random: Draws) -> Window:
        start, stop = cut.bounds
        R_world_head = track.file.window("head.R_world_device", start, stop) @ track.R_head_device.mT
        local = track.file.window("motion.R_parent_joint", start, stop)
        values = {
            "R_parent_joint": cut.take("R_parent_joint", local, start),
            "R_world_head": cut.take("R_world_head", R_world_head, start, sensed=True),
        }
        values |= {name: cut.take(name, part, sensed=name != "foot_contact") for name, part in track.values.items()}
        return Window(values | track.constants, track.twins)

    def item(self, track: _HeadTrack, cut: Cut, window: Window, random: Draws) -> HeadWindow:
        """Raises WearcapError where a condition was scaled that does not follow."""
        metric = [name for name, condition in self.conditions.items() if condition.metric]
        if window.scale != 1 and metric:
            fix = f"Leave out transforms.scale, or {', '.join(metric)} (surroundings=head)."
            raise WearcapError(f"codes of {metric[0]} cannot be scaled", fix=fix)
        start, stop = cut.bounds
        read = [one.read(track.store, track.name, start, stop, window.mirrored) for one in self.conditions.values()]
        others, given = side_by_side(read, stop - start)
        frames = cut.frames - start
        return HeadWindow(
            **window.values,
            valid=cut.valid,
            others=others[frames],
            given=given[frames] & track.surrounded,
            noise=torch.randn(cut.count, 6 * len(track.constants["t_parent_joint"]) + FEET, generator=random.generator),
            level=torch.rand(1, generator=random.generator),
            chance=torch.rand(len(CONDITIONS) + 1, generator=random.generator),
        )
