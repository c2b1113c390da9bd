"""Codes of points and grids drawn from recordings: the frames' own, once per encoder, by seed alone."""

import dataclasses
import json

import pytest
import torch
from safetensors.torch import load_file

from wearcap.data.surroundings import PlaceCodes
from wearcap.data.transforms import Mirror
from wearcap.data.windows import Source, Windows
from wearcap.errors import WearcapError
from wearcap.models.voxel_autoencoder import VoxelAutoencoder
from wearcap.recording import PointCloud, RecordingStore
from wearcap.scene.voxels import VoxelGrid, mirrored, voxelize
from wearcap.systems.hmd2.voxel_autoencoder_training import PlaceContent
from wearcap_testing import recording_of, seeded, swaying_motion, window_of

pytestmark = pytest.mark.usefixtures("trusted")


def cloud(seed: int) -> PointCloud:
    random = torch.Generator().manual_seed(seed)
    points = torch.rand(2000, 3, generator=random) * torch.tensor([6.0, 6.0, 2.0]) - torch.tensor([3.0, 3.0, 0.0])
    return PointCloud(points, first_seen=2 * torch.rand(2000, generator=random, dtype=torch.float64))


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> RecordingStore:
    """Two recordings with points, one without, one with an empty cloud."""
    store = RecordingStore(tmp_path_factory.mktemp("places"))
    empty = PointCloud(torch.zeros(0, 3))
    for seed, points in enumerate((cloud(0), cloud(1), None, empty)):
        recording = recording_of(swaying_motion(130, seed), f"r{seed}")
        store.add(dataclasses.replace(recording, points=points), split="train", config_hash="test")
    return store


def checkpoint(path, seed: int, **settings):
    torch.manual_seed(seed)
    net = VoxelAutoencoder(**settings)
    model = {
        "_target_": "wearcap.systems.hmd2.voxel_autoencoder_training.VoxelReconstruction",
        "net": {"_target_": "wearcap.models.voxel_autoencoder.VoxelAutoencoder", **settings},
    }
    state = {f"net.{name}": value for name, value in net.state_dict().items()}
    torch.save({"wearcap": {"config": json.dumps({"model": model})}, "state_dict": state}, path)
    return net.eval()


def test_codes_are_those_of_the_frames_grids(store, tmp_path):
    net = checkpoint(tmp_path / "a.ckpt", 0, size=32)
    places, head, points = PlaceCodes(tmp_path / "a.ckpt"), store.load("r0").head, store.load("r0").points
    assert places.size == 32
    codes = load_file(places.file_of(store.root, store.entries["r0"]))
    grids = voxelize(points.points_world, head.T_world_device, net.grid, points.first_seen, head.timestamps)
    assert codes["code"].dtype == torch.float16
    torch.testing.assert_close(codes["code"].float(), net.encode(grids).detach(), atol=5e-3, rtol=2e-3)
    torch.testing.assert_close(
        codes["code_mirrored"].float(), net.encode(mirrored(grids)).detach(), atol=5e-3, rtol=2e-3
    )
    assert not torch.equal(codes["code"], codes["code_mirrored"])


@pytest.mark.parametrize("name", ["r2", "r3"])
def test_no_rows_without_points(store, tmp_path, name):
    checkpoint(tmp_path / "a.ckpt", 0, size=32)
    codes = load_file(PlaceCodes(tmp_path / "a.ckpt").file_of(store.root, store.entries[name]))
    assert codes["code"].shape == codes["code_mirrored"].shape == (0, 32)


def test_made_once_per_encoder_and_recording(store, tmp_path):
    checkpoint(tmp_path / "a.ckpt", 0, size=24)
    checkpoint(tmp_path / "b.ckpt", 1, size=24)
    checkpoint(tmp_path / "c.ckpt", 0, size=24, below_m=0.9)
    first = PlaceCodes(tmp_path / "a.ckpt")
    first.prepare([store], "train")
    files = [first.file_of(store.root, store.entries[name]) for name in ("r0", "r1")]
    assert len({file.parent for file in files}) == 1
    made = [file.stat().st_mtime_ns for file in files]
    again = PlaceCodes(tmp_path / "a.ckpt")
    again.prepare([store], "train")
    assert [again.file_of(store.root, store.entries[n]).stat().st_mtime_ns for n in ("r0", "r1")] == made
    assert len(list(files[0].parent.iterdir())) == 4
    others = [PlaceCodes(tmp_path / name).fingerprint for name in ("b.ckpt", "c.ckpt")]
    assert len({first.fingerprint, *others}) == 3


def test_another_networks_checkpoint_is_refused(tmp_path):
    content = {"config": json.dumps({"model": {"_target_": "wearcap.systems.hmd2.egoview_training.EgoView"}})}
    torch.save({"wearcap": content, "state_dict": {}}, tmp_path / "x.ckpt")
    with pytest.raises(WearcapError, match="not of VoxelAutoencoder"):
        _ = PlaceCodes(tmp_path / "x.ckpt").encoder


def drawn(store, *transforms) -> Windows:
    content, settings = PlaceContent(VoxelGrid()), {"window": 16, "stride": 16, "fps": 20.0, "every": 3}
    named = {str(number): each for number, each in enumerate(transforms)}
    return Windows([Source(str(store.root))], "train", True, content=content, transforms=named, **settings)


def test_drawn_grids_are_the_recordings_own(store):
    dataset = drawn(store)
    assert len(dataset) == 4  # two windows of each recording that has points
    for index, (name, start) in enumerate([("r0", 0), ("r0", 48), ("r1", 0), ("r1", 48)]):
        recording, frames = store.load(name), slice(start, start + 48, 3)
        points, head = recording.points, recording.head
        own = voxelize(
            points.points_world, head.T_world_device[frames], VoxelGrid(), points.first_seen, head.timestamps[frames]
        )
        torch.testing.assert_close(window_of(dataset, index).grids[: len(own)], own, atol=1e-3, rtol=0)


def test_half_of_what_is_drawn_is_mirrored(store):
    plain, both = window_of(drawn(store), 1).grids, seeded(drawn(store, Mirror()), 1, 24).grids
    flipped, same = ([torch.equal(grids, each) for grids in both] for each in (mirrored(plain), plain))
    assert all(one != other for one, other in zip(flipped, same))
    assert 4 < sum(same) < 20


def test_data_without_points_is_refused(tmp_path):
    store = RecordingStore(tmp_path)
    store.add(recording_of(swaying_motion(90), "r0"), split="train", config_hash="test")
    with pytest.raises(WearcapError, match="with points"):
        drawn(store)
