"""Data sets from elsewhere: manifests and recordings of another layout, and names that lead out of the folder, are one error."""

import json
import os
import socket
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file

from hostile import in_time
from wearcap.errors import WearcapError
from wearcap.geometry.camera import Camera
from wearcap.recording import CameraStream, PointCloud, Recording, RecordingStore
from wearcap.recording.store import RecordingFile, load_recording, save_recording

VALUES: tuple[Any, ...] = (None, True, -1, 1e400, "x", [], [[]], {}, {"a": {"b": [None]}}, "\ud800", 1 << 70)
CAMERA = CameraStream(torch.arange(3.0).double(), Camera("pinhole", 4, 4, 1, 1, 2, 2), torch.eye(3), torch.zeros(3))


@pytest.fixture(autouse=True)
def soon():
    with in_time():
        yield


@pytest.fixture
def store(tmp_path) -> RecordingStore:
    store = RecordingStore(tmp_path / "data")
    store.add(Recording("walk", points=PointCloud(torch.zeros(2, 3)), camera=CAMERA), split="test", config_hash="1")
    return store


def manifests() -> list[tuple[str, Any]]:
    """(where in a manifest, what stands there instead)"""
    whole = [((), value) for value in VALUES] + [(("recordings",), value) for value in VALUES if value != {}]
    rows = [(("recordings", "walk"), value) for value in VALUES]
    numbers = [
        (("recordings", "walk", key), value) for key in ("frames", "fps", "bytes", "duration_s") for value in VALUES
    ]
    texts = [
        (("recordings", "walk", key), value) for key in ("file", "split", "subject") for value in (None, 3, [], {})
    ]
    return [*whole, *rows, *numbers, *texts]


def changed(content: Any, where: tuple[str, ...], value: Any) -> Any:
    return {**content, where[0]: changed(content.get(where[0]), where[1:], value)} if where else value


def test_a_manifest_of_another_layout_is_one_error(store):
    good = json.loads(store.manifest_path.read_text())
    cases = manifests()
    assert len(cases) > 60
    for where, value in cases:
        store.manifest_path.write_text(json.dumps(changed(good, where, value)))
        with pytest.raises(WearcapError, match=r"manifest\.json: "):
            RecordingStore.open(store.root)
    for key in good["recordings"]["walk"]:
        row = {name: value for name, value in good["recordings"]["walk"].items() if name != key}
        store.manifest_path.write_text(json.dumps(changed(good, ("recordings", "walk"), row)))
        with pytest.raises(WearcapError, match=rf"manifest\.json: .*{key}"):
            RecordingStore.open(store.root)
    for name in ("", "..", "a/b", "a\nb", "\x1b[2J", "a" * 300):
        rows = {name: good["recordings"]["walk"] | {"file": f"recordings/{name}.safetensors"}}
        store.manifest_path.write_text(json.dumps(changed(good, ("recordings",), rows)))
        with pytest.raises(WearcapError, match="cannot name a recording"):
            RecordingStore.open(store.root)


def test_what_a_newer_manifest_says_beside_is_left(store):
    good = json.loads(store.manifest_path.read_text())
    store.manifest_path.write_text(json.dumps(changed(good, ("recordings", "walk", "mood"), "merry") | {"more": [1]}))
    assert RecordingStore.open(store.root).names() == ["walk"]


def test_a_description_of_another_layout_is_one_error(tmp_path):
    path = tmp_path / "x.safetensors"
    tensors = {"times": torch.arange(3.0).double(), "points": torch.zeros(3, 3)}
    points = {"$type": "PointCloud", "points_world": {"$tensor": "points"}}
    camera = {
        "$type": "CameraStream",
        "timestamps": {"$tensor": "times"},
        "camera": {"$type": "Camera", "model": "pinhole", "width": 4, "height": 4, "fx": 1, "fy": 1, "cx": 2, "cy": 2},
    }
    good = {"schema_version": 1, "recording": {"$type": "Recording", "name": "x", "points": points, "camera": camera}}
    odd = (*VALUES, {"$tensor": 3}, {"$tensor": []}, {"$tuple": 3}, {"$type": []}, {"$type": "Camera", "model": {}})
    places = [(), ("recording",), ("schema_version",)]
    places += [
        ("recording", key) for key in ("$type", "points", "camera", "name", "motion", "imu", "skeleton", "shape")
    ]
    places += [("recording", "points", key) for key in ("$type", "points_world", "first_seen")]
    places += [("recording", "camera", key) for key in ("timestamps", "camera", "image_files", "video")]
    places += [("recording", "camera", "camera", key) for key in ("model", "width", "fx", "distortion")]
    opened, refusals = 0, []
    for where in places:
        for value in odd:
            save_file(tensors, path, {"wearcap": json.dumps(changed(good, where, value))})
            try:
                opened += isinstance(RecordingFile(path).load(), Recording)
            except WearcapError as error:
                refusals.append(str(error))
    assert all(message.startswith(f"{path}: ") and "\n" not in message for message in refusals)
    assert len(refusals) + opened == len(places) * len(odd)
    assert len(refusals) > 3 * opened, "most are refused"


KINDS = {
    "pipe": os.mkfifo,
    "socket": lambda path: socket.socket(socket.AF_UNIX).bind(os.path.relpath(path)),
    "folder": Path.mkdir,
    "link to a device": lambda path: path.symlink_to("/dev/zero"),
    "link to nothing": lambda path: path.symlink_to("nothing"),
    "link to itself": lambda path: path.symlink_to(path),
}


@pytest.mark.skipif(os.name != "posix", reason="pipes and links as of POSIX")
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("place", ["recording", "manifest"])
def test_what_is_no_regular_file_is_one_error(store, kind, place, monkeypatch):
    path = store.path_of("walk") if place == "recording" else store.manifest_path
    path.unlink()
    monkeypatch.chdir(path.parent)
    KINDS[kind](path)
    for read in (
        store.load,
        store.verify_one,
        lambda _: load_recording(store.root / "walk"),
        lambda _: load_recording(path),
    ):
        with pytest.raises(WearcapError):
            read("walk") if place == "recording" else RecordingStore.open(store.root).load("walk")


OUTSIDE = (
    "/proc/x.ply",
    "../x.ply",
    "scenes/../../x.ply",
    "link/x.ply",
    "device",
    "pipe",
    "a\nb",
    "",
    "..",
    "a\\b",
    "/",
)


@pytest.mark.skipif(os.name != "posix", reason="pipes and links as of POSIX")
@pytest.mark.parametrize("part", ["scene", "environment", "video"])
@pytest.mark.parametrize("name", [name for name in OUTSIDE if name])
def test_a_recording_names_files_of_its_data_set_alone(store, part, name):
    (store.root / "link").symlink_to("/proc")
    (store.root / "device").symlink_to("/dev/zero")
    os.mkfifo(store.root / "pipe")
    changes = {"camera": replace(CAMERA, video=name)} if part == "video" else {part: name}
    save_recording(replace(store.load("walk"), **changes), path := store.root / "recordings" / "evil.safetensors")
    for read in (RecordingFile(path).load, lambda: RecordingFile(path).part("camera" if part == "video" else part)):
        with pytest.raises(WearcapError, match=r"evil\.safetensors|/(device|pipe): a"):
            read()


def test_a_file_that_is_not_there_yet_may_be_named(store):
    store.add(replace(store.load("walk"), scene="scenes/room/pointcloud.ply"), split="test", config_hash="2")
    assert store.load("walk").scene == "scenes/room/pointcloud.ply"
