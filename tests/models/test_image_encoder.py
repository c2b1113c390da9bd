"""Image encoders: pictures are seen whole whatever their size, fingerprints tell weights apart."""

import json

import pytest
import torch

from data_prep.embeddings import ImageEncoder
from wearcap.errors import WearcapError
from wearcap.models.image_encoder import EgoViewEncoder, letterboxed

pytestmark = pytest.mark.usefixtures("trusted")

PLAIN = (0.0,) * 3, (1.0,) * 3


def frames(height: int, width: int, count: int = 2, seed: int = 0) -> torch.Tensor:
    random = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, (count, height, width, 3), dtype=torch.uint8, generator=random)


def test_pictures_of_the_right_size_are_only_normalised():
    pictures = frames(72, 96)
    x = letterboxed(pictures, 96, 72, (0.5,) * 3, (0.25,) * 3)
    torch.testing.assert_close(x, (pictures.movedim(-1, 1) / 255 - 0.5) / 0.25)


@pytest.mark.parametrize(("height", "width"), [(720, 1280), (1408, 1408), (100, 30), (1, 500), (9, 12)])
def test_other_sizes_are_seen_whole_and_undistorted(height, width):
    white = torch.full((1, height, width, 3), 255, dtype=torch.uint8)
    white[:, :, : width // 2] = 51
    x = letterboxed(white, 96, 72, *PLAIN)
    assert x.shape == (1, 3, 72, 96)
    scale = min(96 / width, 72 / height)
    inside = x[0, 0] > 0.1
    rows, columns = int(inside.any(1).sum()), int(inside.any(0).sum())
    assert abs(rows - height * scale) < 1.01
    assert abs(columns - width * scale) < 1.01
    assert 0.7 < float(x.flip(-1)[0, 0].amax()) <= 1.0 + 1e-6
    across = x[0, 0][inside].reshape(rows, columns)[rows // 2]
    assert across[0] < 0.3 < 0.9 < across[-1]


@pytest.fixture(scope="module")
def encoder() -> EgoViewEncoder:
    torch.manual_seed(0)
    return EgoViewEncoder().eval()


def test_our_encoder_is_small_and_keeps_the_protocol(encoder):
    assert sum(p.numel() for p in encoder.parameters()) <= 500_000
    assert isinstance(encoder, ImageEncoder)
    embedding = encoder.embed(frames(72, 96, 3))
    assert embedding.shape == (3, encoder.size) == (3, 64)
    torch.testing.assert_close(embedding.var(1, correction=0), torch.ones(3), rtol=0.05, atol=0)
    assert encoder.embed(frames(200, 200, 1)).shape == (1, 64)


def test_an_embedding_does_not_depend_on_its_neighbours(encoder):
    pictures = frames(72, 96, 5)
    alone = torch.cat([encoder.embed(picture[None]) for picture in pictures])
    torch.testing.assert_close(encoder.embed(pictures), alone, atol=1e-4, rtol=1e-4)


def test_fingerprints_tell_weights_apart(encoder):
    torch.manual_seed(0)
    same, other = EgoViewEncoder(), EgoViewEncoder()
    assert same.fingerprint == encoder.fingerprint != other.fingerprint
    assert len(encoder.fingerprint) == 8


def test_a_foreign_checkpoint_is_named(tmp_path):
    config = json.dumps({"model": {"net": {"_target_": "wearcap.systems.hmd2.model.MotionDenoiser"}}})
    torch.save({"wearcap": {"config": config}, "state_dict": {}}, tmp_path / "other.ckpt")
    with pytest.raises(WearcapError, match="a checkpoint of .*MotionDenoiser, not of EgoViewEncoder"):
        EgoViewEncoder.load(tmp_path / "other.ckpt")
