"""`photos.json`: what is written is read, and what strangers wrote is refused with its place."""

import json

import pytest
import torch

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.io.formats.camera_json import read_photos, write_photos
from wearcap.scene.scan import Photo

FISHEYE = Camera("fisheye", 640, 640, 230.0, 231.0, 319.5, 320.5, (0.01, -0.002, 0.0, 0.001))


def two_photos(folder):
    poses = rotation.exp(torch.tensor([[0.3, -0.2, 1.0], [0.0, 2.0, 0.1]]))
    return [
        Photo(folder / "photos" / f"0000{k}-cam0.jpg", FISHEYE, Rigid(poses[k], torch.tensor([1.0, 2.0, k])))
        for k in range(2)
    ]


def test_what_is_written_is_read(tmp_path):
    photos = two_photos(tmp_path)
    write_photos(photos, tmp_path)
    again = read_photos(tmp_path)
    assert [photo.file for photo in again] == [photo.file for photo in photos]
    for one, two in zip(photos, again):
        assert one.camera == two.camera
        torch.testing.assert_close(one.T_world_cam.R, two.T_world_cam.R)
        torch.testing.assert_close(one.T_world_cam.t, two.T_world_cam.t)


def test_files_may_be_given_relative_to_the_folder(tmp_path):
    photo = two_photos(tmp_path)[0]
    write_photos([Photo(photo.file.relative_to(tmp_path), photo.camera, photo.T_world_cam)], tmp_path)
    assert read_photos(tmp_path)[0].file == photo.file


def test_a_photo_outside_its_scene_is_not_written(tmp_path):
    with pytest.raises(WearcapError, match="outside"):
        write_photos(two_photos(tmp_path / "elsewhere"), tmp_path / "scene")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda row: row.pop("camera"), "lacks 'camera'"),
        (lambda row: row["camera"].update(model="round"), "no camera model"),
        (lambda row: row["camera"].update(fx="wide"), "no intrinsics"),
        (lambda row: row["camera"].update(fx=-1.0), "positive"),
        (lambda row: row.update(file="../../secret.jpg"), "it names the file"),
        (lambda row: row.update(R_world_cam=[[1, 0, 0], [0, 1, 0], [0, 0, 2]]), "no rotation"),
        (lambda row: row.update(t_world_cam=[1, 2]), "shapes"),
        (lambda row: row.update(t_world_cam=[1, 2, float("nan")]), "finite"),
    ],
)
def test_a_wrong_photo_is_named(tmp_path, change, message):
    write_photos(two_photos(tmp_path), tmp_path)
    path = tmp_path / "photos.json"
    content = json.loads(path.read_text())
    change(content["photos"][1])
    path.write_text(json.dumps(content))
    with pytest.raises(WearcapError, match=message) as caught:
        read_photos(tmp_path)
    assert "photo 1" in str(caught.value)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"photos": 3}', '{"pictures": []}'])
def test_a_file_that_is_no_list_is_refused(tmp_path, text):
    (tmp_path / "photos.json").write_text(text)
    with pytest.raises(WearcapError):
        read_photos(tmp_path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(WearcapError, match="photos.json"):
        read_photos(tmp_path)
