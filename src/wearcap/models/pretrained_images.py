"""Large pretrained image encoders with the user's own weights: CLIP ViT-L/14 and DINOv2 ViT-L/14.

Nothing is downloaded: weights come from a path, an environment variable, or the cache where other programs left them.
The networks are open_clip's and timm's, both optional packages.
"""

import importlib
import os
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import ModuleType

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from wearcap.errors import WearcapError
from wearcap.models.image_encoder import fingerprint_of, letterboxed
from wearcap.models.weights import load_weights, read_weights

SIDE = 224
"""Side of the square (pixels) that an image is fitted into."""


@dataclass(frozen=True)
class Pretrained:
    """One published network, and where its weights may be."""

    name: str
    title: str
    package: str
    install: str
    """Name of the package for pip."""
    network: Callable[[ModuleType], nn.Module]
    """Builds the network with random weights."""
    tensors: Callable[[dict[str, Tensor]], dict[str, Tensor]]
    """Selects the network's own tensors among those of a file."""
    size: int
    mean: tuple[float, float, float]
    std: tuple[float, float, float]
    variable: str
    """Environment variable with a path to the weights."""
    hub: str
    """Repository of the Hugging Face hub."""
    files: tuple[str, ...]
    """Names of the repository's weight files, the best first."""
    elsewhere: tuple[str, ...]
    """Other places of the weights, relative to the user's cache."""


def _clip_visual(open_clip: ModuleType) -> nn.Module:
    return open_clip.create_model("ViT-L-14-quickgelu", pretrained=None).visual


def _visual_part(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    part = {key.removeprefix("visual."): value for key, value in tensors.items() if key.startswith("visual.")}
    return part or tensors


def _dinov2(timm: ModuleType) -> nn.Module:
    return timm.create_model("vit_large_patch14_dinov2.lvd142m", pretrained=False, num_classes=0, dynamic_img_size=True)


def _without_mask(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """The original files contain a mask token that only training uses."""
    return {key: value for key, value in tensors.items() if key != "mask_token"}


CLIP = Pretrained(
    "clip-vit-l14",
    "CLIP ViT-L/14",
    "open_clip",
    "open_clip_torch",
    _clip_visual,
    _visual_part,
    768,
    (0.48145466, 0.4578275, 0.40821073),
    (0.26862954, 0.26130258, 0.27577711),
    "WEARCAP_CLIP_WEIGHTS",
    "timm/vit_large_patch14_clip_224.openai",
    ("open_clip_model.safetensors", "open_clip_pytorch_model.bin"),
    ("clip/ViT-L-14.pt",),
)
DINOV2 = Pretrained(
    "dinov2-vit-l14",
    "DINOv2 ViT-L/14",
    "timm",
    "timm",
    _dinov2,
    _without_mask,
    1024,
    (0.485, 0.456, 0.406),
    (0.229, 0.224, 0.225),
    "WEARCAP_DINOV2_WEIGHTS",
    "timm/vit_large_patch14_dinov2.lvd142m",
    ("model.safetensors", "pytorch_model.bin"),
    ("torch/hub/checkpoints/dinov2_vitl14_pretrain.pth",),
)


class PretrainedEncoder:
    """An `ImageEncoder` around a published network; images are fitted uncropped into its square."""

    def __init__(self, kind: Pretrained, weights: str | Path | None = None, device: str | None = None):
        """`weights`: a file; None looks where `find_weights` says. `device`: None takes a GPU where there is one.

        Raises WearcapError when the package or the weights are missing, or the weights are another network's.
        """
        package = _package(kind)
        path = find_weights(kind, weights)
        tensors = kind.tensors(_read(path))
        network = kind.network(package)
        load_weights(network, tensors, name=kind.title, where=path)
        self.kind, self.name, self.size = kind, kind.name, kind.size
        self.device = device or ("cuda" if torch.cuda.is_available() else "cpu")
        self.network = network.eval().requires_grad_(False).to(self.device)

    @cached_property
    def fingerprint(self) -> str:
        return fingerprint_of(self.network, self.name, SIDE, self.kind.mean, self.kind.std)

    @torch.inference_mode()
    def embed(self, frames: UInt8[Tensor, "batch height width 3"]) -> Float[Tensor, "batch feature"]:
        pictures = letterboxed(frames.to(self.device), SIDE, SIDE, self.kind.mean, self.kind.std)
        return self.network(pictures).float()


def clip(weights: str | Path | None = None, device: str | None = None) -> PretrainedEncoder:
    """CLIP ViT-L/14 as OpenAI published it (768-d, the thesis's choice)."""
    return PretrainedEncoder(CLIP, weights, device)


def dinov2(weights: str | Path | None = None, device: str | None = None) -> PretrainedEncoder:
    """DINOv2 ViT-L/14 (1024-d, the class token)."""
    return PretrainedEncoder(DINOV2, weights, device)


def find_weights(kind: Pretrained, given: str | Path | None) -> Path:
    """The file given, else the one that `kind.variable` names, else the first in the user's caches.

    The Hugging Face cache is at $HF_HUB_CACHE, $HF_HOME/hub or ~/.cache/huggingface/hub. Raises WearcapError that
    lists the places when there is none.
    """
    named = given or os.environ.get(kind.variable)
    if named:
        path = Path(named).expanduser()
        if not path.is_file():
            raise WearcapError(
                f"no such file of weights of {kind.title}",
                where=path,
                fix="Check weights=…" if given else f"Check the variable {kind.variable}.",
            )
        return path
    home = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser()
    hugging_face = Path(os.environ.get("HF_HOME") or home / "huggingface").expanduser()
    hub = Path(os.environ.get("HF_HUB_CACHE") or hugging_face / "hub").expanduser()
    snapshots = hub / f"models--{kind.hub.replace('/', '--')}" / "snapshots"
    found = [path for file in kind.files for path in sorted(snapshots.glob(f"*/{file}"))]
    found += [home / place for place in kind.elsewhere if (home / place).is_file()]
    if found:
        return found[0]
    places = [f"${kind.variable}", str(snapshots), *(str(home / place) for place in kind.elsewhere)]
    raise WearcapError(
        f"no weights of {kind.title} on this machine",
        where=", ".join(places),
        expected="a file at one of these places",
        fix=f"Nothing is downloaded by itself: fetch {kind.files[0]} from https://huggingface.co/{kind.hub} and give "
        "weights=PATH, or take encoder=egoview, which needs none.",
    )


def _package(kind: Pretrained) -> ModuleType:
    try:
        return importlib.import_module(kind.package)
    except ModuleNotFoundError as error:
        raise WearcapError(
            f"{kind.title} needs the package {error.name!r}",
            fix=f"pip install {kind.install}, or take encoder=egoview, which needs none.",
        ) from error


def _read(path: Path) -> dict[str, Tensor]:
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            if any("code" in Path(name).parts for name in archive.namelist()):
                raise WearcapError(
                    "a TorchScript archive, which holds code beside its weights and is not opened",
                    where=path,
                    expected="a .safetensors file, or a state_dict",
                    fix="If you trust its origin: torch.save(torch.jit.load(PATH, 'cpu').state_dict(), 'weights.pt'), "
                    "then weights=weights.pt.",
                )
    return read_weights(path)
