"""Two-bone inverse kinematics in closed form, batched over whole motions."""

import torch
from jaxtyping import Float
from torch import Tensor


def swing_between(a: Float[Tensor, "*#batch 3"], b: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The smallest rotation that turns direction a onto direction b (any lengths; opposite ones: half a turn)."""
    a, b = torch.broadcast_tensors(a, b)
    a, b = torch.nn.functional.normalize(a, dim=-1), torch.nn.functional.normalize(b, dim=-1)
    cos = (a * b).sum(-1)[..., None, None]
    v = torch.linalg.cross(a, b)
    zero = torch.zeros_like(v[..., 0])
    K = torch.stack([zero, -v[..., 2], v[..., 1], v[..., 2], zero, -v[..., 0], -v[..., 1], v[..., 0], zero], -1)
    K = K.unflatten(-1, (3, 3))
    eye = torch.eye(3, dtype=a.dtype, device=a.device)
    swing = eye + K + K @ K / (1 + cos).clamp_min(1e-6)
    across = torch.linalg.cross(a, eye[a.abs().argmin(-1)])
    across = torch.nn.functional.normalize(across, dim=-1)[..., None]
    half_turn = 2 * across @ across.transpose(-1, -2) - eye
    return torch.where(cos < -1 + 1e-6, half_turn, swing)


def reach(
    start: Float[Tensor, "*batch 3"],
    middle: Float[Tensor, "*batch 3"],
    end: Float[Tensor, "*batch 3"],
    goal: Float[Tensor, "*batch 3"],
) -> tuple[Float[Tensor, "*batch 3 3"], Float[Tensor, "*batch 3 3"]]:
    """World rotations to left-multiply onto those of the upper and the lower bone so that `end` reaches `goal`.

    Bone lengths and the plane of the bend are kept; a goal out of reach is approached along its direction.
    """
    upper, lower = (middle - start).norm(dim=-1), (end - middle).norm(dim=-1)
    aim = goal - start
    distance = aim.norm(dim=-1)
    near, far = (upper - lower).abs() * 1.001 + 1e-9, upper + lower
    distance = torch.minimum(torch.maximum(distance, near), far)
    aim = torch.nn.functional.normalize(aim, dim=-1)
    # Turn the bend's plane with the limb before bending, so that a straight arm keeps its elbow's direction.
    turn = swing_between(end - start, aim)
    bend = (turn @ (middle - start)[..., None])[..., 0]
    bend = torch.nn.functional.normalize(bend - (bend * aim).sum(-1, keepdim=True) * aim, dim=-1)
    along = (distance**2 + upper**2 - lower**2) / (2 * distance)
    beside = (upper**2 - along**2).clamp_min(0).sqrt()
    elbow = start + along[..., None] * aim + beside[..., None] * bend
    hand = start + distance[..., None] * aim
    return swing_between(middle - start, elbow - start), swing_between(end - middle, hand - elbow)
