"""Learned features behind the protocols: end to end with weights made here, and the errors without them."""

import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from safetensors.torch import save_file
from textured_room import CAMERA, photo_poses, photograph, take_photos, textured_room

from wearcap.cli.conf import compose, conf_dir
from wearcap.errors import WearcapError
from wearcap.localization.features import Features
from wearcap.localization.learned import LightGlueMatcher, NetVladDescriptor, SuperPointExtractor
from wearcap.localization.localizer import Localizer
from wearcap.localization.map_builder import MapSettings, build_map
from wearcap.localization.point_map import PointMapper
from wearcap.models.lightglue import LightGlue
from wearcap.models.netvlad import NetVLAD
from wearcap.models.superpoint import SuperPoint
from wearcap.models.weights import read_weights
from wearcap.scene.scan import Scan


def _saved(network: torch.nn.Module, folder) -> str:
    path = folder / "weights.safetensors"
    save_file({name: value.contiguous() for name, value in network.state_dict().items()}, path)
    return str(path)


@pytest.fixture(scope="module")
def superpoint(tmp_path_factory) -> str:
    torch.manual_seed(0)
    return _saved(SuperPoint(), tmp_path_factory.mktemp("superpoint"))


@pytest.fixture(scope="module")
def lightglue(tmp_path_factory) -> str:
    """Set by hand: layers that change nothing, similarity 30 times the descriptors', all matchable, in old names."""
    network = LightGlue().requires_grad_(False)
    for layer in network.transformers:
        for block in (layer.self_attn, layer.cross_attn):
            block.ffn[3].weight.zero_()
            block.ffn[3].bias.zero_()
    for assignment in network.log_assignment:
        assignment.final_proj.weight.copy_(torch.eye(256) * (30 * 16) ** 0.5)
        assignment.final_proj.bias.zero_()
        assignment.matchability.weight.zero_()
        assignment.matchability.bias.fill_(10)
    old = {}
    for name, value in network.state_dict().items():
        parts = name.split(".")
        if parts[0] == "transformers":
            parts[:3] = [parts[2], parts[1]]
        old[".".join(parts)] = value
    path = tmp_path_factory.mktemp("lightglue") / "superpoint_lightglue.pth"
    torch.save(old, path)
    return str(path)


@pytest.fixture(scope="module")
def netvlad(tmp_path_factory) -> str:
    torch.manual_seed(1)
    network = NetVLAD(clusters=4, whitened=8, bias=True)
    path = tmp_path_factory.mktemp("netvlad") / "checkpoint.pth.tar"
    torch.save({"epoch": 1, "state_dict": network.state_dict(), "best_score": np.float64(0.1)}, path)
    return str(path)


def picture(seed: int = 0, height: int = 120, width: int = 168) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.kron(rng.integers(0, 256, (height // 4, width // 4, 3)), np.ones((4, 4, 1))).astype(np.uint8)


def some_features(count: int, seed: int) -> Features:
    rng = np.random.default_rng(seed)
    descriptors = rng.normal(size=(count, 256)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    keypoints = rng.uniform(0, [639, 479], (count, 2)).astype(np.float32)
    return Features(keypoints, descriptors, np.ones(count, np.float32), (640, 480))


def test_superpoint_extracts_from_a_picture(superpoint):
    extract = SuperPointExtractor(superpoint, max_keypoints=150)
    features = extract(picture())
    assert 20 < len(features) <= 150
    assert features.size == (168, 120)
    assert features.keypoints.min() >= 4
    assert (features.keypoints < np.array([168, 120]) - 4).all()
    assert (features.scores > 0.005).all()
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1, atol=1e-5)
    again = extract(picture())
    np.testing.assert_array_equal(features.keypoints, again.keypoints)
    np.testing.assert_array_equal(features.descriptors, again.descriptors)


def test_a_threshold_drops_weak_keypoints(superpoint):
    scores = SuperPointExtractor(superpoint)(picture()).scores
    middle = float(np.median(scores))
    kept = SuperPointExtractor(superpoint, threshold=middle)(picture())
    np.testing.assert_array_equal(kept.scores, scores[scores > middle])
    assert len(SuperPointExtractor(superpoint, threshold=0.99)(picture())) == 0


def test_keypoints_of_a_shrunk_picture_are_in_its_own_pixels(superpoint):
    """A picture with every pixel doubled, searched at half its size, has the small one's keypoints."""
    small = picture()
    large = small.repeat(2, 0).repeat(2, 1)
    expected = SuperPointExtractor(superpoint)(small)
    found = SuperPointExtractor(superpoint, max_side=168)(large)
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
    np.testing.assert_array_equal(matches[:, 1], order.argsort())
    assert matches.dtype == np.int64


def test_lightglue_leaves_strangers_unpaired(lightglue):
    match = LightGlueMatcher(lightglue, min_probability=0.9)
    assert len(match(some_features(40, seed=4), some_features(50, seed=5))) == 0
    assert match(some_features(40, seed=4), some_features(0, seed=5)).shape == (0, 2)


def test_a_picture_is_matched_with_itself(superpoint, lightglue):
    features = SuperPointExtractor(superpoint, max_keypoints=80)(picture())
    distinct = features.subset(np.arange(0, len(features), 4))
    matches = LightGlueMatcher(lightglue, min_probability=0.0)(distinct, distinct)
    np.testing.assert_array_equal(matches[:, 0], matches[:, 1])


def test_netvlad_describes_a_picture(netvlad):
    describe, nothing = NetVladDescriptor(netvlad), some_features(0, seed=0)
    vector = describe(picture(), nothing)
    assert vector.shape == (8,)
    np.testing.assert_allclose(np.linalg.norm(vector), 1, atol=1e-5)
    np.testing.assert_array_equal(vector, describe(picture(), nothing))
    large = picture().repeat(2, 0).repeat(2, 1)
    np.testing.assert_allclose(NetVladDescriptor(netvlad, max_side=168)(large, nothing), vector, atol=1e-5)


def test_other_weights_have_another_name(superpoint, netvlad, tmp_path):
    torch.manual_seed(9)
    other = SuperPointExtractor(_saved(SuperPoint(), tmp_path))
    assert other.name.startswith("superpoint-")
    assert other.name != SuperPointExtractor(superpoint).name == SuperPointExtractor(superpoint).name
    assert NetVladDescriptor(netvlad).name.startswith("netvlad-")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (SuperPointExtractor, "licensed by Magic Leap .*localization.extractor.weights=PATH"),
        (LightGlueMatcher, "superpoint_lightglue.pth .*localization.matcher.weights=PATH"),
        (NetVladDescriptor, "pytorch-NetVlad .*localization.descriptor.weights=PATH"),
    ],
)
def test_without_weights_it_names_where_to_get_them(make, message):
    with pytest.raises(WearcapError, match=message):
        make(None)
    with pytest.raises(WearcapError, match=f"nowhere.pth: there is no such file.*{message}"):
        make("nowhere.pth")


@pytest.mark.parametrize("make", [LightGlueMatcher, NetVladDescriptor])
def test_another_network_s_weights_are_refused(make, superpoint):
    with pytest.raises(WearcapError, match="these are not the weights of .* missing .* unexpected .*conv1a"):
        make(superpoint)


def test_netvlad_of_another_trunk_is_refused(netvlad, tmp_path):
    state = dict(read_weights(netvlad))
    state["encoder.0.weight"] = torch.zeros(64, 1, 3, 3)
    torch.save(state, tmp_path / "w.pth")
    with pytest.raises(WearcapError, match="encoder.0.weight is 64×1×3×3 and should be 64×3×3×3"):
        NetVladDescriptor(tmp_path / "w.pth")


def test_wrong_use_is_explained(superpoint, lightglue):
    with pytest.raises(WearcapError, match="at least one keypoint"):
        SuperPointExtractor(superpoint, max_keypoints=0)
    with pytest.raises(WearcapError, match="20×40 pixels is too small"):
        SuperPointExtractor(superpoint)(np.zeros((40, 20, 3), np.uint8))
    with pytest.raises(WearcapError, match="device 'abacus'"):
        SuperPointExtractor(superpoint, device="abacus")
    sift = Features(np.zeros((3, 2), np.float32), np.zeros((3, 128), np.float32), np.ones(3, np.float32), (64, 64))
    with pytest.raises(WearcapError, match="descriptors of 128 numbers"):
        LightGlueMatcher(lightglue)(sift, sift)


def spread_descriptors(network: SuperPoint, image: np.ndarray) -> None:
    """Descriptors of random weights are nearly one vector; the last layer is set so that an image's spread out."""
    for module in network.modules():
        if isinstance(module, torch.nn.Conv2d):
            torch.nn.init.kaiming_normal_(module.weight)
            torch.nn.init.zeros_(module.bias)
    seen = []
    hook = network.convDb.register_forward_hook(lambda _, inputs, output: seen.append(output))
    network.dense(torch.from_numpy(image).float().mean(-1)[None, None] / 255)
    hook.remove()
    outputs = seen[0][0].flatten(1)
    mean = outputs.mean(1)
    axes, spread, _ = torch.linalg.svd(outputs - mean[:, None], full_matrices=False)
    whiten = torch.zeros(256, 256)
    whiten[:64] = (axes[:, :64] / spread[:64] * spread[0]).T
    network.convDb.weight.copy_((whiten @ network.convDb.weight[:, :, 0, 0])[:, :, None, None])
    network.convDb.bias.copy_(-whiten @ mean)


@pytest.mark.slow
def test_a_map_of_learned_features_finds_where_its_photo_was_taken(lightglue, netvlad, tmp_path):
    """The whole way through map, retrieval, matching and pose; weights made here know their own photo at best."""
    mapper = PointMapper(textured_room(spacing=0.02), 0.015)
    photos = take_photos(mapper, CAMERA, photo_poses(3), tmp_path)
    image = photograph(mapper, CAMERA, photos[1].T_world_cam)
    torch.manual_seed(0)
    network = SuperPoint().requires_grad_(False)
    spread_descriptors(network, image)
    extract = SuperPointExtractor(_saved(network, tmp_path), max_keypoints=200)
    describe = NetVladDescriptor(netvlad, max_side=96)
    scan = Scan(mapper.scan.points)
    room_map = build_map(photos, scan, extract, descriptor=describe, settings=MapSettings(splat_m=0.015))
    assert (room_map.extractor, room_map.descriptor) == (extract.name, describe.name)
    pose = Localizer(room_map, extract, LightGlueMatcher(lightglue), descriptor=describe)(image, CAMERA)
    assert pose is not None
    assert pose.inliers > 50
    torch.testing.assert_close(pose.t_world_cam, photos[1].T_world_cam.t.float(), atol=2e-3, rtol=0)


def test_every_choice_of_the_config_builds(superpoint, lightglue, netvlad):
    choices = {path.stem for path in (conf_dir() / "localization").glob("*.yaml")}
    weights = {
        "extractor": ("superpoint", superpoint),
        "matcher": ("superpoint", lightglue),
        "descriptor": ("superpoint_netvlad", netvlad),
    }
    for choice in choices:
        given = [
            f"localization.{part}.weights={path}"
            for part, (prefix, path) in weights.items()
            if choice.startswith(prefix)
        ]
        config = compose("train", [f"+localization={choice}", *given, "paths.run=x"]).localization
        parts = {name: instantiate(config[name]) for name in ("extractor", "matcher", "descriptor")}
        assert parts["extractor"].name.startswith("superpoint" if given else "rootsift")
        assert (parts["matcher"] is None) == (choice == "sift")
        assert (parts["descriptor"] is None) == (choice != "superpoint_netvlad")
    assert choices == {"sift", "superpoint", "superpoint_netvlad"}
