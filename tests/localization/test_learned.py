"""Learned features behind the protocols, on a stand-in for kornia that has its signatures and checks; and the errors
without kornia, or without weights."""

import sys
from dataclasses import dataclass
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from safetensors.torch import save_file
from textured_room import CAMERA, photo_poses, photograph, take_photos, textured_room
from torch import Tensor, nn
from torch.nn import functional as F

from wearcap.cli.conf import compose, conf_dir
from wearcap.errors import WearcapError
from wearcap.localization.features import Features
from wearcap.localization.learned import DiskExtractor, LightGlueMatcher
from wearcap.localization.localizer import Localizer
from wearcap.localization.map_builder import MapSettings, build_map
from wearcap.localization.point_map import PointMapper
from wearcap.scene.scan import Scan


@dataclass
class DISKFeatures:
    keypoints: Tensor
    descriptors: Tensor
    detection_scores: Tensor


class DISK(nn.Module):
    """As kornia's, with one convolution for its U-Net."""

    def __init__(self, desc_dim=128, unet=None):
        super().__init__()
        self.desc_dim, self.unet = desc_dim, unet or nn.Conv2d(3, desc_dim + 1, 9, padding=4, bias=False)

    def forward(self, images, n=None, window_size=5, score_threshold=0.0, pad_if_not_divisible=False):
        assert images.dtype == torch.float32
        assert images.max() <= 1
        assert pad_if_not_divisible or not (images.shape[2] % 16 or images.shape[3] % 16)
        output = self.unet(images - images.mean((2, 3), keepdim=True))
        heat = output[:, self.desc_dim :].abs()
        peaks = (heat == F.max_pool2d(heat, window_size, 1, window_size // 2)) & (heat > score_threshold)
        found = []
        for picture, peak, dense in zip(heat[:, 0], peaks[:, 0], output[:, : self.desc_dim]):
            y, x = peak.nonzero().T
            strength = picture[y, x]
            kept = strength.argsort(descending=True)[:n].sort().values  # kornia's are not in order of strength
            y, x, strength = y[kept], x[kept], strength[kept]
            descriptors = F.normalize(dense[:, y, x].T, dim=-1)
            found.append(DISKFeatures(torch.stack([x, y], -1).float(), descriptors, strength.log()))
        return found


class LightGlue(nn.Module):
    """As kornia's, with mutual nearest neighbours for its transformer."""

    def __init__(self, features: str = "superpoint", **conf_):
        super().__init__()
        assert features is None, "kornia downloads weights for named features"
        self.conf = SimpleNamespace(**({"input_dim": 256, "n_layers": 9, "filter_threshold": 0.1} | conf_))
        block = nn.ModuleDict({"self_attn": nn.Linear(4, 4), "cross_attn": nn.Linear(4, 4)})
        self.transformers = nn.ModuleList([block])
        self.register_buffer("confidence_thresholds", torch.linspace(0.9, 0.5, self.conf.n_layers))

    def forward(self, data: dict) -> dict:
        for image in (data["image0"], data["image1"]):
            size = image["image_size"].float()
            assert image["descriptors"].shape[-1] == self.conf.input_dim
            assert ((image["keypoints"] - size[:, None] / 2) / (size.max() / 2)).abs().max() <= 1
        similarity = data["image0"]["descriptors"][0] @ data["image1"]["descriptors"][0].T
        best, back = similarity.max(1), similarity.argmax(0)
        rows = torch.arange(len(similarity))
        kept = (back[best.indices] == rows) & (best.values > self.conf.filter_threshold)
        return {"matches": [torch.stack([rows[kept], best.indices[kept]], -1)], "scores": [best.values[kept]]}


@pytest.fixture(autouse=True)
def _kornia(monkeypatch):
    package, feature = ModuleType("kornia"), ModuleType("kornia.feature")
    feature.DISK, feature.LightGlue = DISK, LightGlue
    monkeypatch.setitem(sys.modules, "kornia", package)
    monkeypatch.setitem(sys.modules, "kornia.feature", feature)


@pytest.fixture(scope="module")
def disk(tmp_path_factory) -> str:
    """As released: a file of DISK's training."""
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("disk") / "depth-save.pth"
    torch.save({"extractor": DISK().state_dict()}, path)
    return str(path)


@pytest.fixture(scope="module")
def lightglue(tmp_path_factory) -> str:
    """As first released: the layers' former names, and no thresholds."""
    state = LightGlue(features=None).state_dict()
    former = {}
    for name, value in state.items():
        parts = name.split(".")
        former[".".join([parts[2], parts[1], *parts[3:]] if parts[0] == "transformers" else parts)] = value
    del former["confidence_thresholds"]
    assert any(name.startswith("self_attn.0.") for name in former)
    path = tmp_path_factory.mktemp("lightglue") / "disk_lightglue.pth"
    torch.save(former, path)
    return str(path)


def picture(seed: int = 0, height: int = 120, width: int = 168) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.kron(rng.integers(0, 256, (height // 4, width // 4, 3)), np.ones((4, 4, 1))).astype(np.uint8)


def some_features(count: int, seed: int, width: int = 128) -> Features:
    rng = np.random.default_rng(seed)
    descriptors = rng.normal(size=(count, width)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    keypoints = rng.uniform(0, [639, 479], (count, 2)).astype(np.float32)
    return Features(keypoints, descriptors, np.ones(count, np.float32), (640, 480))


def test_disk_extracts_the_strongest_from_a_picture(disk):
    every = DiskExtractor(disk)(picture())
    features = DiskExtractor(disk, max_keypoints=50)(picture())
    assert len(every) > len(features) == 50
    assert features.size == (168, 120)
    assert (np.diff(features.scores) <= 0).all()
    np.testing.assert_array_equal(features.keypoints, every.keypoints[:50])
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1, atol=1e-5)


def test_keypoints_of_a_shrunk_picture_are_in_its_own_pixels(disk):
    """A picture with every pixel doubled, searched at half its size, has the small one's keypoints."""
    small = picture()
    large = small.repeat(2, 0).repeat(2, 1)
    expected = DiskExtractor(disk)(small)
    found = DiskExtractor(disk, max_side=168)(large)
    assert found.size == (336, 240)
    np.testing.assert_allclose(found.keypoints, expected.keypoints * 2 + 0.5)
    np.testing.assert_allclose(found.descriptors, expected.descriptors, atol=1e-5)


def test_lightglue_recovers_a_planted_permutation(lightglue):
    query, rng = some_features(60, seed=1), np.random.default_rng(2)
    order, extra = rng.permutation(60), some_features(25, seed=3)
    other = Features(
        np.concatenate([query.keypoints[order] + 3, extra.keypoints]),
        np.concatenate([query.descriptors[order], extra.descriptors]),
        np.ones(85, np.float32),
        (800, 600),
    )
    matches = LightGlueMatcher(lightglue)(query, other)
    np.testing.assert_array_equal(matches[:, 0], np.arange(60))
    np.testing.assert_array_equal(order[matches[:, 1]], np.arange(60))
    assert len(LightGlueMatcher(lightglue, min_probability=0.9)(query, extra)) == 0
    assert LightGlueMatcher(lightglue)(query, some_features(0, seed=0)).shape == (0, 2)


def test_other_weights_have_another_name(disk, tmp_path):
    save_file(DISK().state_dict(), tmp_path / "w.safetensors")
    other = DiskExtractor(tmp_path / "w.safetensors")
    assert other.name.startswith("disk-")
    assert other.name != DiskExtractor(disk).name == DiskExtractor(disk).name


@pytest.mark.parametrize(("make", "part"), [(DiskExtractor, "extractor"), (LightGlueMatcher, "matcher")])
def test_without_kornia_or_weights_the_way_is_shown(make, part, disk, lightglue, tmp_path, monkeypatch):
    for weights in (None, tmp_path / "nowhere.pth"):
        with pytest.raises(WearcapError, match=rf"https://github.com/.*localization.{part}.weights=PATH"):
            make(weights)
    with pytest.raises(WearcapError, match="not the weights of"):
        make({"extractor": lightglue, "matcher": disk}[part])
    with pytest.raises(WearcapError, match="device 'abacus'"):
        make({"extractor": disk, "matcher": lightglue}[part], device="abacus")
    for name in ("kornia", "kornia.feature"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(WearcapError, match=r"needs? the package 'kornia.*wearcap\[learned\]"):
        make({"extractor": disk, "matcher": lightglue}[part])


def test_wrong_use_is_explained(disk, lightglue):
    with pytest.raises(WearcapError, match="0 keypoints"):
        DiskExtractor(disk, max_keypoints=0)
    with pytest.raises(WearcapError, match="20×40 pixels is too small"):
        DiskExtractor(disk)(np.zeros((40, 20, 3), np.uint8))
    with pytest.raises(WearcapError, match="descriptors of 64 numbers"):
        LightGlueMatcher(lightglue)(some_features(3, 0, 64), some_features(3, 0, 64))


@pytest.mark.slow
def test_a_map_of_learned_features_finds_where_its_photo_was_taken(disk, lightglue, tmp_path):
    """The whole way through map, retrieval, matching and pose."""
    mapper = PointMapper(textured_room(spacing=0.02), 0.015)
    photos = take_photos(mapper, CAMERA, photo_poses(3), tmp_path)
    extract, settings = DiskExtractor(disk, max_keypoints=400), MapSettings(splat_m=0.015, words=16)
    room_map = build_map(photos, Scan(mapper.scan.points), extract, settings=settings)
    assert room_map.extractor == extract.name
    image = photograph(mapper, CAMERA, photos[1].T_world_cam)
    pose = Localizer(room_map, extract, LightGlueMatcher(lightglue))(image, CAMERA)
    assert pose is not None
    assert pose.inliers > 50
    torch.testing.assert_close(pose.t_world_cam, photos[1].T_world_cam.t.float(), atol=2e-3, rtol=0)


def test_every_choice_of_the_config_builds(disk, lightglue):
    choices = {path.stem for path in (conf_dir() / "localization").glob("*.yaml")}
    assert choices == {"sift", "disk"}
    for choice in choices:
        weights = [f"localization.extractor.weights={disk}", f"localization.matcher.weights={lightglue}"]
        given = [f"+localization={choice}", *(weights if choice == "disk" else []), "paths.run=x"]
        config = compose("train", given).localization
        parts = {name: instantiate(config[name]) for name in ("extractor", "matcher")}
        assert parts["extractor"].name.startswith("disk" if choice == "disk" else "rootsift")
        assert (parts["matcher"] is None) == (choice == "sift")
