"""Our own small image encoder for a head camera's frames."""

import hashlib
from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.nn import functional as F

from wearcap.models.checkpoint import load_network


def letterboxed(
    frames: UInt8[Tensor, "batch height width 3"], width: int, height: int, mean: Sequence[float], std: Sequence[float]
) -> Float[Tensor, "batch 3 new_height new_width"]:
    """Images normalised per channel (`mean`, `std` of values in 0…1), resized without cropping or distortion, and
    centred in width x height pixels; the margins are 0."""
    x = frames.movedim(-1, 1).float()
    scale = min(width / x.shape[3], height / x.shape[2])
    rows, columns = max(1, round(scale * x.shape[2])), max(1, round(scale * x.shape[3]))
    if (rows, columns) != x.shape[2:]:
        x = F.interpolate(x, (rows, columns), mode="bicubic", antialias=True).clamp(0, 255)
    x = (x - 255 * x.new_tensor(mean)[:, None, None]) / (255 * x.new_tensor(std)[:, None, None])
    left, top = (width - columns) // 2, (height - rows) // 2
    return F.pad(x, (left, width - columns - left, top, height - rows - top))


def fingerprint_of(network: nn.Module, *settings: object) -> str:
    """8 hex digits that depend on a network's weights and on settings (by their repr)."""
    digest = hashlib.sha256(repr(settings).encode())
    for key, value in sorted(network.state_dict().items()):
        digest.update(key.encode())
        digest.update(value.detach().cpu().contiguous().view(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()[:8]


class _Block(nn.Module):
    """x + two 3x3 convolutions."""

    def __init__(self, channels: int):
        super().__init__()
        self.first = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.first_norm = nn.BatchNorm2d(channels)
        self.second = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.second_norm = nn.BatchNorm2d(channels)

    def forward(self, x: Float[Tensor, "batch c h w"]) -> Float[Tensor, "batch c h w"]:
        y = F.relu(self.first_norm(self.first(x)))
        return F.relu(x + self.second_norm(self.second(y)))


class EgoViewEncoder(nn.Module):
    """A small residual network for 96x72 pixels of a head camera; positions are kept up to the bottleneck.

    Embeddings have zero mean and unit variance over their features. It is a substitute for a large pretrained encoder,
    trained to locate the wearer's own limbs (systems/hmd2/egoview_training.py).
    """

    name = "egoview"
    mean, std = (0.45, 0.45, 0.45), (0.25, 0.25, 0.25)

    def __init__(
        self,
        size: int = 64,
        width: int = 96,
        height: int = 72,
        channels: tuple[int, ...] | list[int] = (24, 48, 96),
        squeezed: int = 24,
    ):
        super().__init__()
        self.size, self.width, self.height = size, width, height
        stages: list[nn.Module] = []
        inputs = 12  # 2x2 pixels side by side
        for outputs in channels:
            stages += [
                nn.Conv2d(inputs, outputs, 3, 2, 1, bias=False),
                nn.BatchNorm2d(outputs),
                nn.ReLU(),
                _Block(outputs),
            ]
            inputs = outputs
        self.stages = nn.Sequential(*stages, nn.Conv2d(inputs, squeezed, 1), nn.ReLU())
        reduction = 2 ** (1 + len(channels))
        cells = -(-height // reduction) * -(-width // reduction)
        self.bottleneck = nn.Linear(squeezed * cells, size)

    def forward(self, pictures: Float[Tensor, "batch 3 height width"]) -> Float[Tensor, "batch feature"]:
        """Embeddings of normalised images of the network's size."""
        x = F.pixel_unshuffle(pictures, 2).contiguous(memory_format=torch.channels_last)
        x = self.bottleneck(self.stages(x).flatten(1))
        return F.layer_norm(x, x.shape[-1:])

    @property
    def fingerprint(self) -> str:
        return fingerprint_of(self, self.name, self.width, self.height, self.mean, self.std)

    @torch.inference_mode()
    def embed(self, frames: UInt8[Tensor, "batch height width 3"]) -> Float[Tensor, "batch feature"]:
        frames = frames.to(self.bottleneck.weight.device)
        return self(letterboxed(frames, self.width, self.height, self.mean, self.std))

    @classmethod
    def load(cls, checkpoint: str | Path) -> "EgoViewEncoder":
        """Load a checkpoint of `wearcap train experiment=egoview`. Raises WearcapError for any other file."""
        return load_network(checkpoint, cls, "egoview")
