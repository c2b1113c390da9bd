"""Augmentation of head camera frames: light and colours, the camera's rotation on the head, mirror images.

Images are normalised and have the encoder's size; random numbers come from torch's default generator.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from wearcap.geometry import rotation
from wearcap.systems.hmd2.egoview_frames import POINTS

_SWAPPED = [index ^ 1 for index in range(len(POINTS))]
"""Index of each point's counterpart on the other side; left and right alternate in `POINTS`."""


def relit(pictures: Float[Tensor, "batch 3 height width"]) -> Float[Tensor, "batch 3 height width"]:
    """Images with random gain, shift, channel mixing and noise, drawn per image."""
    like = pictures[:, :1, :1, :1]
    mix = torch.eye(3, device=pictures.device) + 0.3 * torch.randn(len(pictures), 3, 3, device=pictures.device)
    mix = mix / mix.sum(-1, keepdim=True).clamp_min(0.3)
    pictures = (mix @ pictures.flatten(2)).unflatten(2, pictures.shape[2:])
    gain, shift = (0.25 * torch.randn_like(like)).exp(), 0.3 * torch.randn_like(like)
    noise = 0.15 * torch.rand_like(like) * torch.randn_like(pictures)
    return (gain * pictures + shift + noise).clamp(-2.0, 2.4)


def turned(
    pictures: Float[Tensor, "batch 3 height width"],
    intrinsics: Float[Tensor, "batch 4"],
    point_cam: Float[Tensor, "batch point 3"],
    visible: Bool[Tensor, "batch point"],
    deviation_deg: float,
) -> tuple[Float[Tensor, "batch 3 height width"], Float[Tensor, "batch point 3"], Bool[Tensor, "batch point"]]:
    """Images and points as seen by a slightly rotated camera, with angles of `deviation_deg` per axis.

    `intrinsics` are fx, fy, cx, cy of the images (lens distortion is ignored, as rotations are small). Areas outside
    the original image are grey, and points there are not visible.
    """
    height, width = pictures.shape[2:]
    axis = math.radians(deviation_deg) * torch.randn(len(pictures), 3, device=pictures.device)
    R = rotation.exp(axis)
    focal, centre = intrinsics[:, None, :2], intrinsics[:, None, 2:]
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    pixels = torch.stack([x, y], -1).reshape(1, -1, 2).to(pictures)
    ray = F.pad((pixels - centre) / focal, (0, 1), value=1.0) @ R  # by the inverse of R, row by row
    source = ray[..., :2] / ray[..., 2:].clamp_min(0.1) * focal + centre
    size = pictures.new_tensor([width, height])
    grid = ((2 * source + 1) / size - 1).unflatten(1, (height, width))
    moved = point_cam @ R.transpose(1, 2)
    drawn = moved[..., :2] / moved[..., 2:].clamp_min(1e-3) * focal + centre
    inside = ((drawn >= -0.5) & (drawn < size - 0.5)).all(-1) & (moved[..., 2] > 0)
    return F.grid_sample(pictures, grid, align_corners=False), moved, visible & inside


def half_mirrored(
    pictures: Float[Tensor, "batch 3 height width"],
    point_cam: Float[Tensor, "batch point 3"],
    visible: Bool[Tensor, "batch point"],
) -> tuple[Float[Tensor, "batch 3 height width"], Float[Tensor, "batch point 3"], Bool[Tensor, "batch point"]]:
    """A random half of the images flipped horizontally, with left and right points exchanged."""
    flip = torch.rand(len(pictures), device=pictures.device) < 0.5
    across = point_cam.new_tensor([-1.0, 1.0, 1.0])
    return (
        torch.where(flip[:, None, None, None], pictures.flip(-1), pictures),
        torch.where(flip[:, None, None], point_cam[:, _SWAPPED] * across, point_cam),
        torch.where(flip[:, None], visible[:, _SWAPPED], visible),
    )
