"""Autoencoders of voxel grids of the points around the body (thesis §6.2.1, §6.4)."""

from itertools import pairwise

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional as F

from wearcap.errors import WearcapError
from wearcap.scene.voxels import VoxelGrid

_KERNELS = 4 * 2
"""Number of cells by which four convolutions of kernel 3 shorten an axis."""
_SEEN = 1e-4
"""Nearness above which a cell contains a point."""


class VoxelAutoencoder(nn.Module):
    """Grids of truncated distances (m) to codes and back, by `layers` of one of two kinds.

    "convolutions": the thesis's. "sparse": ours, which uses that few cells contain points.
    """

    def __init__(
        self,
        cells: int = 10,
        size_m: float = 2.0,
        below_m: float = 1.0,
        clip_m: float = 0.1,
        size: int = 128,
        layers: str = "sparse",
    ):
        """The grid's settings (see `VoxelGrid`), and the code's `size`. Raises WearcapError for other layers."""
        super().__init__()
        self.grid, self.size = VoxelGrid(cells, size_m, below_m, clip_m), size
        kinds = {"convolutions": _ConvolutionLayers, "sparse": _SparseLayers}
        if layers not in kinds:
            raise WearcapError(f"no layers {layers!r}", expected=f"one of {', '.join(kinds)}")
        self.layers = kinds[layers](cells, size)

    def encode(self, grids: Float[Tensor, "*batch x y z"]) -> Float[Tensor, "*batch feature"]:
        """Codes of grids of truncated distances (m)."""
        flat = self._nearness(grids).reshape(-1, *grids.shape[-3:])
        return self.layers.encode(flat).reshape(*grids.shape[:-3], self.size)

    def decode(self, code: Float[Tensor, "*batch feature"]) -> Float[Tensor, "*batch x y z"]:
        """Grids (m) decoded from codes, between 0 and `clip_m` (no point)."""
        nearness = self.layers.decode(code.reshape(-1, self.size)).clamp(0, 1)
        return self.grid.clip_m * (1 - nearness).reshape(*code.shape[:-1], *[self.grid.cells] * 3)

    def loss(self, grids: Float[Tensor, "batch x y z"]) -> Float[Tensor, ""]:
        """Reconstruction loss of grids."""
        return self.layers.loss(self._nearness(grids))

    def start_from(self, grids: Float[Tensor, "batch x y z"]) -> None:
        """Initialise the weights from some grids of a training split."""
        self.layers.start_from(self._nearness(grids))

    def _nearness(self, grids: Tensor) -> Tensor:
        """Nearness of grids: 1 for a point in the cell's centre, 0 for no point."""
        return 1 - grids / self.grid.clip_m


class _ConvolutionLayers(nn.Module):
    """Four convolutions and average pooling; four transposed convolutions back; plain squared error (thesis §6.4).

    Without padding 10 cells become 8, 6, 4 and 2 per side; the last are averaged, and decoding starts from as many.
    """

    def __init__(self, cells: int, size: int):
        super().__init__()
        left = cells - _KERNELS
        if left < 1:
            raise WearcapError(f"{cells} cells are too few for four convolutions", expected=f"at least {_KERNELS + 1}")
        widths = [1, *(max(1, size >> shift) for shift in (3, 2, 1, 0))]
        down, up = [], []
        for narrow, wide in pairwise(widths):
            down += [nn.Conv3d(narrow, wide, 3), nn.ReLU()]
            up = [nn.ConvTranspose3d(wide, narrow, 3), nn.ReLU(), *up]
        self.encoder = nn.Sequential(*down[:-1], nn.AvgPool3d(left), nn.Flatten())
        self.decoder = nn.Sequential(
            nn.Unflatten(1, (size, 1, 1, 1)), nn.Upsample(scale_factor=left), *up[:-1], nn.Flatten(1, 2)
        )

    def encode(self, nearness: Float[Tensor, "batch x y z"]) -> Float[Tensor, "batch feature"]:
        return self.encoder(nearness[:, None])

    def decode(self, code: Float[Tensor, "batch feature"]) -> Float[Tensor, "batch x y z"]:
        return self.decoder(code)

    def loss(self, nearness: Float[Tensor, "batch x y z"]) -> Float[Tensor, ""]:
        return F.mse_loss(self.decode(self.encode(nearness)), nearness)

    def start_from(self, nearness: Float[Tensor, "batch x y z"]) -> None:
        """Nothing to do: these weights are initialised at random."""


class _SparseLayers(nn.Module):
    """A linear code, decoded to a sparse grid in a few learned steps (LISTA, Gregor & LeCun 2010).

    A few tens of the 1000 cells contain a point; that many can be recovered from 128 linear measurements by thresholded
    gradient steps on the code's error. Measurements, steps and thresholds are learned, by binary cross-entropy for the
    cells that contain a point and squared error for its nearness. The measurements start as principal components.
    """

    def __init__(self, cells: int, size: int, steps: int = 6, nearness_weight: float = 5.0):
        super().__init__()
        self.cells, self.nearness_weight = cells, nearness_weight
        count = cells**3
        if size > count:
            raise WearcapError(f"a code of {size} numbers for {count} cells", expected=f"at most {count}")
        self.sums = nn.Parameter(nn.init.orthogonal_(torch.empty(size, count)))
        self.back = nn.Parameter(self.sums.detach().T.contiguous().clone())
        self.step = nn.Parameter(torch.full((steps,), 3.0))
        self.threshold = nn.Parameter(torch.full((steps - 1, count), 0.05))
        self.sharpness = nn.Parameter(torch.tensor(10.0))
        self.border = nn.Parameter(torch.full((count,), 0.1))
        self.register_buffer("unit", torch.ones(size))
        self.unit: Tensor
        """Initial standard deviation of each measurement, which scales codes to about 1."""
        self.scale, self.shift = nn.Parameter(torch.tensor(1.0)), nn.Parameter(torch.tensor(0.0))

    def encode(self, nearness: Float[Tensor, "batch x y z"]) -> Float[Tensor, "batch feature"]:
        return nearness.flatten(1) @ self.sums.T / self.unit

    def decode(self, code: Float[Tensor, "batch feature"]) -> Float[Tensor, "batch x y z"]:
        logits, nearness = self._explained(code)
        return torch.where(logits > 0, nearness, 0).reshape(-1, *[self.cells] * 3)

    def _explained(self, code: Tensor) -> tuple[Float[Tensor, "batch cell"], Float[Tensor, "batch cell"]]:
        """Logits that cells contain a point, and the point's nearness if they do."""
        sums = code * self.unit
        found = guess = self.step[0] * sums @ self.back.T
        for step, threshold in zip(self.step[1:], self.threshold):
            found = F.relu(guess - threshold)
            guess = found + step * ((sums - found @ self.sums.T) @ self.back.T)
        return self.sharpness * (guess - self.border), self.scale * guess + self.shift

    def loss(self, nearness: Float[Tensor, "batch x y z"]) -> Float[Tensor, ""]:
        logits, found = self._explained(self.encode(nearness))
        true = nearness.flatten(1)
        occupied: Bool[Tensor, "batch cell"] = true > _SEEN
        which = F.binary_cross_entropy_with_logits(logits, occupied.to(logits.dtype), reduction="sum")
        return (which + self.nearness_weight * ((found - true).square() * occupied).sum()) / len(true)

    @torch.no_grad()
    def start_from(self, nearness: Float[Tensor, "batch x y z"]) -> None:
        centered = nearness.flatten(1) - nearness.flatten(1).mean(0)
        components = torch.linalg.eigh(centered.T @ centered)[1].flip(1)[:, : len(self.sums)]
        self.sums.copy_(components.T)
        self.back.copy_(components)
        self.unit.copy_((centered @ components).std(0).clamp_min(1e-3))
