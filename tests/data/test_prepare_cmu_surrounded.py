"""`wearcap prepare cmu_surrounded`: the same recordings, with points and a head camera, the same bytes again."""

from dataclasses import replace

import pytest
import torch
from hydra.utils import instantiate

import captured_motion as captured
from data_prep import cmu_surrounded
from data_prep.shared.engine import Splits
from wearcap.cli.conf import compose, splits_dir
from wearcap.cli.prepare import run
from wearcap.recording import Recording, RecordingStore
from wearcap.recording.recording import CameraStream, HeadStream
from wearcap.recording.serialize import flatten
from wearcap.recording.store import Entry, recording_path, save_recording
from wearsim.rendering.ego_view import EGO_CAMERA

MOTIONS = {"7_01": captured.walk(1.0), "35_02": captured.sit(0.5).sliced(60, 200)}


def source(root, **changed) -> RecordingStore:
    """A data set of a walk (train) and a sitter (test)."""
    store = RecordingStore(root)
    for name, motion in MOTIONS.items():
        subject, head, t = name.split("_")[0], motion.joint("head"), torch.tensor([0.09, 0.0, 0.09])
        recording = replace(
            Recording(
                name,
                head=HeadStream(motion.timestamps, head.R.contiguous(), head @ t, torch.eye(3), t),
                motion=motion,
                skeleton=motion.skeleton,
                subject=subject,
                activity="walk",
            ),
            **changed,
        )
        save_recording(recording, recording_path(root, name))
        store.register({name: Entry.of(recording, root, "train" if subject == "7" else "test", "0")})
    return store


def surrounded(root, output, *more: str):
    settings = [f"source={root}", f"output={output}", "jobs=1", "backend=threading", *more]
    return run(compose("prepare", ["prepare=cmu_surrounded", *settings]))


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """(source, report, prepared without a camera)."""
    root = tmp_path_factory.mktemp("sets")
    store = source(root / "cmu")
    return store, surrounded(root / "cmu", root / "a", "camera=false"), RecordingStore.open(root / "a")


def test_the_same_recordings_with_points(plain):
    store, report, prepared = plain
    assert report.failed == {}
    assert [prepared.names(split) for split in ("train", "test")] == [["7_01"], ["35_02"]]
    for name in MOTIONS:
        before, after = store.load(name), prepared.load(name)
        old, new = (flatten(recording)[1] for recording in (before, after))
        assert all(torch.equal(tensor, new[key]) for key, tensor in old.items())
        assert (after.subject, after.activity) == (before.subject, before.activity)
        assert after.location == f"cmu-room-{name}"
        assert after.points is not None
        assert after.points.first_seen is not None
        assert len(after.points.points_world) > 1000
        assert after.points.first_seen.min() == before.motion.timestamps[0]
        assert after.points.first_seen.max() <= before.motion.timestamps[-1]
        on_floor = (after.points.points_world[:, 2].abs() < 0.05).float().mean()
        assert on_floor > 0.02  # some of the floor was seen


def test_again_is_current_and_elsewhere_the_same_bytes(plain, tmp_path):
    store, _, prepared = plain
    again = surrounded(store.root, prepared.root, "camera=false")
    assert again.current == sorted(MOTIONS)
    surrounded(store.root, tmp_path, "camera=false")
    other = RecordingStore.open(tmp_path)
    assert {n: e.sha256 for n, e in other.entries.items()} == {n: e.sha256 for n, e in prepared.entries.items()}


def test_without_a_turn_less_is_known(plain, tmp_path):
    store, _, prepared = plain
    surrounded(store.root, tmp_path, "camera=false", "look_round=false")
    key = "points.points_world"
    known = [RecordingStore.open(root).open_file("7_01").length(key) for root in (tmp_path, prepared.root)]
    assert known[0] < 0.8 * known[1]


def test_the_camera_films_into_the_data_set(plain, tmp_path, monkeypatch):
    """What it films is `ego_view`'s own affair."""
    store, _, prepared = plain
    filmed = {}

    def film(file, world, motion, shape, t_head_device, rng):
        filmed[file] = (world.name, t_head_device.tolist(), rng.random())
        name = f"{file.parent.name}/{file.name}"
        return CameraStream(motion.timestamps[::2], EGO_CAMERA, torch.eye(3), t_head_device, video=name)

    monkeypatch.setattr(cmu_surrounded, "write_ego_video", film)
    assert surrounded(store.root, tmp_path).failed == {}
    assert filmed.keys() == {tmp_path / "videos" / f"{name}.mp4" for name in MOTIONS}
    assert filmed[tmp_path / "videos" / "7_01.mp4"][:2] == ("cmu-room-7_01", pytest.approx([0.09, 0.0, 0.09]))
    recording = RecordingStore.open(tmp_path).load("7_01")
    assert recording.camera is not None
    assert recording.camera.video == "videos/7_01.mp4"
    points = [
        root.open_file("7_01").tensor("points.points_world") for root in (RecordingStore.open(tmp_path), prepared)
    ]
    assert torch.equal(*points)


def test_a_recording_without_a_head_is_reported(tmp_path):
    source(tmp_path / "cmu", head=None)
    report = surrounded(tmp_path / "cmu", tmp_path / "a", "camera=false")
    assert report.failed.keys() == MOTIONS.keys()
    assert "no head path" in report.failed["7_01"]


def test_some_of_a_split_are_chosen_evenly(tmp_path, monkeypatch):
    monkeypatch.setitem(MOTIONS, "35_03", MOTIONS["35_02"])
    monkeypatch.setitem(MOTIONS, "35_04", MOTIONS["35_02"])
    monkeypatch.setitem(MOTIONS, "35_05", MOTIONS["35_02"])
    source(tmp_path / "cmu")

    def chosen(recordings: str) -> list[str]:
        settings = f"source={tmp_path / 'cmu'}", f"output={tmp_path / 'out'}", f"recordings={recordings}"
        config = compose("prepare", ["prepare=cmu_surrounded", *settings])
        tasks = instantiate(config.tasks, _convert_="all", _partial_=True)(splits=Splits.read(splits_dir() / "cmu.csv"))
        return [task.name for task in tasks]

    assert chosen("{test: 2}") == ["35_02", "35_04"]
    assert chosen("{train: 5, test: 5}") == ["7_01", "35_02", "35_03", "35_04", "35_05"]
    assert chosen("null") == ["35_02", "35_03", "35_04", "35_05", "7_01"]
