"""Training windows of MocapEvery's estimator: head and wrist inputs with the ground-truth motion."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.data.bodies import OtherPerson
from wearcap.data.features import body_size, on_level_ground, true_foot_contact
from wearcap.data.transforms import Cut, Draws, Window, joint_twins
from wearcap.data.windows import Content, open_recording
from wearcap.recording.store import RecordingFile, RecordingStore
from wearcap.systems.mocap_every.features import Sensed, synthetic_wrists


class WatchWindow(NamedTuple):
    """One window, or a batch of them (a leading "batch" axis on every field)."""

    R_world_head: Float[Tensor, "*batch time 3 3"]
    t_world_head: Float[Tensor, "*batch time 3"]
    R_world_wrist: Float[Tensor, "*batch time wrist 3 3"]
    acc_world_wrist: Float[Tensor, "*batch time wrist 3"]
    t_world_wrist: Float[Tensor, "*batch time wrist 3"]
    floor_height: Float[Tensor, "*batch time"]
    size: Float[Tensor, "*batch limb"]
    """`body_size` of the wearer (m)."""
    R_parent_joint: Float[Tensor, "*batch time joint 3 3"]
    t_world_root: Float[Tensor, "*batch time 3"]
    t_parent_joint: Float[Tensor, "*batch joint 3"]
    foot_contact: Float[Tensor, "*batch time foot"]
    """1 where heel or toes of the left and right foot touch the floor."""

    @property
    def sensed(self) -> Sensed:
        return Sensed(*self[:5])


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
