"""Rigid transforms, `T_a_b`: `p_a = T_a_b @ p_b`, and inner names meet when chained."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Rigid:
    """Pose of frame b in frame a, batched over leading axes; t in metres."""

    R: Float[Tensor, "*batch 3 3"]
    t: Float[Tensor, "*batch 3"]

    @classmethod
    def identity(cls, *batch: int, dtype: torch.dtype = torch.float32) -> "Rigid":
        """No rotation and no translation, of a batch's shape."""
        return cls(torch.eye(3, dtype=dtype).expand(*batch, 3, 3), torch.zeros(*batch, 3, dtype=dtype))

    @classmethod
    def from_matrix(cls, matrix: Float[Tensor, "*batch 4 4"]) -> "Rigid":
        """The pose that a homogeneous matrix holds."""
        return cls(matrix[..., :3, :3], matrix[..., :3, 3])

    def matrix(self) -> Float[Tensor, "*batch 4 4"]:
        """The pose as a homogeneous matrix."""
        top = torch.cat([self.R, self.t[..., None]], -1)
        bottom = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=top.dtype, device=top.device)
        return torch.cat([top, bottom.expand(*top.shape[:-2], 1, 4)], -2)

    def __matmul__(self, other):
        """Chain with a Rigid, or map points "*batch 3"; batch axes broadcast (clouds: `T[:, None] @ points`)."""
        if isinstance(other, Rigid):
            return self.chain(other)
        return (self.R @ other[..., None])[..., 0] + self.t

    def chain(self, other: "Rigid") -> "Rigid":
        """`self @ other`; what torch.compile should trace calls it, since operators of objects break its graphs."""
        return Rigid(self.R @ other.R, self @ other.t)

    def inverse(self) -> "Rigid":
        """Pose of a in b."""
        R_inverse = self.R.transpose(-1, -2)
        return Rigid(R_inverse, -(R_inverse @ self.t[..., None])[..., 0])

    def __getitem__(self, index) -> "Rigid":
        """Index the leading (batch) axes; no Ellipsis."""
        return Rigid(self.R[index], self.t[index])

    def to(self, *args, **kwargs) -> "Rigid":
        """As `Tensor.to`, of both parts."""
        return Rigid(self.R.to(*args, **kwargs), self.t.to(*args, **kwargs))
