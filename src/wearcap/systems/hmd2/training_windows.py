"""Training windows of HMD² and of its baseline: head paths with the true pose and what surrounds the wearer."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import FEET, Skeleton
from wearcap.data.batch import Batch
from wearcap.data.bodies import bones_in_parts, head_in_parts, size_in_parts
from wearcap.data.features import on_level_ground, true_foot_contact
from wearcap.data.packing import Track, require_rows
from wearcap.data.surroundings import ConditionWindows
from wearcap.data.transforms import joint_twins
from wearcap.data.windows import Content
from wearcap.errors import WearcapError
from wearcap.recording import Recording
from wearcap.recording.store import RecordingFile, RecordingStore
from wearcap.systems.hmd2.conditions import CONDITIONS
from wearcap.tracking.floor import floor_from_path, floor_from_points

MIN_FRAMES = 30
"""Fewest frames of a recording that is trained on."""


class HeadWindow(NamedTuple):
    """A batch of windows; frames beyond a clip are padding."""

    R_parent_joint: Float[Tensor, "batch time joint 3 3"]
    R_world_head: Float[Tensor, "batch time 3 3"]
    t_world_head: Float[Tensor, "batch time 3"]
    floor_height: Float[Tensor, "batch time"]
    """Floor height (m) below the head, from points if there are any, else from the head's path."""
    floor_from_head: Float[Tensor, "batch time"]
    """Floor height (m) below the head, from the head's path alone."""
    valid: Bool[Tensor, "batch time"]
    t_parent_joint: Float[Tensor, "batch joint 3"]
    size: Float[Tensor, "batch limb"]
    """`body_size` of the wearer (m)."""
    foot_contact: Float[Tensor, "batch time foot"]
    """1 where heel or toes of the left and right foot touch the floor."""
    others: Float[Tensor, "batch time feature"]
    given: Bool[Tensor, "batch time condition"]
    """The other conditions: see `model.Conditions`."""
    noise: Float[Tensor, "batch time motion"]
    level: Float[Tensor, "batch 1"]
    chance: Float[Tensor, "batch choice"]
    """Diffusion noise and level, and uniform random numbers that decide on dropping each of `CONDITIONS` and on
    self-conditioning; drawn here so that they depend on seed and step, not on the process."""

    def joints_from_head(
        self, skeleton: Skeleton, R_parent_joint: Float[Tensor, "batch frame joint 3 3"]
    ) -> Float[Tensor, "batch frame joint 3"]:
        """Joint positions relative to the head joint (m) of the wearers of a batch, in poses such as predicted ones."""
        origin = torch.zeros_like(R_parent_joint[:, :, 0, 0])
        joints = forward_kinematics(skeleton, R_parent_joint, origin, self.t_parent_joint[:, None]).t
        return joints - joints[:, :, skeleton.index("head"), None]


class HeadContent(Content):
    """Windows of head paths and motions, with other conditions by their names."""

    any_body = True
    sensed = frozenset({"R_world_head", "t_world_head", "floor_height", "floor_from_head"})
    parts = frozenset({"t_world_head", "t_parent_joint", "size"})

    def __init__(self, conditions: Mapping[str, ConditionWindows] | None = None):
        self.conditions = dict(conditions or {})
        self.sensed = HeadContent.sensed.union(*(each.sensed for each in self.conditions.values()))
        self.parts = HeadContent.parts.union(*(each.parts for each in self.conditions.values()))

    def prepare(self, stores: Sequence[RecordingStore], split: str) -> None:
        for condition in self.conditions.values():
            condition.prepare(stores, split)

    def settings(self) -> Any:
        return {name: condition.key for name, condition in self.conditions.items()}

    def min_frames(self, window: int, stretch: float) -> int:
        return MIN_FRAMES

    def usable(self, store: RecordingStore, name: str) -> bool:
        file = RecordingFile(store.path_of(name))
        return "points.points_world" in file.keys or on_level_ground(file)

    def twins(self, file: RecordingFile) -> dict[str, list[int]]:
        joints = joint_twins(file.part("motion").skeleton)
        own = {"R_parent_joint": joints, "t_parent_joint": joints, "foot_contact": [1, 0]}
        for each in self.conditions.values():
            own |= each.twins
        return own

    def track(self, store: RecordingStore, name: str, recording: Recording, every: int) -> Track:
        head, motion = recording.head, recording.motion
        assert head is not None
        assert motion is not None
        require_rows({"head": head.timestamps, "motion": motion.timestamps}, store.path_of(name))
        stature, T_world_head = motion.skeleton.height_of("head"), head.T_world_head
        from_path = floor_from_path(head.timestamps, T_world_head.t, stature)
        from_points = floor_from_points(recording.points, T_world_head.t, stature)
        own = [condition.track(key, store, recording, name) for key, condition in self.conditions.items()]
        values = {
            "R_parent_joint": motion.R_parent_joint,
            "R_world_head": T_world_head.R,
            "t_world_head": head_in_parts(motion, T_world_head.t),
            "floor_height": from_path if from_points is None else from_points,
            "floor_from_head": from_path,
            "foot_contact": true_foot_contact(recording),
        }
        constants = {"t_parent_joint": bones_in_parts(motion.skeleton), "size": size_in_parts(motion.skeleton)}
        for each in own:
            values |= each.values
        return Track(values, constants, {name: table for each in own for name, table in each.tables.items()})

    def batch(self, batch: Batch) -> HeadWindow:
        """Raises WearcapError where a condition was scaled that does not follow."""
        metric = [name for name, condition in self.conditions.items() if condition.metric]
        if batch.scale is not None and metric:
            fix = f"Leave out transforms.scale, or {', '.join(metric)} (surroundings=head)."
            raise WearcapError(f"codes of {metric[0]} cannot be scaled", fix=fix)
        values, draws = dict(batch.values), batch.draws
        found = [condition.read(name, batch, values) for name, condition in self.conditions.items()]
        none = torch.zeros(*batch.valid.shape, 0, device=batch.device)
        given = torch.stack([shown for _, shown in found], -1) if found else none.bool()
        if batch.others is not None:
            others = batch.others[:, None]
            values["floor_height"] = torch.where(others, values["floor_from_head"], values["floor_height"])
        values["foot_contact"] = values["foot_contact"].float()
        return HeadWindow(
            **values,
            valid=batch.valid,
            others=torch.cat([none, *(features for features, _ in found)], -1),
            given=given,
            noise=draws.normal("noise", batch.count, 6 * values["R_parent_joint"].shape[2] + FEET),
            level=draws.uniform("level", 1),
            chance=draws.uniform("chance", len(CONDITIONS) + 1),
        )
