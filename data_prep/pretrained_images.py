"""Large pretrained image encoders with the user's own weights, for `wearcap prepare embeddings`.

Nothing is downloaded: weights of CLIP and DINOv2 come from a path, an environment variable, or the cache where other
programs left them. Their networks are open_clip's and timm's, both optional packages.
"""

import os
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import ClassVar

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from wearcap.errors import WearcapError
from wearcap.extras import required
from wearcap.models.image_encoder import fingerprint_of, letterboxed
from wearcap.models.weights import load_weights, read_weights

SIDE = 224
"""Side of the square (pixels) that an image is fitted into for a pretrained encoder."""


class _PretrainedEncoder:
    """An `ImageEncoder` around a published network; images are fitted uncropped into its square."""

    name: ClassVar[str]
    size: ClassVar[int]
    title: ClassVar[str]
    package: ClassVar[str]
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
        package = required(self.package, self.title, "take encoder=egoview, which needs none")
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
        return fingerprint_of(self.network, self.name, SIDE, self.mean, self.std)

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
    package = "open_clip"
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
    package = "timm"
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
