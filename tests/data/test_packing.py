"""Packed recordings: how exactly rotations are kept, what is refused, and the cache of a data set."""

import os
import shutil
from dataclasses import replace

import pytest
import torch

from drawn_windows import numbers
from wearcap.boundary.tensors import read_tensors, write_tensors
from wearcap.data import windows as windows_module
from wearcap.data.bodies import OtherBodies
from wearcap.data.packing import KEPT, Packed, Track, joined, kept, kept_track, quantized, require_rows
from wearcap.data.transforms import Shift
from wearcap.data.windows import Source, Windows
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.recording.store import RecordingFile
from wearcap.systems.mocap_every.training_windows import WatchContent
from wearcap_testing import small_dataset


def test_rotations_are_kept_within_a_hundredth_of_a_degree():
    R = rotation.exp(4 * torch.randn(4000, 3, generator=torch.Generator().manual_seed(1))).double()
    kept = quantized(R[:, None].float())
    assert (kept.dtype, kept.shape) == (torch.int16, (4000, 4, 1))
    back = rotation.matrix_from_quat_wxyz(kept[..., 0].double())
    off = rotation.log(R.mT @ back).norm(dim=-1).rad2deg()
    assert off.max() < 0.01


def test_recordings_lie_one_after_another():
    parts = [torch.arange(3.0), torch.arange(5.0) + 10]
    packed = Packed(*joined([Track({"floor": part}, {"size": part[:2]}) for part in parts], ["a", "b"]))
    assert packed.values["floor"].tolist() == [0, 1, 2, 10, 11, 12, 13, 14]
    assert (packed.first.tolist(), packed.length.tolist()) == ([0, 3], [3, 5])
    assert packed.constants["size"].tolist() == [[0, 1], [10, 11]]
    assert packed.bytes == 4 * (8 + 4)


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (Track({"t": torch.zeros(4, 24, 3)}, {"size": torch.zeros(5)}), r"b: values of other kinds.*24, 3.*23, 3"),
        (Track({"t": torch.zeros(4, 23, 3)}, {"size": torch.zeros(6)}), r"b: constants of other kinds.*6"),
        (Track({"t": torch.zeros(4, 23, 3), "vel": torch.zeros(4)}, {"size": torch.zeros(5)}), "values of.*vel"),
    ],
)
def test_recordings_of_other_shapes_are_refused(other, message):
    first = Track({"t": torch.zeros(9, 23, 3)}, {"size": torch.zeros(5)})
    with pytest.raises(WearcapError, match=message):
        Packed(*joined([first, other], ["a", "b"]))
    with pytest.raises(WearcapError, match="different lengths.*'b': 4"):
        require_rows({"a": first.values["t"], "b": other.values["t"]}, "file")


@pytest.mark.parametrize(
    "track",
    [
        Track({"t": torch.zeros(4, 3), "vel": torch.zeros(3, 3)}),
        Track({"R_world_head": torch.zeros(4, 3, 1).short()}),
        Track({"R_world_head": torch.zeros(4, 4, 1)}),
        Track({"object": torch.tensor([0, 2]).int()}, tables={"object": torch.zeros(2, 5)}),
        Track({"object": torch.tensor([-2, 1]).int()}, tables={"object": torch.zeros(2, 5)}),
    ],
)
def test_rows_that_compiled_loops_would_read_beyond_are_refused(track):
    with pytest.raises(WearcapError, match="rows do not belong together.*cache/windows"):
        Packed(*joined([track], ["a"]))


def test_a_track_is_the_same_from_its_file(tmp_path):
    R = rotation.exp(torch.randn(6, 3))
    track = Track({"R_world_head": R, "object": torch.arange(6).int()}, {"size": R[0]}, {"object": R})
    made = [kept_track(tmp_path / "a.safetensors", lambda: track) for _ in range(2)]
    assert made[0].flat().keys() == made[1].flat().keys()
    assert all(torch.equal(value, made[1].flat()[name]) for name, value in made[0].flat().items())


ROWS = torch.tensor([1, -1, 0])
TRACKS = [
    Track(
        {"R_world_head": torch.randn(3, 4, 2).short(), "object": ROWS.int(), "contact": ROWS > 0},
        {"size": torch.full((5,), float(number))},
        {"object": 10.0 * number + torch.arange(2.0)[:, None]},
        {"R_world_head": torch.tensor([1, 0])},
    )
    for number in range(3)
]


def mapped(folder) -> Packed:
    return Packed(*kept(folder, lambda: iter(TRACKS), ["a", "b", "c"]))


def test_what_is_mapped_from_files_is_what_was_packed(tmp_path):
    """Rows one after another, those of tables counted on; -1 still refers to zeros. A killed writing is done again."""
    for damaged in (False, True):
        if damaged:
            (tmp_path / "index.safetensors").unlink()
            (tmp_path / "values.contact").write_bytes(b"")
        packed = mapped(tmp_path)
        for name in ("R_world_head", "contact"):
            assert torch.equal(packed.values[name], torch.cat([track.values[name] for track in TRACKS]))
        assert packed.values["object"].tolist() == [1, -1, 0, 3, -1, 2, 5, -1, 4]
        assert packed.tables["object"][packed.values["object"], 0].tolist() == [1, 0, 0, 11, 0, 10, 21, 0, 20]
        assert packed.constants["size"][:, 0].tolist() == [0, 1, 2]
        assert (packed.first.tolist(), packed.length.tolist()) == ([0, 3, 6], [3, 3, 3])
        assert packed.twins["R_world_head"].tolist() == [1, 0]
    with pytest.raises(WearcapError, match="cache/windows"):
        kept(tmp_path, lambda: iter(TRACKS), ["a", "b"])


DAMAGES = {
    "values.R_world_head": torch.zeros(8, 4, 2).short(),
    "values.contact": None,
    "values.object": torch.tensor([1, -1, 0, 3, -1, 2, 5, -1, 7]).int(),
    "tables.object": torch.zeros(5, 1),
    "length": torch.tensor([3, 6, 0]),
    "twins.R_world_head": torch.tensor([[1, 2]] * 3),
}


@pytest.mark.parametrize("name", DAMAGES)
@pytest.mark.parametrize("index_agrees", [False, True])
def test_damaged_files_are_refused_and_not_read_beyond(tmp_path, name, index_agrees):
    content = DAMAGES[name]
    mapped(tmp_path)
    (tmp_path / name).unlink()
    if content is not None:
        (tmp_path / name).write_bytes(content.numpy().tobytes())
        index = read_tensors(tmp_path / "index.safetensors", "index")[1]
        if index_agrees:
            write_tensors(tmp_path / "index.safetensors", index | {name: content[None, :0].reshape(0, *content.shape)})
    with pytest.raises(WearcapError, match=r"cache/windows-… folders"):
        mapped(tmp_path)


def windows(root, content=None, **changes) -> Windows:
    settings = {"window": 40, "stride": 10, "fps": 30.0, "every": 2, "transforms": {"shift": Shift()}} | changes
    return Windows([Source(str(root))], "train", True, content=content or WatchContent(), **settings)


def alike(one: Windows, two: Windows) -> bool:
    chosen, seeds = numbers(0, 3, 9), numbers(4, 5, 6)
    return all(torch.equal(*parts) for parts in zip(one.batch(chosen, seeds), two.batch(chosen, seeds)))


def remove_joined(root) -> None:
    for folder in root.glob("cache/windows-*/joined-*"):
        shutil.rmtree(folder)


@pytest.mark.parametrize("bodies", [None, OtherBodies(arms=0.5)])
def test_a_second_training_opens_no_recording(tmp_path, monkeypatch, bodies):
    small_dataset(tmp_path)
    first = windows(tmp_path, bodies=bodies)

    def refuse(self, path, *, verify=True):
        raise AssertionError(f"{path} is opened")

    with monkeypatch.context() as patched:
        patched.setattr(RecordingFile, "__init__", refuse)
        assert alike(windows(tmp_path, bodies=bodies), first)
    (known,) = tmp_path.glob("cache/windows-*/known.json")
    content = known.read_text()
    for damaged in ("[]", '{"a": 1}', content[:-5]):
        known.write_text(damaged)
        assert alike(windows(tmp_path, bodies=bodies), first)
        assert known.read_text() == content


def test_a_data_set_that_grew_is_packed_as_one_that_was_as_large(tmp_path, monkeypatch):
    grown, whole = (small_dataset(tmp_path / name) for name in ("grown", "whole"))
    windows(grown.root)
    recording = replace(grown.load("r1"), name="r00")
    whole.add(recording, split="train", config_hash="test")
    expected = windows(whole.root)
    grown.add(recording, split="train", config_hash="test")
    makes, make = [], WatchContent.track
    monkeypatch.setattr(WatchContent, "track", lambda self, *args: makes.append(args[1]) or make(self, *args))
    assert alike(windows(grown.root), expected)
    assert makes == ["r00"]
    assert len([*grown.root.glob("cache/windows-*/joined-*")]) == 2


def test_a_second_training_reads_files_and_makes_damaged_ones_anew(tmp_path, monkeypatch):
    store = small_dataset(tmp_path)
    first = windows(tmp_path)
    files = sorted((tmp_path / "cache").rglob("windows-*/*.safetensors"))
    assert len(files) == len(store.names("train"))
    whole = files[1].read_bytes()
    files[1].write_bytes(whole[: len(whole) // 2])
    makes, make = [], WatchContent.track
    monkeypatch.setattr(WatchContent, "track", lambda self, *args: makes.append(args[1]) or make(self, *args))
    assert alike(windows(tmp_path), first)
    assert not makes  # what was joined is enough
    remove_joined(tmp_path)
    assert alike(windows(tmp_path), first)
    assert len(makes) == 1
    assert files[1].read_bytes() == whole
    assert alike(windows(tmp_path), first)
    assert len(makes) == 1
    # Other settings of the content, and recordings that changed, are other files.
    monkeypatch.setattr(WatchContent, "settings", lambda self: "other")
    windows(tmp_path)
    assert len(makes) == 1 + len(files)
    store.add(replace(store.load("r1"), name="r0"), split="train", config_hash="test")
    windows(tmp_path)
    assert len(makes) == 2 + len(files)


def test_many_recordings_are_packed_by_all_cores_into_the_same_files(tmp_path, monkeypatch):
    for name in ("one", "all"):
        small_dataset(tmp_path / name)
    first = windows(tmp_path / "one")
    monkeypatch.setattr(windows_module, "SPREAD", 2)
    monkeypatch.setattr(windows_module, "cpu_count", lambda: 2)
    with monkeypatch.context() as patched:
        patched.setattr(WatchContent, "track", lambda *args: pytest.fail("made in this process"))
        assert alike(windows(tmp_path / "all"), first)
    files = [sorted((tmp_path / name).rglob("windows-*/*.safetensors")) for name in ("one", "all")]
    for one, other in zip(*files, strict=True):
        assert one.name == other.name
        assert one.read_bytes() == other.read_bytes()


def test_a_data_set_that_is_only_read_still_trains(tmp_path):
    for name in ("written", "read"):
        small_dataset(tmp_path / name)
    (tmp_path / "read" / "cache").touch()  # no folder can be made here, whoever runs the tests
    assert alike(windows(tmp_path / "read"), windows(tmp_path / "written"))
    assert (tmp_path / "read" / "cache").is_file()


def test_the_packings_that_were_used_last_are_kept(tmp_path):
    """Those of another training's start, and one's own, though it was made before all others."""
    small_dataset(tmp_path)
    windows(tmp_path)
    (own,) = (tmp_path / "cache").glob("windows-*")
    for age, folder in enumerate([*(own.with_name(f"windows-old{number}") for number in range(KEPT + 2)), own]):
        folder.mkdir(exist_ok=True)
        os.utime(folder, (1e9 - age, 1e9 - age))
    (tmp_path / "cache" / "other").mkdir()
    for age in range(KEPT + 2):
        (own / f"joined-old{age}").mkdir()
        os.utime(own / f"joined-old{age}", (1e9 - age, 1e9 - age))
    windows(tmp_path)
    old = {f"windows-old{age}" for age in range(KEPT - 1)}
    assert {folder.name for folder in (tmp_path / "cache").iterdir()} == old | {"other", own.name}
    assert len([*own.glob("*.safetensors")]) == 3
    assert {folder.name for folder in own.glob("joined-old*")} == {f"joined-old{age}" for age in range(KEPT - 1)}
    assert len([*own.glob("joined-*/index.safetensors")]) == 1
