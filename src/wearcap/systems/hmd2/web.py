"""HMD²'s windows as one graph for a page in a browser: poses of head and wrists in, rotations of the joints out.

Features, normalisation, the step and the blending of successive windows are in the graph, and the pipeline's own. A page
brings what a session does around a window: frames, their noise, forward kinematics, refinement.
"""

from dataclasses import asdict, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from wearcap.body.skeleton import FEET, WRISTS
from wearcap.data.features import LIMBS, body_size
from wearcap.data.surroundings import hand_features
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.runtime.graphs import Exports, Graph, skeleton_to_json
from wearcap.systems.hmd2.pipeline import HMD2
from wearcap.systems.hmd2.windows import Frames, Predicted


class WindowGraph(nn.Module):
    """Rotations, contacts and deviations of a window (`Predicted`), side by side, with hands as the one other condition."""

    def __init__(self, pipeline: HMD2):
        super().__init__()
        self.pipeline, self.net = pipeline, pipeline.model.net

    def forward(
        self,
        head_rotation: Float[Tensor, "batch time 3 3"],
        head_position: Float[Tensor, "batch time 3"],
        floor_height: Float[Tensor, "batch time"],
        wrist_rotation: Float[Tensor, "batch time 2 3 3"],
        wrist_position: Float[Tensor, "batch time 2 3"],
        seen: Bool[Tensor, "batch time 2"],
        valid: Bool[Tensor, "batch time"],
        size: Float[Tensor, "batch limb"],
        noise: Float[Tensor, "batch time feature"],
        joint_rotation: Float[Tensor, "batch time joint 3 3"],
        foot_contact: Float[Tensor, "batch time foot"],
        is_final: Bool[Tensor, "batch time"],
    ) -> Float[Tensor, "batch time value"]:
        # Exporters write names in small letters: R_world_head is head_rotation.
        T_world_head, T_world_wrist = Rigid(head_rotation, head_position), Rigid(wrist_rotation, wrist_position)
        hands, given = hand_features(T_world_head, T_world_wrist, seen), seen.any(-1)
        zeros, features = torch.zeros_like(floor_height), self.pipeline.model.features
        others = [
            hands if name == "hands" else zeros[..., None].expand(-1, -1, width)
            for name, width in self.net.conditions.items()
        ]
        known = [given if name == "hands" else torch.zeros_like(given) for name in self.net.conditions]
        frames = Frames(
            zeros,
            head_rotation,
            head_position,
            floor_height,
            torch.cat([hands[..., :0], *others], -1),
            torch.stack(known, -1) if known else given[..., None][..., :0],
            valid,
        )
        deviations = zeros[..., None].expand(-1, -1, features.motion_size - features.pose_size)
        before = Predicted(joint_rotation, foot_contact, deviations, torch.cat([noise, deviations], -1)[:, :, None])
        R, contact, std = self.pipeline.window_poses(frames, before, is_final, size)
        return torch.cat([R.flatten(2), contact, std], -1)


def exports(pipeline: HMD2) -> Exports:
    """The window's graph, and what a page needs to know of the network and its windows.

    Raises WearcapError for windows of several steps, which one graph does not hold.
    """
    sampling, features = pipeline.sampling, pipeline.model.features
    if sampling.steps != 1 or sampling.guidance != 1.0 or pipeline.overlap.inpaint:
        what = f"windows of {sampling.steps} steps, guidance {sampling.guidance}"
        raise WearcapError(
            what, expected="one step without guidance or inpainting", fix="Leave the pipeline's sampling."
        )
    pipeline = replace(pipeline, runtime="eager", precision="float32", use=["hands"], live=True)
    pipeline.prepare()
    random, shape = torch.Generator().manual_seed(0), (1, pipeline.window)
    eye = torch.eye(3).expand(*shape, 1, 3, 3)
    inputs = {
        "head_rotation": eye[:, :, 0].clone(),
        "head_position": torch.rand(*shape, 3, generator=random),
        "floor_height": torch.zeros(shape),
        "wrist_rotation": eye.repeat(1, 1, len(WRISTS), 1, 1),
        "wrist_position": torch.rand(*shape, len(WRISTS), 3, generator=random),
        "seen": torch.rand(*shape, len(WRISTS), generator=random) < 0.7,
        "valid": torch.arange(pipeline.window).expand(1, -1) < pipeline.window - 3,
        "size": body_size(pipeline.model.skeleton)[None],
        "noise": torch.randn(*shape, features.pose_size, generator=random),
        "joint_rotation": eye.repeat(1, 1, features.joints, 1, 1),
        "foot_contact": torch.rand(*shape, FEET, generator=random),
        "is_final": torch.arange(pipeline.window).expand(1, -1) < pipeline.window // 2,
    }
    refinement = pipeline.refinement
    about: dict[str, Any] = {
        "window": pipeline.window,
        "stride": pipeline.advance,
        "lookahead": pipeline.lookahead_frames,
        "fps": pipeline.fps,
        "latency_s": pipeline.latency_s,
        "pose_size": features.pose_size,
        "deviations": features.motion_size - features.pose_size,
        "joint_dof": pipeline.model.joint_dof,
        "limbs": LIMBS,
        "skeleton": skeleton_to_json(pipeline.model.skeleton),
        "refinement": None if refinement is None else asdict(refinement),
    }
    return Exports("hmd2", {"window": Graph(WindowGraph(pipeline), inputs, shared=tuple(inputs))}, about)
