"""Training windows of MocapEvery's estimator: head and wrist inputs with the ground-truth motion."""

from dataclasses import dataclass

import torch
from torch import Tensor

from benchmarks.rivals.single_windows.bodies import OtherPerson
from benchmarks.rivals.single_windows.transforms import Cut, Draws, Window, joint_twins
from benchmarks.rivals.single_windows.windows import Content, open_recording
from wearcap.data.features import body_size, on_level_ground, true_foot_contact
from wearcap.recording.store import RecordingFile, RecordingStore
from wearcap.systems.mocap_every.features import Sensed, synthetic_wrists
from wearcap.systems.mocap_every.training_windows import WatchWindow


@dataclass(frozen=True, eq=False)
class _WatchTrack:
    """Inputs and ground truth of a whole recording by the names of `WatchWindow`, at the recording's frame rate."""

    values: dict[str, Tensor]
    constants: dict[str, Tensor]
    twins: dict[str, list[int]]


class WatchContent(Content):
    """Windows of a head stream and of watches synthesised on the true motion (the paper's protocol, eq. 8).

    Inputs of a recording are computed at its first use and kept: 0.8 GB for four hours at 60 Hz.
    """

    draws = ("shift", "mirror", "yaw", "begins", "begin", "speed", "scale")
    any_body = True

    def usable(self, store: RecordingStore, name: str) -> bool:
        return on_level_ground(open_recording(store.path_of(name)))

    def open(self, store: RecordingStore, name: str, every: int, person: OtherPerson | None = None) -> _WatchTrack:
        file = RecordingFile(store.path_of(name))
        recording = file.load() if person is None else person.recording(file)
        motion, head = recording.motion, recording.head
        assert motion is not None
        assert head is not None
        wrists = synthetic_wrists(motion.skeleton, motion.R_parent_joint, motion.t_world_root, motion.fps, every)
        floor = recording.floor.height if recording.floor is not None else torch.zeros(len(motion))
        values = {
            **Sensed(head.T_world_head.R, head.T_world_head.t, *wrists)._asdict(),
            "floor_height": floor.float(),
            "R_parent_joint": motion.R_parent_joint,
            "t_world_root": motion.t_world_root,
            "foot_contact": true_foot_contact(recording).float(),
        }
        constants = {"size": body_size(motion.skeleton), "t_parent_joint": motion.skeleton.t_parent_joint}
        sides = ("R_world_wrist", "acc_world_wrist", "t_world_wrist", "foot_contact")
        joints = dict.fromkeys(("R_parent_joint", "t_parent_joint"), joint_twins(motion.skeleton))
        return _WatchTrack(values, constants, joints | {key: [1, 0] for key in sides})

    def read(self, track: _WatchTrack, cut: Cut, random: Draws) -> Window:
        sensed = (*Sensed._fields, "floor_height")
        values = {name: cut.take(name, part, sensed=name in sensed, smooth=True) for name, part in track.values.items()}
        return Window(values | track.constants, track.twins)

    def item(self, track: _WatchTrack, cut: Cut, window: Window, random: Draws) -> WatchWindow:
        return WatchWindow(**window.values)
