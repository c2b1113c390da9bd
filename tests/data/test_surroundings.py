"""What windows carry of the surroundings: the right codes and pictures at the right frames, also in the mirror."""

from dataclasses import replace

import pytest
import torch
from safetensors.torch import save_file

from wearcap.data.bodies import OtherBodies
from wearcap.data.surroundings import Embeddings, PlaceCodes, embeddings_of, latest_before
from wearcap.data.transforms import EarlyEnd, Mirror
from wearcap.data.windows import Source, Windows
from wearcap.errors import WearcapError
from wearcap.geometry.camera import Camera
from wearcap.recording import CameraStream, PointCloud, RecordingStore
from wearcap.scene.voxels import VoxelGrid
from wearcap.systems.hmd2.places import EVERYTHING, Places
from wearcap.systems.hmd2.training_windows import HeadContent
from wearcap.tracking.floor import floor_from_path, floor_from_points
from wearcap_testing import recording_of, seeded, swaying_motion, window_of

SIZE = 5


class CountedCodes(PlaceCodes):
    """Codes that count the frames, and count down from zero in the mirror."""

    size, key = 3, "counted"

    def __init__(self):
        pass

    def prepare(self, stores, split):
        """They are made where they are read."""

    def file_of(self, root, entry):
        path = root / f"{entry.sha256}.codes"
        if not path.exists():
            code = torch.arange(entry.frames).half()[:, None].repeat(1, 3)
            save_file({"code": code, "code_mirrored": -code}, str(path))
        return path


@pytest.fixture
def store(tmp_path) -> RecordingStore:
    """Two recordings of 300 frames, the second without pictures."""
    store = RecordingStore(tmp_path)
    for name, seed in (("a", 0), ("b", 1)):
        recording = recording_of(swaying_motion(300, seed), name)
        if name == "a":
            picture = torch.arange(150).half()[:, None].repeat(1, SIZE)
            camera = CameraStream(
                recording.head.timestamps[::2],
                Camera("pinhole", 8, 6, 4.0, 4.0, 3.5, 2.5),
                torch.eye(3),
                torch.zeros(3),
                embedding=picture,
                embedding_mirrored=-picture,
                embedding_name="toy",
            )
            recording = replace(recording, camera=camera)
        store.add(recording, split="train", config_hash="test")
    return store


def dataset(store: RecordingStore, **transforms) -> Windows:
    conditions = {"points": CountedCodes(), "image": Embeddings("toy")}
    settings = {"content": HeadContent(conditions), "window": 120, "stride": 60, "fps": 60.0}
    return Windows([Source(str(store.root))], "train", True, transforms=transforms, **settings)


def first_of(windows: Windows, name: str, start: int) -> int:
    return windows.starts.tolist().index([["a", "b"].index(name), start])


def test_codes_and_pictures_are_those_of_the_windows_frames(store):
    windows = dataset(store)
    assert windows.content.conditions["image"].size == SIZE
    window = window_of(windows, first_of(windows, "a", 60))
    frames = torch.arange(60, 180)
    assert torch.equal(window.others[:, 0], frames.float())
    assert torch.equal(window.others[:, -1], (frames // 2).float()), "each picture serves two frames"
    assert window.given.all()


def test_a_recording_without_pictures_is_reported(store):
    windows = dataset(store)
    window = window_of(windows, first_of(windows, "b", 0))
    assert window.others.shape == (120, 3 + SIZE)
    assert window.given.all(0).tolist() == [True, False]


def test_the_mirror_reads_what_the_mirror_shows(store):
    windows = dataset(store, mirror=Mirror())
    index = first_of(windows, "a", 60)
    signs = seeded(windows, index, 12).others[..., [0, -1]].sign().sum(1)
    assert {*map(tuple, signs.tolist())} == {(120.0, 120.0), (-120.0, -120.0)}


def test_beginnings_are_cut_short(store):
    whole, cut = dataset(store), dataset(store, ending=EarlyEnd(1.0))
    lengths = {*seeded(cut, 0, 20).valid.sum(1).tolist()}
    assert window_of(whole).valid.all()
    assert min(lengths) >= 10
    assert max(lengths) < 120
    assert len(lengths) > 10
    window = window_of(cut, 0, 3)
    last = int(window.valid.sum()) - 1
    assert torch.equal(window.others[last:], window.others[last : last + 1].expand(120 - last, -1))


def test_what_surrounds_a_wearer_is_not_given_with_another_body(store):
    conditions = {"points": CountedCodes(), "image": Embeddings("toy")}
    settings = {"content": HeadContent(conditions), "window": 120, "stride": 60, "fps": 60.0}
    windows = Windows([Source(str(store.root))], "train", True, bodies=OtherBodies(share=0.5), **settings)
    batch = seeded(windows, first_of(windows, "a", 0), 40)
    own = (batch.size - batch.size.mode(0).values).abs().amax(1) < 1e-6
    assert 8 < own.sum() < 32
    assert torch.equal(batch.given.all(1), own[:, None].expand(-1, 2))
    assert torch.equal(batch.floor_height[~own], batch.floor_from_head[~own])


def test_data_without_the_encoders_embeddings_is_refused(store):
    content = HeadContent({"image": Embeddings("clip")})
    with pytest.raises(WearcapError, match="no recording has embeddings of 'clip'.*prepare embeddings"):
        Windows([Source(str(store.root))], "train", content=content, window=120, stride=60, fps=60.0)


def test_the_newest_picture_counts_while_it_is_fresh():
    number, valid = latest_before(
        torch.tensor([1.0, 1.1, 2.0]).double(), torch.tensor([0.9, 1.05, 1.1, 1.25, 1.5, 2.1]).double()
    )
    assert number.tolist() == [0, 0, 1, 1, 1, 2]
    assert valid.tolist() == [False, True, True, True, False, True]
    assert not latest_before(torch.zeros(0).double(), torch.zeros(3).double())[1].any()


def test_the_floor_follows_a_storey_from_the_head_and_a_step_from_points():
    time = torch.arange(0, 120, 1 / 60).double()
    floor = torch.where(time < 60, 0.0, 2.7)
    sitting = ((time % 20) > 14).float()
    head = torch.stack([time * 0.05, 0 * time, floor + 1.6 - 0.5 * sitting], -1).float()
    found = floor_from_path(time, head, 1.6)
    away = (time - 60).abs() > 30
    assert (found - floor)[away].abs().max() < 0.02
    random = torch.Generator().manual_seed(0)
    x = 6 * torch.rand(20_000, generator=random)
    points = torch.stack([x, 2 * torch.rand(20_000, generator=random) - 1, torch.where(x < 3, 0.0, 2.7)], -1)
    points[:50] = torch.nan
    seen = floor_from_points(PointCloud(points), head, 1.6)
    assert (seen - floor)[(time - 60).abs() > 10].abs().max() < 0.03
    assert floor_from_points(PointCloud(points[:100]), head, 1.6) is None
    assert floor_from_points(None, head, 1.6) is None


def tracked(points, seen, time, head) -> torch.Tensor:
    """The floor below a head, from a whole cloud."""
    places = Places(VoxelGrid(), 1.6, 60.0, EVERYTHING)
    places.add(points, seen)
    return places.floor(time, head)


def test_a_tracked_floor_knows_nothing_of_what_comes():
    random = torch.Generator().manual_seed(0)
    time = torch.arange(0, 20, 1 / 60).double()
    head = torch.stack([0.2 * time, 0 * time, 0.3 + 1.6 + 0 * time], -1).float()
    points = torch.rand(9000, 3, generator=random) * torch.tensor([6.0, 3.0, 0.02]) - torch.tensor([1.0, 1.5, -0.29])
    seen = 20 * torch.rand(9000, generator=random).double()
    whole = tracked(points, seen, time, head)
    assert (whole - 0.3).abs().max() < 0.02
    early = seen < 10
    until = time < 10
    first = tracked(points[early], seen[early], time[until], head[until])
    assert torch.equal(whole[until], first)
    blind = tracked(points[:0], seen[:0], time, head + torch.tensor([0.0, 0.0, 0.1]))
    assert (blind - 0.4).abs().max() < 1e-3


def test_embeddings_are_found_by_their_encoders_name(store):
    assert embeddings_of("toy", [store]) == ("toy", SIZE)
    camera = store.load("a").camera
    renamed = replace(camera, embedding_name="toy-1a2b3c4d")
    store.add(replace(store.load("a"), name="c", camera=renamed), split="train", config_hash="test")
    assert embeddings_of("toy-1a2b3c4d", [store]) == ("toy-1a2b3c4d", SIZE)
    with pytest.raises(WearcapError, match="several kinds: toy with 5 features, toy-1a2b3c4d with 5"):
        embeddings_of("toy", [store])
    with pytest.raises(WearcapError, match="no recording has embeddings of 'clip'.*encoder=clip"):
        embeddings_of("clip", [store])
