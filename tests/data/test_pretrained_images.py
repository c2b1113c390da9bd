"""CLIP and DINOv2: the glue around open_clip and timm, tried on stand-ins with the same functions; the real ones if there."""

import os
import sys
import types
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from data_prep.embeddings import ImageEncoder
from data_prep.pretrained_images import Clip, DinoV2
from wearcap.errors import WearcapError

VARIABLES = ("HF_HOME", "HF_HUB_CACHE", "WEARCAP_CLIP_WEIGHTS", "WEARCAP_DINOV2_WEIGHTS")


class Tower(nn.Module):
    """Stands in for a vision transformer: takes squares of 224 pixels."""

    def __init__(self, size: int):
        super().__init__()
        self.conv1 = nn.Conv2d(3, 4, 32, 32)
        self.proj = nn.Linear(4, size)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        assert x.shape[1:] == (3, 224, 224)
        return self.proj(self.conv1(x).mean((2, 3)))


class Towers(nn.Module):
    def __init__(self):
        super().__init__()
        self.visual, self.token_embedding = Tower(768), nn.Embedding(10, 8)


@pytest.fixture
def packages(monkeypatch, tmp_path):
    """open_clip and timm as stand-ins that refuse to fetch anything, and an empty cache."""

    def create_clip(model_name, pretrained=None, precision="fp32", device="cpu", **more):
        assert (model_name, pretrained) == ("ViT-L-14-quickgelu", None)
        return Towers()

    def create_timm(model_name, pretrained=False, checkpoint_path="", num_classes=None, dynamic_img_size=False):
        assert model_name == "vit_large_patch14_dinov2.lvd142m"
        assert (pretrained, checkpoint_path, num_classes, dynamic_img_size) == (False, "", 0, True)
        return Tower(1024)

    for name, create in (("open_clip", create_clip), ("timm", create_timm)):
        module = types.ModuleType(name)
        module.__dict__["create_model"] = create
        monkeypatch.setitem(sys.modules, name, module)
    for variable in VARIABLES:
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


def clip_file(path: Path) -> Towers:
    torch.manual_seed(1)
    model = Towers()
    path.parent.mkdir(parents=True, exist_ok=True)
    save_file(model.state_dict(), path) if path.suffix == ".safetensors" else torch.save(model.state_dict(), path)
    return model


def hub(cache: Path, repository: str, file: str) -> Path:
    return cache / f"huggingface/hub/models--{repository.replace('/', '--')}/snapshots/0123abcd/{file}"


def test_clip_is_found_in_the_cache_and_sees_whole_normalised_pictures(packages):
    model = clip_file(hub(packages, Clip.hub, "open_clip_model.safetensors"))
    encoder = Clip(device="cpu")
    assert isinstance(encoder, ImageEncoder)
    frames = torch.randint(0, 256, (2, 224, 224, 3), dtype=torch.uint8)
    mean, std = torch.tensor(Clip.mean), torch.tensor(Clip.std)
    expected = model.visual(((frames / 255 - mean) / std).movedim(-1, 1))
    torch.testing.assert_close(encoder.embed(frames), expected, atol=1e-5, rtol=1e-5)
    assert encoder.embed(frames[:, :100]).shape == (2, encoder.size) == (2, 768)


def test_dinov2_takes_the_original_file(packages):
    torch.manual_seed(2)
    tower, path = Tower(1024), packages / DinoV2.elsewhere
    path.parent.mkdir(parents=True)
    torch.save(tower.state_dict() | {"mask_token": torch.zeros(1, 1024)}, path)
    encoder = DinoV2(device="cpu")
    assert encoder.embed(torch.zeros(1, 72, 96, 3, dtype=torch.uint8)).shape == (1, 1024)
    assert torch.equal(encoder.network.state_dict()["proj.weight"], tower.proj.weight)


def test_a_path_goes_before_the_variable_and_that_before_the_cache(packages, monkeypatch, tmp_path):
    paths = {
        "given": tmp_path / "given.pt",
        "variable": tmp_path / "variable.safetensors",
        "cache": hub(packages, Clip.hub, "open_clip_pytorch_model.bin"),
    }
    for index, path in enumerate(paths.values()):
        model = clip_file(path)
        tensors = {key: value + index for key, value in model.state_dict().items()}
        save_file(tensors, path) if path.suffix == ".safetensors" else torch.save(tensors, path)
    prints = [Clip(device="cpu").fingerprint]
    monkeypatch.setenv(Clip.variable, str(paths["variable"]))
    prints.append(Clip(device="cpu").fingerprint)
    prints.append(Clip(paths["given"], device="cpu").fingerprint)
    assert len(set(prints)) == 3
    assert Clip(paths["given"], device="cpu").fingerprint == prints[2]


def test_missing_weights_are_explained(packages, monkeypatch):
    with pytest.raises(WearcapError, match="no weights of CLIP") as raised:
        Clip()
    message = str(raised.value)
    for part in (
        "WEARCAP_CLIP_WEIGHTS",
        str(packages / "huggingface/hub"),
        "clip/ViT-L-14.pt",
        "weights=PATH",
        "egoview",
    ):
        assert part in message
    monkeypatch.setenv("HF_HOME", "/elsewhere")
    with pytest.raises(WearcapError, match="/elsewhere/hub"):
        DinoV2()
    with pytest.raises(WearcapError, match=r"nowhere\.pt: no such file of weights of DINOv2"):
        DinoV2("nowhere.pt")


def test_foreign_weights_and_archives_with_code_are_refused(packages, tmp_path):
    save_file({"visual.conv1.weight": torch.zeros(4, 3, 32, 32)}, tmp_path / "part.safetensors")
    with pytest.raises(WearcapError, match="not the weights of CLIP"):
        Clip(tmp_path / "part.safetensors")
    script = packages / "clip/ViT-L-14.pt"
    script.parent.mkdir(parents=True)
    torch.jit.save(torch.jit.trace(nn.Linear(2, 2), torch.zeros(1, 2)), str(script))
    with pytest.raises(WearcapError, match=r"ViT-L-14\.pt: not a readable .*TorchScript"):
        Clip()


@pytest.mark.parametrize("kind", [Clip, DinoV2])
def test_a_missing_package_is_named(kind, packages, monkeypatch):
    monkeypatch.setitem(sys.modules, kind.package, None)
    with pytest.raises(WearcapError, match=rf'{kind.package}.*pip install "wearcap\[images\]"'):
        kind()


@pytest.mark.slow
@pytest.mark.parametrize("kind", [Clip, DinoV2])
def test_the_real_network_takes_weights_of_its_own_shapes(kind, tmp_path):
    """With random weights: what is downloaded in earnest has the same names."""
    package = pytest.importorskip(kind.package)
    network = kind.network_of(package)
    prefix = "visual." if kind is Clip else ""
    save_file(
        {prefix + key: value.contiguous() for key, value in network.state_dict().items()}, tmp_path / "w.safetensors"
    )
    encoder = kind(tmp_path / "w.safetensors", device="cpu")
    assert encoder.embed(torch.zeros(1, 72, 96, 3, dtype=torch.uint8)).shape == (1, kind.size)


@pytest.mark.slow
@pytest.mark.skipif("WEARCAP_CLIP_WEIGHTS" not in os.environ, reason="needs CLIP's weights")
def test_clip_tells_pictures_apart():
    pytest.importorskip("open_clip")
    encoder = Clip()
    plain = torch.full((1, 224, 224, 3), 128, dtype=torch.uint8)
    noise = torch.randint(0, 256, (1, 224, 224, 3), dtype=torch.uint8)
    a, b, c = encoder.embed(torch.cat([plain, plain + 2, noise]))
    assert torch.cosine_similarity(a, b, dim=0) > torch.cosine_similarity(a, c, dim=0)
