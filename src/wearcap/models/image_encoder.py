"""Image encoders: our own small one for a head camera's frames, and large pretrained ones with the user's own weights.

Nothing is downloaded: weights of CLIP and DINOv2 come from a path, an environment variable, or the cache where other
programs left them. Their networks are open_clip's and timm's, both optional packages.
"""

import hashlib
import importlib
import os
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import ClassVar, Protocol, runtime_checkable

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.nn import functional as F

from wearcap.errors import WearcapError
from wearcap.models.checkpoint import load_network
from wearcap.models.weights import load_weights, read_weights

SIDE = 224
"""Side of the square (pixels) that an image is fitted into for a pretrained encoder."""


@runtime_checkable
class ImageEncoder(Protocol):
    """The interface of an image encoder."""

    name: str
    size: int
    """Length of an embedding."""

    @property
    def fingerprint(self) -> str:
        """8 hex digits that differ between encoders with different embeddings of the same image."""
        ...

    def embed(self, frames: UInt8[Tensor, "batch height width 3"]) -> Float[Tensor, "batch feature"]:
        """Embeddings of RGB images of any size, on the encoder's device."""
        ...


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


def _fingerprint_of(network: nn.Module, *settings: object) -> str:
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
        return _fingerprint_of(self, self.name, self.width, self.height, self.mean, self.std)

    @torch.inference_mode()
    def embed(self, frames: UInt8[Tensor, "batch height width 3"]) -> Float[Tensor, "batch feature"]:
        frames = frames.to(self.bottleneck.weight.device)
        return self(letterboxed(frames, self.width, self.height, self.mean, self.std))

    @classmethod
    def load(cls, checkpoint: str | Path) -> "EgoViewEncoder":
        """Load a checkpoint of `wearcap train experiment=egoview`. Raises WearcapError for any other file."""
        return load_network(checkpoint, cls, "egoview")


class _PretrainedEncoder:
    """An `ImageEncoder` around a published network; images are fitted uncropped into its square."""

    name: ClassVar[str]
    size: ClassVar[int]
    title: ClassVar[str]
    package: ClassVar[str]
    install: ClassVar[str]
    """Name of the package for pip."""
    mean: ClassVar[tuple[float, float, float]]
    std: ClassVar[tuple[float, float, float]]
    variable: ClassVar[str]
    """Environment variable with a path to the weights."""
    hub: ClassVar[str]
    """Repository of the Hugging Face hub."""
    files: ClassVar[tuple[str, ...]]
    """Names of the repository's weight files, the best first."""
    elsewhere: ClassVar[str]
    """Another place of the weights, relative to the user's cache."""

    def __init__(self, weights: str | Path | None = None, device: str | None = None):
        """`weights`: a file; None looks where `find_weights` says. `device`: None takes a GPU where there is one.

        Raises WearcapError when the package or the weights are missing, or the weights are another network's.
        """
        try:
            package = importlib.import_module(self.package)
        except ModuleNotFoundError as error:
            fix = f"pip install {self.install}, or take encoder=egoview, which needs none."
            raise WearcapError(f"{self.title} needs the package {error.name!r}", fix=fix) from error
        path = self.find_weights(weights)
        network = self.network_of(package)
        load_weights(network, self.tensors_of(read_weights(path)), name=self.title, where=path)
        self.device = device or ("cuda" if torch.cuda.is_available() else "cpu")
        self.network = network.eval().requires_grad_(False).to(self.device)

    @staticmethod
    def network_of(package: ModuleType) -> nn.Module:
        """The package's network with random weights."""
        raise NotImplementedError

    @staticmethod
    def tensors_of(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
        """The network's own tensors among those of a file."""
        raise NotImplementedError

    @cached_property
    def fingerprint(self) -> str:
        return _fingerprint_of(self.network, self.name, SIDE, self.mean, self.std)

    @torch.inference_mode()
    def embed(self, frames: UInt8[Tensor, "batch height width 3"]) -> Float[Tensor, "batch feature"]:
        return self.network(letterboxed(frames.to(self.device), SIDE, SIDE, self.mean, self.std)).float()

    @classmethod
    def find_weights(cls, given: str | Path | None) -> Path:
        """The file given, else the one that `variable` names, else the first in the user's caches.

        The Hugging Face cache is at $HF_HUB_CACHE, $HF_HOME/hub or ~/.cache/huggingface/hub. Raises WearcapError that
        lists the places when there is none.
        """
        if named := given or os.environ.get(cls.variable):
            path = Path(named).expanduser()
            if not path.is_file():
                fix = "Check weights=…" if given else f"Check the variable {cls.variable}."
                raise WearcapError(f"no such file of weights of {cls.title}", where=path, fix=fix)
            return path
        home = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser()
        hugging_face = Path(os.environ.get("HF_HOME") or home / "huggingface").expanduser()
        hub = Path(os.environ.get("HF_HUB_CACHE") or hugging_face / "hub").expanduser()
        snapshots = hub / f"models--{cls.hub.replace('/', '--')}" / "snapshots"
        found = [path for file in cls.files for path in sorted(snapshots.glob(f"*/{file}"))]
        found += [path for path in [home / cls.elsewhere] if path.is_file()]
        if found:
            return found[0]
        raise WearcapError(
            f"no weights of {cls.title} on this machine",
            where=f"${cls.variable}, {snapshots}, {home / cls.elsewhere}",
            expected="a file at one of these places",
            fix=f"Nothing is downloaded by itself: fetch {cls.files[0]} from https://huggingface.co/{cls.hub} and give "
            "weights=PATH, or take encoder=egoview, which needs none.",
        )


class Clip(_PretrainedEncoder):
    """CLIP ViT-L/14 as OpenAI published it (768-d, the thesis's choice)."""

    name, title, size = "clip-vit-l14", "CLIP ViT-L/14", 768
    package, install = "open_clip", "open_clip_torch"
    mean, std = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)
    variable, elsewhere = "WEARCAP_CLIP_WEIGHTS", "clip/ViT-L-14.pt"
    hub = "timm/vit_large_patch14_clip_224.openai"
    files = ("open_clip_model.safetensors", "open_clip_pytorch_model.bin")

    @staticmethod
    def network_of(package: ModuleType) -> nn.Module:
        return package.create_model("ViT-L-14-quickgelu", pretrained=None).visual

    @staticmethod
    def tensors_of(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
        part = {key.removeprefix("visual."): value for key, value in tensors.items() if key.startswith("visual.")}
        return part or tensors


class DinoV2(_PretrainedEncoder):
    """DINOv2 ViT-L/14 (1024-d, the class token)."""

    name, title, size = "dinov2-vit-l14", "DINOv2 ViT-L/14", 1024
    package = install = "timm"
    mean, std = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
    variable, elsewhere = "WEARCAP_DINOV2_WEIGHTS", "torch/hub/checkpoints/dinov2_vitl14_pretrain.pth"
    hub = "timm/vit_large_patch14_dinov2.lvd142m"
    files = ("model.safetensors", "pytorch_model.bin")

    @staticmethod
    def network_of(package: ModuleType) -> nn.Module:
        name = "vit_large_patch14_dinov2.lvd142m"
        return package.create_model(name, pretrained=False, num_classes=0, dynamic_img_size=True)

    @staticmethod
    def tensors_of(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
        """The original files contain a mask token that only training uses."""
        return {key: value for key, value in tensors.items() if key != "mask_token"}
