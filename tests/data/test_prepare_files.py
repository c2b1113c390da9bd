"""Files that recordings name and that lie elsewhere become files of the data set, with what is read beside them."""

import os
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from boxes import box_mesh
from data_prep.keypoints import Simulated, keypoints_dataset
from data_prep.shared.engine import Task
from data_prep.shared.engine import prepare as prepare_tasks
from hostile import in_time
from mvnx_files import mvnx
from wearcap.cli import prepare
from wearcap.errors import WearcapError
from wearcap.geometry.camera import Camera
from wearcap.io.formats.environment import read_environment, write_environment
from wearcap.io.formats.scene_folder import used_files
from wearcap.prepare import files
from wearcap.prepare.files import with_own_files
from wearcap.recording import CameraStream, Recording, RecordingStore
from wearcap.scene.objects import Environment, Freedom, SceneObject
from wearcap.systems.hps.camera import MapLocalization
from wearcap_testing import small_dataset, swaying_motion


@pytest.fixture
def place(tmp_path) -> Path:
    """A folder from elsewhere: scan, map, environment with a mesh, video, pictures, and what nobody names."""
    folder = tmp_path / "elsewhere" / "room"
    mesh = box_mesh((0, 0, 0), (1, 1, 1))
    box = SceneObject("box", "box", mesh, torch.eye(3), torch.zeros(3), Freedom("free"))
    write_environment(Environment((box,)), folder)
    for name in ("pointcloud.ply", "map.safetensors", "video.mp4", "0.jpg", "private.txt"):
        (folder / name).write_bytes(name.encode())
    os.mkfifo(folder / "pipe")
    return folder


def recording(place: Path) -> Recording:
    camera = CameraStream(torch.arange(1.0).double(), Camera.pinhole(4, 4, 70), torch.eye(3), torch.zeros(3))
    camera = replace(camera, video=str(place / "video.mp4"), image_files=(str(place / "0.jpg"),))
    return Recording(
        "a", camera=camera, scene=str(place / "pointcloud.ply"), environment=str(place / "environment.json")
    )


def names(recording: Recording) -> list[str]:
    assert recording.camera is not None
    found = (recording.scene, recording.environment, recording.camera.video, *(recording.camera.image_files or ()))
    return [name for name in found if name]


@pytest.mark.parametrize("linked", [True, False])
def test_files_from_elsewhere_become_the_data_set_s_own(place, tmp_path, monkeypatch, linked):
    if not linked:
        monkeypatch.setattr(
            files.os, "link", lambda *_: (_ for _ in ()).throw(OSError(18, "Invalid cross-device link"))
        )
    root = tmp_path / "data"
    store = RecordingStore(root)
    own = with_own_files(recording(place), root, root)
    store.add(own, split="test", config_hash="")
    shutil.rmtree(place.parent) if not linked else None
    back = RecordingStore.open(root).load("a")
    assert back.camera is not None
    assert len({Path(name).parent for name in names(back)}) == 4
    assert all((root / name).is_file() for name in names(back))
    assert (root / back.scene).read_bytes() == b"pointcloud.ply"
    assert MapLocalization().map_file(back, root).read_bytes() == b"map.safetensors"
    assert read_environment(root / back.environment).objects[0].name == "box"
    assert not {path.name for path in root.rglob("*")} & {"private.txt", "pipe"}
    if linked:
        stamps = {path: path.stat().st_mtime_ns for path in root.rglob("*")}
        assert names(with_own_files(recording(place), root, root)) == names(own), "it is there already"
        assert stamps == {path: path.stat().st_mtime_ns for path in root.rglob("*")}
        assert names(with_own_files(back, root, root)) == names(back)
        (root / back.scene).unlink()
        (root / back.scene).write_bytes(b"cut")
        with_own_files(recording(place), root, root)
        assert (root / back.scene).read_bytes() == b"pointcloud.ply", "a damaged copy is replaced"


def test_what_is_read_with_a_file_leaves_its_folder_nowhere(place):
    environment = place / "environment.json"
    assert used_files(environment) == [environment, place / "objects/box.ply"]
    for mesh in ("../x.ply", "/etc/passwd", "pipe"):
        environment.write_text(f'{{"objects": [{{"mesh": "{mesh}"}}]}}')
        with in_time():
            assert used_files(environment) == [environment]


def test_a_pipe_is_not_brought(place, tmp_path):
    with in_time(), pytest.raises(WearcapError, match="a pipe"):
        with_own_files(Recording("a", scene=str(place / "pipe")), tmp_path / "data", tmp_path / "data")


def test_every_preparation_brings_what_its_recordings_name(place, tmp_path):
    walk = replace(small_dataset(tmp_path / "made").load("r0"), name="walk", scene=str(place / "pointcloud.ply"))
    report = prepare_tasks([Task("walk", lambda: walk, "test", "1")], tmp_path / "data", jobs=1)
    assert report.written == ["walk"]
    store = RecordingStore.open(tmp_path / "data")
    assert (store.root / store.load("walk").scene).samefile(place / "pointcloud.ply")
    keypoints_dataset(store.root, tmp_path / "new", Simulated(joints=("left_wrist",)))
    moved = RecordingStore.open(tmp_path / "new")
    assert (moved.root / moved.load("walk").scene).samefile(place / "pointcloud.ply")
    (store.root / store.load("walk").scene).unlink()
    report = keypoints_dataset(store.root, tmp_path / "bare", Simulated(joints=("left_wrist",)))
    assert report.written == ["walk"], "files that were not copied along are not needed"


def test_a_suit_s_scene_comes_with_its_map(place, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = mvnx(replace(swaying_motion(480, fps=240.0), contact_prob=torch.zeros(480, 4)))
    Path("take.mvnx").write_text(re.sub(r"<(sensor\w+)>[^<]*</\1>", "", text))  # whose numbers are random
    for _ in range(2):
        prepare.main(["mvnx", "source=take.mvnx", "scene=elsewhere/room", "output=data", "jobs=1"])
        store = RecordingStore.open("data")
        (name,) = store.names()
        found = MapLocalization().map_file(store.load(name), store.root)
        assert found is not None
        assert found.read_bytes() == (place / "map.safetensors").read_bytes()
        (place / "map.safetensors").unlink()
        (place / "map.safetensors").write_bytes(b"a newer map")
