"""Training windows of MocapEvery's estimator: head and wrist inputs with the ground-truth motion."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.data.batch import Batch
from wearcap.data.bodies import bones_in_parts, head_in_parts, places_in_parts, size_in_parts
from wearcap.data.features import on_level_ground, true_foot_contact
from wearcap.data.packing import Track, require_rows
from wearcap.data.transforms import joint_twins
from wearcap.data.windows import Content
from wearcap.recording import Recording
from wearcap.recording.store import RecordingFile, RecordingStore
from wearcap.systems.mocap_every.features import WRISTS, Sensed, watch_acceleration


class WatchWindow(NamedTuple):
    """A batch of windows."""

    R_world_head: Float[Tensor, "batch time 3 3"]
    t_world_head: Float[Tensor, "batch time 3"]
    R_world_wrist: Float[Tensor, "batch time wrist 3 3"]
    acc_world_wrist: Float[Tensor, "batch time wrist 3"]
    t_world_wrist: Float[Tensor, "batch time wrist 3"]
    floor_height: Float[Tensor, "batch time"]
    size: Float[Tensor, "batch limb"]
    """`body_size` of the wearer (m)."""
    R_parent_joint: Float[Tensor, "batch time joint 3 3"]
    t_world_root: Float[Tensor, "batch time 3"]
    t_parent_joint: Float[Tensor, "batch joint 3"]
    foot_contact: Float[Tensor, "batch time foot"]
    """1 where heel or toes of the left and right foot touch the floor."""

    @property
    def sensed(self) -> Sensed:
        return Sensed(*self[:5])


class WatchContent(Content):
    """Windows of a head stream and of watches synthesised on the true motion (the paper's protocol, eq. 8)."""

    any_body = True
    sensed = frozenset({*Sensed._fields, "floor_height"})
    parts = frozenset({"t_world_head", "t_world_wrist", "acc_world_wrist", "t_parent_joint", "size"})

    def usable(self, store: RecordingStore, name: str) -> bool:
        return on_level_ground(RecordingFile(store.path_of(name)))

    def twins(self, file: RecordingFile) -> dict[str, list[int]]:
        sides = ("R_world_wrist", "acc_world_wrist", "t_world_wrist", "foot_contact")
        joints = joint_twins(file.part("motion").skeleton)
        return {"R_parent_joint": joints, "t_parent_joint": joints} | {key: [1, 0] for key in sides}

    def track(self, store: RecordingStore, name: str, recording: Recording, every: int) -> Track:
        motion, head = recording.motion, recording.head
        assert motion is not None
        assert head is not None
        require_rows({"head": head.timestamps, "motion": motion.timestamps}, store.path_of(name))
        body, wrists = motion.T_world_joint, motion.skeleton.indices(*WRISTS)
        t_world_wrist = places_in_parts(motion, WRISTS)
        values = {
            "R_world_head": head.T_world_head.R,
            "t_world_head": head_in_parts(motion, head.T_world_head.t),
            "R_world_wrist": body.R[:, wrists],
            "acc_world_wrist": watch_acceleration(t_world_wrist, motion.fps, every),
            "t_world_wrist": t_world_wrist,
            "floor_height": torch.zeros(len(motion)) if recording.floor is None else recording.floor.height.float(),
            "R_parent_joint": motion.R_parent_joint,
            "t_world_root": motion.t_world_root,
            "foot_contact": true_foot_contact(recording),
        }
        constants = {"t_parent_joint": bones_in_parts(motion.skeleton), "size": size_in_parts(motion.skeleton)}
        return Track(values, constants)

    def batch(self, batch: Batch) -> WatchWindow:
        return WatchWindow(**batch.values | {"foot_contact": batch.values["foot_contact"].float()})
