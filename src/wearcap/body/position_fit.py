"""A posed skeleton fitted to the places of joints in every frame at once: pelvis, spine, collars, neck, limbs, feet.

Rotations are changed by the smallest turns that bring each joint to its goal, root first, so that twists about bones,
and with them the continuity of the motion, stay those of the pose that is fitted.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.kinematics import forward_kinematics, local_rotations
from wearcap.body.landmarks import landmarks
from wearcap.body.skeleton import SIDES, Skeleton
from wearcap.geometry import rotation
from wearcap.geometry.rotation import swing_between

SPINE_STEPS = 6
"""Steps of the spine's least squares; the error falls below a millimetre in three."""
DAMPING = 1e-5
"""Damping (m²) of the spine's least squares, for spines that are stretched out."""


def fit_positions(
    skeleton: Skeleton,
    R_parent_joint: Float[Tensor, "time joint 3 3"],
    t_world_root: Float[Tensor, "time 3"],
    goals: dict[str, Float[Tensor, "time 3"]],
) -> tuple[Float[Tensor, "time joint 3 3"], Float[Tensor, "time 3"]]:
    """The pose with its joints at `goals` (m, by the skeleton's joint names; both hips at least), as near as bones reach.

    A bone points at its goal where it does not reach it.
    """
    marks = landmarks(skeleton)
    offsets = skeleton.t_parent_joint.double()
    goal = {skeleton.index(name): place.double() for name, place in goals.items()}
    R = forward_kinematics(skeleton, R_parent_joint.double(), t_world_root.double()).R.clone()
    left, right = (marks.limb[f"{side}_leg"][0] for side in SIDES)
    R[:, 0] = swing_between(R[:, 0] @ (offsets[left] - offsets[right]), goal[left] - goal[right]) @ R[:, 0]
    t_root = (goal[left] + goal[right]) / 2 - R[:, 0] @ ((offsets[left] + offsets[right]) / 2)

    def places() -> Tensor:
        return forward_kinematics(skeleton, local_rotations(skeleton, R), t_root).t

    follows_spine = [marks.neck[0] if marks.neck else marks.head, *(marks.limb[f"{side}_arm"][0] for side in SIDES)]
    _spine(R, places, marks.spine, [joint for joint in follows_spine if joint in goal], goal)
    for side in SIDES:
        collar, shoulder = marks.collar[side], marks.limb[f"{side}_arm"][0]
        if collar is not None:
            _aim(R, places(), [collar], shoulder, goal)
    if marks.neck:
        _aim(R, places(), list(marks.neck), marks.head, goal)
    for name, (first, second, third) in marks.limb.items():
        side = name.split("_")[0]
        twisted = {second, marks.forearm[side]} if name.endswith("arm") else {second}
        _aim(R, places(), [first], second, goal)
        _aim(R, places(), sorted(twisted), third, goal, second)
        toe = marks.toe[side]
        if name.endswith("leg") and toe is not None:
            _aim(R, places(), [third, toe], toe, goal, third)
    return local_rotations(skeleton, R).to(R_parent_joint), t_root.to(t_world_root)


def _spine(R: Tensor, places, spine: tuple[int, ...], rigid: list[int], goal: dict[int, Tensor]) -> None:
    """Bend the spine (in place) below its top joint, whose rotation stays, to bring shoulders and neck to their goals.

    Each step is the smallest set of rotations θ_k about the joints q_k that moves the top p by the mean error e:
    θ_k = (p − q_k) × λ with (Σ |r_k|² I − r_k r_kᵀ + μ I) λ = e.
    """
    *below, top = spine
    if not below or not rigid:
        return
    eye = torch.eye(3, dtype=R.dtype)
    for _ in range(SPINE_STEPS):
        t = places()
        error = torch.stack([goal[joint] - t[:, joint] for joint in rigid]).mean(0)
        arms = [t[:, top] - t[:, joint] for joint in below]
        normal = DAMPING * eye.expand(len(R), 3, 3)
        for arm in arms:
            normal = normal + (arm * arm).sum(-1)[:, None, None] * eye - arm[:, :, None] * arm[:, None, :]
        multiplier = torch.linalg.solve(normal, error)
        turns = [rotation.exp(_limited(torch.linalg.cross(arm, multiplier))) for arm in arms]
        turned = eye.expand(len(R), 3, 3)
        for joint, turn in zip(below, turns):  # a joint's turn carries all joints above it
            turned = turned @ turn
            R[:, joint] = turned @ R[:, joint]


def _limited(rotvec: Tensor, largest: float = 0.3) -> Tensor:
    """Rotation vectors of at most `largest` rad."""
    return rotvec * (largest / rotvec.norm(dim=-1, keepdim=True).clamp_min(largest))


def _aim(R: Tensor, t: Tensor, joints: list[int], end: int, goal: dict[int, Tensor], start: int | None = None) -> None:
    """Turn `joints` (in place) about `start` (the first of them) so that `end` points at its goal."""
    if end not in goal:
        return
    origin = t[:, joints[0] if start is None else start]
    turn = swing_between(t[:, end] - origin, goal[end] - origin)
    for joint in joints:
        R[:, joint] = turn @ R[:, joint]
