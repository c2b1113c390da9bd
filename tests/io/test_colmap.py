"""COLMAP models in both encodings, against numbers written by hand."""

import struct
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given

from hostile import fuzz, mutated, mutated_bytes
from wearcap.errors import WearcapError
from wearcap.io.formats.colmap import read_colmap

CAMERAS = {
    1: ("SIMPLE_PINHOLE", 0, [500.0, 320.0, 240.0]),
    2: ("PINHOLE", 1, [500.0, 510.0, 320.0, 240.0]),
    3: ("SIMPLE_RADIAL", 2, [500.0, 320.0, 240.0, 0.1]),
    4: ("RADIAL", 3, [500.0, 320.0, 240.0, 0.1, -0.02]),
    5: ("OPENCV", 4, [500.0, 510.0, 320.0, 240.0, 0.1, -0.02, 0.003, 0.004]),
    6: ("OPENCV_FISHEYE", 5, [500.0, 510.0, 320.0, 240.0, 0.1, -0.02, 0.003, 0.004]),
}
HALF = 0.5**0.5
IMAGES = [  # number, qw qx qy qz tx ty tz, camera, name, points
    (7, (HALF, 0.0, 0.0, HALF, 1.0, 2.0, 3.0), 5, "b.jpg", [(10.5, 20.5, 40), (1.0, 2.0, -1)]),
    (3, (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 4.0), 1, "a b.jpg", [(320.0, 240.0, 9), (30.0, 40.0, 40)]),
]
POINTS = [(40, (1.0, 2.0, 3.0), (1, 2, 3), [(7, 0), (3, 1)]), (9, (0.0, 0.0, 1.0), (255, 0, 9), [(3, 0)])]


def write_text_model(folder: Path) -> None:
    def words(*values) -> str:
        return " ".join(map(str, values)) + "\n"

    cameras = [words(n, model, 640, 480, *values) for n, (model, _, values) in CAMERAS.items()]
    images = [
        words(n, *pose, camera, name) + words(*(value for row in points for value in row))
        for n, pose, camera, name, points in IMAGES
    ]
    points = [words(n, *xyz, *rgb, 0.5, *np.ravel(track)) for n, xyz, rgb, track in POINTS]
    for name, lines in (("cameras", cameras), ("images", images), ("points3D", points)):
        (folder / f"{name}.txt").write_text("# a comment\n" + "".join(lines))


def write_binary_model(folder: Path) -> None:
    def counted(rows: list[bytes]) -> bytes:
        return struct.pack("<Q", len(rows)) + b"".join(rows)

    cameras = [struct.pack(f"<iiQQ{len(v)}d", n, kind, 640, 480, *v) for n, (_, kind, v) in CAMERAS.items()]
    images = [
        struct.pack("<I7dI", n, *pose, camera)
        + name.encode()
        + b"\0"
        + counted([struct.pack("<ddq", *row) for row in points])
        for n, pose, camera, name, points in IMAGES
    ]
    points = [
        struct.pack("<Q3d3Bd", n, *xyz, *rgb, 0.5) + counted([struct.pack("<ii", *row) for row in track])
        for n, xyz, rgb, track in POINTS
    ]
    for name, rows in (("cameras", cameras), ("images", images), ("points3D", points)):
        (folder / f"{name}.bin").write_bytes(counted(rows))


WRITERS = {"text": write_text_model, "binary": write_binary_model}


@pytest.mark.parametrize("kind", WRITERS)
def test_a_model_reads_alike_in_both_encodings(tmp_path, kind):
    WRITERS[kind](tmp_path)
    model = read_colmap(tmp_path, tmp_path / "pictures")
    first, second = model.photos
    assert [photo.file.name for photo in model.photos] == ["a b.jpg", "b.jpg"]
    assert first.file.parent == tmp_path / "pictures"
    assert first.T_world_cam.t.tolist() == [0, 0, -4]
    # the camera is turned by 90° about z: its x axis points along the world's -y
    torch.testing.assert_close(second.T_world_cam.R[:, 0], torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64))
    torch.testing.assert_close(second.T_world_cam.t, torch.tensor([-2.0, 1.0, -3.0], dtype=torch.float64))
    camera = second.camera
    assert (camera.model, camera.width, camera.height) == ("opencv", 640, 480)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (500, 510, 319.5, 239.5)
    assert camera.distortion == (0.1, -0.02, 0.003, 0.004)
    tracks = model.tracks
    assert tracks.colors[tracks.point].tolist() == [[255, 0, 9], [1, 2, 3], [1, 2, 3]]
    assert tracks.points_world[tracks.point].tolist() == [[0, 0, 1], [1, 2, 3], [1, 2, 3]]
    assert tracks.photo.tolist() == [0, 0, 1]
    assert tracks.pixels.tolist() == [[319.5, 239.5], [29.5, 39.5], [10, 20]]
    # the centre of the picture is seen along the optical axis: half a pixel is not lost
    ahead, _ = first.camera.project(torch.tensor([0.0, 0.0, 1.0]))
    assert ahead.tolist() == tracks.pixels[0].tolist()


def test_tracks_of_some_photos(tmp_path):
    write_text_model(tmp_path)
    tracks = read_colmap(tmp_path).tracks
    swapped = tracks.of_photos(np.array([1, 0]))
    assert swapped.photo.tolist() == [1, 1, 0]
    assert swapped.pixels.tolist() == tracks.pixels.tolist()
    alone = tracks.of_photos(np.array([1]))
    assert (alone.photo.tolist(), alone.pixels.tolist()) == ([0], [[10, 20]])
    assert not len(tracks.of_photos(np.zeros(0, np.int64)).photo)


@pytest.mark.parametrize(
    ("number", "model", "lens"),
    [
        (1, "pinhole", ()),
        (2, "pinhole", ()),
        (3, "opencv", (0.1, 0, 0, 0)),
        (4, "opencv", (0.1, -0.02, 0, 0)),
        (5, "opencv", (0.1, -0.02, 0.003, 0.004)),
        (6, "fisheye", (0.1, -0.02, 0.003, 0.004)),
    ],
)
def test_camera_models(tmp_path, number, model, lens):
    write_text_model(tmp_path)
    text = (tmp_path / "images.txt").read_text().replace(" 1 a b.jpg", f" {number} a b.jpg")
    (tmp_path / "images.txt").write_text(text)
    camera = read_colmap(tmp_path).photos[0].camera
    assert (camera.model, camera.distortion, camera.fx) == (model, lens, 500)
    assert camera.fy == (510 if number in (2, 5, 6) else 500)


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin"])
def test_every_truncation_is_reported(tmp_path, file):
    write_binary_model(tmp_path)
    content = (tmp_path / file).read_bytes()
    for stop in (1, 9, len(content) // 2, len(content) - 1):
        (tmp_path / file).write_bytes(content[:stop])
        with pytest.raises(WearcapError, match=f"{file}: it ends inside"):
            read_colmap(tmp_path)


@pytest.mark.parametrize(
    ("file", "old", "new", "match"),
    [
        ("cameras.txt", "1 SIMPLE_PINHOLE", "1 FOV", "cameras.txt, line 2: camera model FOV is not supported"),
        ("cameras.txt", "640 480 500.0 320.0 240.0\n", "640 480 500.0 320.0\n", "3 finite numbers"),
        ("cameras.txt", "640", "wide", "CAMERA_ID MODEL"),
        ("images.txt", "1 a b.jpg", "12 a b.jpg", "names camera 12"),
        ("images.txt", "3 1.0 0.0", "3 0.0 0.0", "no valid pose"),
        ("images.txt", "10.5 20.5 40", "10.5 20.5", "X Y POINT3D_ID"),
        ("points3D.txt", "255 0 9", "256 0 9", "POINT3D_ID X Y Z"),
        ("points3D.txt", "40 1.0", "40 nan", "NaN"),
    ],
)
def test_what_is_wrong_is_reported_with_its_line(tmp_path, file, old, new, match):
    write_text_model(tmp_path)
    text = (tmp_path / file).read_text()
    assert old in text
    (tmp_path / file).write_text(text.replace(old, new))
    with pytest.raises(WearcapError, match=match):
        read_colmap(tmp_path)


def test_missing_files_and_a_line_that_is_missing(tmp_path):
    with pytest.raises(WearcapError, match="cameras.txt: no such file"):
        read_colmap(tmp_path)
    write_text_model(tmp_path)
    text = (tmp_path / "images.txt").read_text().rstrip("\n")
    (tmp_path / "images.txt").write_text(text[: text.rindex("\n")])
    with pytest.raises(WearcapError, match="it ends after image 'a b.jpg'"):
        read_colmap(tmp_path)


def test_unknown_models_by_number(tmp_path):
    write_binary_model(tmp_path)
    content = bytearray((tmp_path / "cameras.bin").read_bytes())
    for number, match in ((7, "FOV"), (99, "number 99")):
        content[12:16] = struct.pack("<i", number)
        (tmp_path / "cameras.bin").write_bytes(bytes(content))
        with pytest.raises(WearcapError, match=f"camera model {match} is not supported"):
            read_colmap(tmp_path)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("kind", WRITERS)
def test_damaged_models_are_read_or_refused(tmp_path, kind, name):
    WRITERS[kind](tmp_path)
    path = tmp_path / f"{name}.{'txt' if kind == 'text' else 'bin'}"
    content = path.read_bytes()

    @fuzz
    @given(mutated_bytes(content) if kind == "binary" else mutated(content.decode()))
    def attempt(damaged):
        path.write_bytes(damaged if kind == "binary" else damaged.encode())
        with suppress(WearcapError):
            read_colmap(tmp_path)

    attempt()


@pytest.mark.real
def test_the_real_model_reprojects_its_tracks(real_data):
    model = read_colmap(real_data / "visual_loc" / "sfm_reference")
    assert len(model.photos) == 78
    assert model.tracks.points_world.shape == (9734, 3)
    assert all(photo.file.is_file() for photo in model.photos)
    errors = []
    for number, photo in enumerate(model.photos):
        mine = model.tracks.photo == number
        points = torch.from_numpy(model.tracks.points_world[model.tracks.point[mine]])
        pixels, _ = photo.camera.project(photo.T_world_cam.inverse() @ points)
        errors.append(np.linalg.norm(pixels.numpy() - model.tracks.pixels[mine], axis=1))
    assert np.concatenate(errors).mean() < 1.0  # its makers state 0.82 px
