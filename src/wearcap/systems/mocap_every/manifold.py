"""MocapEvery's motion manifold: a convolutional autoencoder of contacts, root and joint rotations (§3.4, D.4)."""

from typing import NamedTuple

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

from wearcap.body.skeleton import FEET
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.models.layers import Normalizer


class Posed(NamedTuple):
    """Windows of motion in the world, and X: their features in a canonical frame (§3.4)."""

    R_parent_joint: Float[Tensor, "batch time joint 3 3"]
    t_world_root: Float[Tensor, "batch time 3"]
    foot_contact: Float[Tensor, "batch time foot"]

    def origin(self) -> Rigid:
        """Canonical frame of each window, "batch 1": position and heading of its first root. The paper uses the root's
        full pose; ours is yaw-aligned, so z stays up."""
        yaw = rotation.yaw_of(self.R_parent_joint[:, :1, 0])
        return Rigid(rotation.about_axis("z", yaw), self.t_world_root[:, :1])

    def encode(self, origin: Rigid) -> Float[Tensor, "batch time feature"]:
        """X: 5 + 6 per joint features (137 with 22 joints) of contacts, root translation and 6D rotations."""
        R_origin_world = origin.R.mT
        root = (R_origin_world @ (self.t_world_root - origin.t)[..., None])[..., 0]
        R = torch.cat([(R_origin_world @ self.R_parent_joint[:, :, 0])[:, :, None], self.R_parent_joint[:, :, 1:]], 2)
        rotations = rearrange(rotation.rot6d_from_matrix(R), "batch time joint entry -> batch time (joint entry)")
        return torch.cat([self.foot_contact, root, rotations], -1)

    @classmethod
    def decode(cls, X: Float[Tensor, "batch time feature"], origin: Rigid) -> "Posed":
        """The inverse of `encode`; predicted contacts are not clipped to 0…1."""
        rotations = rearrange(X[..., FEET + 3 :], "batch time (joint entry) -> batch time joint entry", entry=6)
        R = rotation.matrix_from_rot6d(rotations)
        R = torch.cat([(origin.R @ R[:, :, 0])[:, :, None], R[:, :, 1:]], 2)
        root = origin.t + (origin.R @ X[..., FEET : FEET + 3, None])[..., 0]
        return cls(R, root, X[..., :FEET])


class MotionManifold(nn.Module):
    """Strided convolutions over time and a transposed decoder (the paper: 3 layers, width 25, stride 2, 256 channels).

    Frames have `size` features: contact of both feet, root translation, 6D rotations (137 with 22 joints). A window's
    number of frames must be a multiple of 2 to the power of `layers`.
    """

    def __init__(self, size: int, channels: int = 256, width: int = 25, layers: int = 3):
        super().__init__()
        self.size, self.normalizer = size, Normalizer(size)
        half = width // 2
        down: list[nn.Module] = []
        up: list[nn.Module] = []
        for layer in range(layers):
            inner, outer = channels, size if layer == 0 else channels
            down += [nn.Conv1d(outer, inner, width, 2, half), nn.LeakyReLU(0.2)]
            up = [nn.ConvTranspose1d(inner, outer, width, 2, half, output_padding=1), *up]
            if layer < layers - 1:
                up = [nn.LeakyReLU(0.2), *up]
        self.encoder, self.decoder = nn.Sequential(*down[:-1]), nn.Sequential(*up)

    def encode(self, motion: Float[Tensor, "batch time feature"]) -> Float[Tensor, "batch channel short"]:
        """Latents z of motions (raw features)."""
        return self.encoder(rearrange(self.normalizer(motion), "batch time feature -> batch feature time"))

    def decode(self, latent: Float[Tensor, "batch channel short"]) -> Float[Tensor, "batch time feature"]:
        """Motions (raw features) of latents."""
        return self.normalizer.inverse(rearrange(self.decoder(latent), "batch feature time -> batch time feature"))

    def forward(self, motion: Float[Tensor, "batch time feature"]) -> Float[Tensor, "batch time feature"]:
        return self.decode(self.encode(motion))
