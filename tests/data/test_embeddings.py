"""Embeddings of head camera pictures: right rows, mirrored ones, kept by content, clear about what is wrong."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from PIL import Image

from data_prep.embeddings import embed_camera, embed_dataset, embedding_name
from wearcap.cli import prepare
from wearcap.errors import WearcapError
from wearcap.geometry.camera import Camera
from wearcap.models.image_encoder import EgoViewEncoder
from wearcap.recording import RecordingStore, serialize
from wearcap.recording.recording import CameraStream
from wearcap_testing import small_dataset

WIDTH, HEIGHT = 96, 72


class Corners:
    """Embeds a picture by the mean of its left and its right half; counts what it is asked for."""

    name, size, fingerprint = "corners", 2, "00000000"

    def __init__(self):
        self.seen = 0

    def embed(self, frames: torch.Tensor) -> torch.Tensor:
        self.seen += len(frames)
        middle = frames.shape[2] // 2
        return torch.stack(
            [part.float().mean((1, 2, 3)) for part in (frames[:, :, :middle], frames[:, :, middle:])], -1
        )


def write_video(path: Path, frames: int) -> np.ndarray:
    """A grey picture whose left half brightens; returns the left half's level."""
    level = np.linspace(20, 220, frames).astype(np.uint8)
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "10", "preset": "ultrafast"})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for value in level:
            picture = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
            picture[:, : WIDTH // 2] = value
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode(None))
    return level


def stream(frames: int, **pictures) -> CameraStream:
    times = torch.arange(frames, dtype=torch.float64) / 30
    return CameraStream(times, Camera.pinhole(WIDTH, HEIGHT, 75), torch.eye(3), torch.zeros(3), **pictures)


def test_every_frame_has_its_embedding_and_its_mirror_images(tmp_path):
    level = write_video(tmp_path / "videos/a.mp4", 150)
    encoder = Corners()
    camera = embed_camera(stream(150, video="videos/a.mp4"), tmp_path, encoder)
    assert camera.embedding is not None
    assert camera.embedding_mirrored is not None
    assert camera.embedding.dtype == camera.embedding_mirrored.dtype == torch.float16
    assert camera.embedding_name == embedding_name(encoder) == "corners-00000000"
    np.testing.assert_allclose(camera.embedding[:, 0].float(), level, atol=4)
    np.testing.assert_allclose(camera.embedding[:, 1].float(), 128, atol=4)
    assert torch.equal(camera.embedding_mirrored, camera.embedding.flip(1))


def test_what_was_embedded_is_not_embedded_again(tmp_path):
    write_video(tmp_path / "videos/a.mp4", 20)
    encoder = Corners()
    first = embed_camera(stream(20, video="videos/a.mp4"), tmp_path, encoder)
    (tmp_path / "videos/a.mp4").rename(tmp_path / "videos/b.mp4")
    again = embed_camera(stream(20, video="videos/b.mp4"), tmp_path, encoder)
    assert encoder.seen == 40
    assert torch.equal(first.embedding, again.embedding)
    kept = next((tmp_path / "cache/embeddings-corners-00000000").iterdir())
    kept.write_bytes(kept.read_bytes()[:-5])  # cut short: made again
    assert torch.equal(embed_camera(stream(20, video="videos/b.mp4"), tmp_path, encoder).embedding, first.embedding)
    assert encoder.seen == 80
    write_video(tmp_path / "videos/b.mp4", 21)  # another content: made anew
    embed_camera(stream(21, video="videos/b.mp4"), tmp_path, encoder, cache=tmp_path / "elsewhere")
    assert encoder.seen == 122
    assert (tmp_path / "elsewhere/embeddings-corners-00000000").is_dir()


def test_a_cached_file_has_the_usual_permissions(tmp_path):
    """safetensors' own writer lets nobody else read its files, and leaves `.tmpXXXXXX` when it is killed."""
    write_video(tmp_path / "videos/a.mp4", 20)
    embed_camera(stream(20, video="videos/a.mp4"), tmp_path, Corners())
    kept = next((tmp_path / "cache/embeddings-corners-00000000").iterdir())
    assert kept.stat().st_mode == (tmp_path / "videos/a.mp4").stat().st_mode


def test_image_files_of_several_sizes(tmp_path):
    names = []
    for number, size in enumerate([(30, 20), (30, 20), (16, 40)]):
        Image.new("RGB", size, (10 * number,) * 3).save(tmp_path / f"{number}.png")
        names.append(f"{number}.png")
    camera = embed_camera(stream(3, image_files=tuple(names)), tmp_path, Corners())
    assert camera.embedding is not None
    assert camera.embedding.tolist() == [[0, 0], [10, 10], [20, 20]]


def test_another_number_of_frames_than_of_timestamps_is_refused(tmp_path):
    write_video(tmp_path / "a.mp4", 20)
    for count in (19, 25):
        with pytest.raises(WearcapError, match=f"a.mp4: 20 pictures for {count} timestamps"):
            embed_camera(stream(count, video="a.mp4"), tmp_path, Corners())


@pytest.mark.parametrize(
    ("pictures", "message"),
    [
        ({"video": "cut.mp4"}, "cut.mp4: not a readable video"),
        ({"video": "none.mp4"}, "none.mp4: no such video"),
        ({"image_files": ("x.png", "y.png", "z.png")}, "y.png: 2 of 3 pictures are missing"),
        ({"image_files": ("x.png", "x.png", "cut.mp4")}, "cut.mp4: not a readable picture"),
        ({}, "no pictures"),
    ],
)
def test_missing_and_damaged_files_are_named(pictures, message, tmp_path):
    write_video(tmp_path / "whole.mp4", 30)
    whole = (tmp_path / "whole.mp4").read_bytes()
    (tmp_path / "cut.mp4").write_bytes(whole[: len(whole) // 2])
    Image.new("RGB", (8, 8)).save(tmp_path / "x.png")
    with pytest.raises(WearcapError, match=message):
        embed_camera(stream(3, **pictures), tmp_path, Corners())
    assert not list(tmp_path.glob("cache/*/*"))


@pytest.fixture(scope="module")
def film(tmp_path_factory) -> Path:
    store = small_dataset(tmp_path_factory.mktemp("film"), frames=(60,) * 6)
    for number, name in enumerate(store.names()):
        if name != "r2":
            write_video(store.root / f"videos/{name}.mp4", 28 + number)
            camera = stream(28 + number, video=f"videos/{name}.mp4")
            store.add(replace(store.load(name), camera=camera), split=store.entries[name].split, config_hash="made")
    return store.root


@pytest.fixture
def filmed(film, tmp_path) -> RecordingStore:
    """Recordings r0 to r5, all but r2 with a video."""
    return RecordingStore.open(shutil.copytree(film, tmp_path / "filmed"))


def test_a_data_set_gets_embeddings_and_keeps_everything_else(filmed):
    before = {name: filmed.load(name) for name in filmed.names()}
    report = embed_dataset(filmed.root, Corners())
    assert report.written == ["r0", "r1", "r3", "r4", "r5"]
    assert report.notes == {"r2": "no head camera's pictures"}
    store = RecordingStore.open(filmed.root)
    assert all(wrong is None for _, wrong in store.verify())
    for name in report.written:
        entry, recording = store.entries[name], store.load(name)
        assert (entry.split, entry.config_hash) == (filmed.entries[name].split, "made")
        assert recording.camera is not None
        assert recording.camera.embedding is not None
        assert recording.camera.embedding_name == "corners-00000000"
        plain = replace(recording.camera, embedding=None, embedding_mirrored=None, embedding_name=None)
        assert serialize.dumps(serialize.flatten(replace(recording, camera=plain))[0]) == serialize.dumps(
            serialize.flatten(before[name])[0]
        )


def test_a_second_run_does_nothing_and_a_killed_one_goes_on(filmed, monkeypatch):
    class Killed(BaseException): ...

    register = RecordingStore.register

    def dies(self, entries):
        raise Killed

    # Files are written, the manifest never learns of them.
    monkeypatch.setattr("data_prep.shared.engine.REGISTER_EVERY_S", 1000)
    monkeypatch.setattr(RecordingStore, "register", dies)
    with pytest.raises(Killed):
        embed_dataset(filmed.root, Corners())
    monkeypatch.setattr(RecordingStore, "register", register)
    encoder = Corners()
    assert len(embed_dataset(filmed.root, encoder).written) == 5
    assert encoder.seen == 0  # all from the cache
    assert all(wrong is None for _, wrong in RecordingStore.open(filmed.root).verify())
    assert len(embed_dataset(filmed.root, encoder).current) == 5
    other = Corners()
    other.fingerprint = "11111111"
    assert len(embed_dataset(filmed.root, other).written) == 5


def test_what_cannot_be_embedded_stays_in_its_data_set(filmed):
    (filmed.root / "videos/r1.mp4").unlink()
    (filmed.root / "videos/r3.mp4").write_bytes((filmed.root / "videos/r4.mp4").read_bytes())
    report = embed_dataset(filmed.root, Corners())
    assert set(report.failed) == {"r1", "r3"}
    assert "no such video" in report.failed["r1"]
    assert "32 pictures for 31 timestamps" in report.failed["r3"]
    store = RecordingStore.open(filmed.root)
    assert store.names() == filmed.names()
    assert all(wrong is None for _, wrong in store.verify())
    with pytest.raises(WearcapError, match="no recording has a head camera's pictures"):
        embed_dataset(small_dataset(filmed.root / "more", frames=(60,)).root, Corners())


def test_the_command_embeds_by_a_checkpoint(filmed, tmp_path, capsys, trusted):
    torch.manual_seed(0)
    encoder = EgoViewEncoder(size=8, channels=[4, 4, 4])
    net = {"_target_": "wearcap.models.image_encoder.EgoViewEncoder", "size": 8, "channels": [4, 4, 4]}
    state = {f"net.{key}": value for key, value in encoder.state_dict().items()}
    torch.save({"wearcap": {"config": json.dumps({"model": {"net": net}})}, "state_dict": state}, tmp_path / "e.ckpt")
    prepare.main(["embeddings", f"dataset={filmed.root}", f"checkpoint={tmp_path}/e.ckpt"])
    assert "5 written, 0 current, 0 failed" in capsys.readouterr().out
    camera = RecordingStore.open(filmed.root).load("r0").camera
    assert camera is not None
    assert camera.embedding is not None
    assert camera.embedding.shape == (28, 8)
    with pytest.raises(WearcapError, match="encoder"):
        prepare.main(["embeddings", f"dataset={filmed.root}", "encoder=egoveiw"])
    with pytest.raises(WearcapError, match="rewrites the recordings of its data set"):
        prepare.main(["embeddings", f"dataset={filmed.root}", f"output={tmp_path}/other"])
