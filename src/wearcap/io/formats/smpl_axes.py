"""Conversion from SMPL's axes, only here: rotation vectors to wearcap's rotation matrices, coefficients by name.

SMPL's joint frames are x left, y up, z forward; wearcap's x forward, y left, z up. With A rotating the former into the latter, a
joint's rotation is A · R · Aᵀ and the root's R · Aᵀ, in the world of the file.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.geometry import rotation
from wearcap.io.formats.npz import require

A = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], dtype=torch.float64)
"""Rotation of SMPL's axes into wearcap's."""


def rotations_from_smpl(rotvec: Float64[Tensor, "time joint 3"]) -> Float64[Tensor, "time joint 3 3"]:
    """R_parent_joint from SMPL's rotation vectors (rad), the root first."""
    R = rotation.exp(rotvec)
    return torch.cat([R[:, :1] @ A.T, A @ R[:, 1:] @ A.T], 1)


def shape_from_betas(betas: Sequence[float] | Float[np.ndarray, "beta"]) -> dict[str, float]:
    """SMPL's coefficients by their names in a recording's `shape`: beta_0 …"""
    return {f"beta_{k}": float(beta) for k, beta in enumerate(betas)}


def shape_from_arrays(arrays: dict[str, np.ndarray], where: str | Path) -> dict[str, float]:
    """The shape of a file whose `betas`, if it has any, are one person's. Raises WearcapError where they are no numbers."""
    if "betas" not in arrays:
        return {}
    betas = {"betas": arrays["betas"].reshape(-1)}
    require(betas, where, betas=("feature",))
    return shape_from_betas(betas["betas"])
