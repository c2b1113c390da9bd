"""The store: what goes in comes out, slices read only themselves, and hostile files are named and refused."""

import contextlib
import json
import struct
from dataclasses import fields, replace
from pathlib import Path

import pytest
import safetensors
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors.torch import save_file

from wearcap.body.skeleton import FOOT_PATCHES, xsens23
from wearcap.boundary import tensors
from wearcap.errors import WearcapError
from wearcap.files import sha256_of
from wearcap.geometry.camera import Camera
from wearcap.geometry.trajectory import Trajectory
from wearcap.recording import (
    CameraStream,
    ContactTrack,
    Cue,
    FingerStream,
    FloorTrack,
    HeadStream,
    ImuStream,
    Intervals,
    Localization,
    Motion,
    PointCloud,
    Recording,
    RecordingStore,
)
from wearcap.recording.motion import Interactions
from wearcap.recording.serialize import dumps, flatten, unflatten
from wearcap.recording.store import RecordingFile, save_recording
from wearcap_testing import recording_of, swaying_motion

FRAMES = 90


def rotations(*shape: int) -> torch.Tensor:
    return torch.linalg.qr(torch.randn(*shape, 3, 3)).Q


def full_recording(name: str = "all") -> Recording:
    """A recording with every part there is."""
    torch.manual_seed(0)
    times = torch.arange(FRAMES, dtype=torch.float64) / 60
    skeleton = xsens23()
    track = Trajectory(times, rotations(FRAMES), torch.randn(FRAMES, 3))
    motion = Motion(
        times,
        skeleton,
        rotations(FRAMES, len(skeleton)),
        torch.randn(FRAMES, 3),
        contact_prob=torch.rand(FRAMES, 4),
        object_motion={"door": track},
        provenance={"source": "a test"},
    )
    fingers = FingerStream(times, torch.randn(FRAMES, 25, 3), torch.ones(FRAMES, dtype=torch.bool), torch.ones(FRAMES))
    camera = Camera("pinhole", 640, 480, 500.0, 500.0, 320.0, 240.0)
    held = Interactions(
        times[:2], times[1:3], torch.tensor([[True, False], [True, True]]), ("door", ""), ("hinged", "")
    )
    motion = replace(motion, hand_contact_prob=torch.rand(FRAMES, 2), interactions=held)
    return Recording(
        name,
        head=HeadStream(times, rotations(FRAMES), torch.randn(FRAMES, 3), torch.eye(3), torch.zeros(3)),
        imu={"left": ImuStream(times, "left_wrist", gyro_imu=torch.randn(FRAMES, 3), R_joint_imu=torch.eye(3))},
        suit=motion,
        camera=CameraStream(times, camera, torch.eye(3), torch.zeros(3), image_files=("a.jpg", "b.jpg")),
        localization=Localization(times, rotations(FRAMES), torch.randn(FRAMES, 3), torch.rand(FRAMES)),
        points=PointCloud(torch.randn(50, 3), torch.rand(50), torch.rand(50, dtype=torch.float64)),
        cues={"wrist": Cue(times, "left_wrist", torch.randn(FRAMES, 2), torch.rand(FRAMES))},
        tracked={"left_wrist": track},
        fingers={"left": fingers},
        scene="room.ply",
        environment="environment.json",
        interactions=held,
        motion=motion,
        contacts=ContactTrack(times, FOOT_PATCHES, torch.rand(FRAMES, 4) > 0.5),
        object_motion={"door": track},
        floor=FloorTrack(times, torch.zeros(FRAMES)),
        origin=torch.tensor([458074.0, 5429380.0, 162.0], dtype=torch.float64),
        intervals=Intervals(times[:2], times[1:3], torch.zeros(2), ("stand", "move")),
        skeleton=skeleton,
        shape={"height": 1.8},
        subject="s1",
        location="flat",
        activity="walk",
        source="test",
        license="MIT",
        note="axes detected",
        session="pair",
    )


def assert_same(first, second) -> None:
    assert type(first) is type(second)
    if isinstance(first, torch.Tensor):
        assert first.dtype == second.dtype
        assert torch.equal(first, second)
    elif isinstance(first, dict):
        assert first.keys() == second.keys()
        for key in first:
            assert_same(first[key], second[key])
    elif hasattr(first, "__dataclass_fields__"):
        for part in fields(first):
            assert_same(getattr(first, part.name), getattr(second, part.name))
    else:
        assert first == second


@pytest.fixture
def store(tmp_path) -> RecordingStore:
    store = RecordingStore(tmp_path / "set")
    store.add(full_recording(), split="train", config_hash="1")
    return store


def test_a_recording_with_every_part_comes_back_as_it_was(store):
    assert {f.name for f in fields(Recording) if getattr(full_recording(), f.name) in (None, "", {})} == set()
    assert_same(RecordingStore.open(store.root).load("all"), full_recording())


def test_a_recording_with_hardly_any_part_comes_back(tmp_path):
    bare = Recording("bare", points=PointCloud(torch.zeros(1, 3)))
    save_recording(bare, tmp_path / "bare.safetensors")
    assert_same(RecordingFile(tmp_path / "bare.safetensors").load(), bare)


def test_a_window_is_the_slice(store):
    file = store.open_file("all")
    whole = full_recording().motion
    assert whole is not None
    assert torch.equal(file.window("motion.R_parent_joint", 20, 50), whole.R_parent_joint[20:50])
    assert file.window("motion.t_world_root", 80, 200).shape == (10, 3)
    assert file.length("motion.timestamps") == FRAMES
    assert file.part("camera").camera.width == 640
    assert file.part("nothing") is None
    with pytest.raises(WearcapError, match=r"no 'motion\.R_parent_joints'"):
        file.window("motion.R_parent_joints", 0, 1)


def test_a_window_reads_nothing_but_itself(tmp_path):
    """From a sparse file of 2 GB, of which next to nothing reaches the memory."""
    rows = 2 * 2**30 // 12
    path = tmp_path / "large.safetensors"
    description = json.dumps({"schema_version": 1, "recording": {"$type": "Recording", "name": "large"}})
    header = {
        "points.points_world": {"dtype": "F32", "shape": [rows, 3], "data_offsets": [0, rows * 12]},
        "__metadata__": {"wearcap": description},
    }
    text = json.dumps(header).encode()
    with open(path, "wb") as file:
        file.write(struct.pack("<Q", len(text)) + text)
        file.truncate(8 + len(text) + rows * 12)
    resident = lambda: int(Path("/proc/self/statm").read_text().split()[1]) * 4096  # noqa: E731
    before = resident()
    window = RecordingFile(path).window("points.points_world", rows // 2, rows // 2 + 240)
    assert window.shape == (240, 3)
    assert window.sum() == 0
    assert resident() - before < 50e6


def test_equal_recordings_have_equal_bytes(tmp_path):
    for name in ("a", "b"):
        save_recording(full_recording(), tmp_path / name)
    assert sha256_of(tmp_path / "a") == sha256_of(tmp_path / "b")


def test_the_manifest_describes_the_file(store):
    entry = store.entries["all"]
    assert (entry.frames, entry.fps, entry.context.subject, entry.split) == (FRAMES, 60.0, "s1", "train")
    assert entry.duration_s == pytest.approx(FRAMES / 60, abs=0.02)
    assert dict(store.verify()) == {"all": None}
    assert store.names("val") == []
    with pytest.raises(WearcapError, match="no split 'trian'"):
        store.names("trian")


HOSTILE = {
    "more frames than bytes": ("frames", 10**12),
    "no frames": ("frames", -1),
    "frames as text": ("frames", "90"),
    "a rate as text": ("fps", "60"),
    "a rate without end": ("fps", float("inf")),
    "no rate": ("fps", None),
    "bytes as text": ("bytes", "1"),
    "a duration that is none": ("duration_s", float("nan")),
    "another folder": ("file", "../other.safetensors"),
    "a split of its own": ("split", "every"),
    "true": ("frames", True),
    "a list": ("subject", ["s1"]),
}


@pytest.mark.parametrize("change", HOSTILE)
def test_a_manifest_is_not_taken_at_its_word(change, store):
    key, value = HOSTILE[change]
    manifest = json.loads(store.manifest_path.read_text())
    manifest["recordings"]["all"][key] = value
    store.manifest_path.write_text(json.dumps(manifest))
    with pytest.raises(WearcapError, match=r"manifest\.json: not a readable manifest"):
        RecordingStore.open(store.root)


def test_a_manifest_that_is_nested_without_end_is_refused(store):
    store.manifest_path.write_text('{"schema_version":1,"recordings":' + "[" * 100_000)
    with pytest.raises(WearcapError, match="nested too deeply"):
        RecordingStore.open(store.root)


PARTS = {
    "a motion for a head": lambda tree: tree.update(head=tree["motion"]),
    "a tensor for a part": lambda tree: tree.update(motion={"$tensor": "motion.t_world_root"}),
    "a list for a part": lambda tree: tree.update(points=[1, 2]),
    "a text for a tensor": lambda tree: tree["motion"].update(t_world_root="far"),
    "another shape": lambda tree: tree["motion"].update(t_world_root={"$tensor": "motion.R_parent_joint"}),
    "a number for a name": lambda tree: tree.update(name=3),
    "a part that is unknown": lambda tree: tree["motion"].update({"$type": "Path"}),
    "names that are numbers": lambda tree: tree["skeleton"].update(joint_names={"$tuple": [1, 2]}),
}


@pytest.mark.parametrize("part", PARTS)
def test_a_part_of_another_kind_is_refused(part, tmp_path):
    path = tmp_path / "x.safetensors"
    save_recording(full_recording(), path)
    with safetensors.safe_open(str(path), framework="pt") as file:
        tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        content = json.loads(file.metadata()["wearcap"])
    PARTS[part](content["recording"])
    save_file(tensors, path, {"wearcap": json.dumps(content)})
    with pytest.raises(WearcapError, match=r"x\.safetensors: "):
        RecordingFile(path).load()
    for name in ("head", "motion", "points", "skeleton"):
        with contextlib.suppress(WearcapError):
            RecordingFile(path).part(name)


def test_a_file_that_may_not_be_read_is_not_called_missing(store, monkeypatch):
    def refused(*_args, **_options):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(tensors, "open", refused, raising=False)
    with pytest.raises(WearcapError, match=r"all\.safetensors: no permission to read it"):
        store.load("all")


@pytest.mark.parametrize(
    "name", ["", "..", "../up", "a/b", "/etc/x", ".hidden", "a\nb", "\x1b[2J", "\ud800", "a" * 300]
)
def test_a_name_cannot_leave_the_folder(store, name):
    with pytest.raises(WearcapError, match="cannot name a recording"):
        store.add(replace(full_recording(), name=name), split="train", config_hash="")
    assert store.names() == ["all"]


def test_a_damaged_file_is_named_and_the_rest_stays_usable(store):
    for name in ("cut", "flipped", "gone"):
        store.add(full_recording(name), split="train", config_hash="1")
    cut, flipped = store.path_of("cut"), store.path_of("flipped")
    cut.write_bytes(cut.read_bytes()[:-100])
    content = bytearray(flipped.read_bytes())
    content[-5] ^= 0xFF
    flipped.write_bytes(content)
    store.path_of("gone").unlink()
    with pytest.raises(WearcapError, match=r"cut\.safetensors.*cut short"):
        store.open_file("cut")
    wrong = {name: str(error) for name, error in RecordingStore.open(store.root).verify() if error}
    assert set(wrong) == {"cut", "flipped", "gone"}
    assert "checksum" in wrong["flipped"]
    assert "no such recording" in wrong["gone"]
    assert_same(store.load("all"), full_recording())


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        "null",
        '{"schema_version": 1}',
        '{"schema_version": 1, "recordings": {"a": {}}}',
        '{"schema_version": 1, "recordings": []}',
        '{"schema_version": 1, "recordings": {"a": 3}}',
        "\0\0",
    ],
)
def test_a_broken_manifest_is_refused(tmp_path, text):
    (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(WearcapError, match=r"manifest\.json"):
        RecordingStore(tmp_path)


def test_a_manifest_of_another_version_and_a_missing_one(tmp_path):
    with pytest.raises(WearcapError, match="wearcap prepare"):
        RecordingStore.open(tmp_path)
    (tmp_path / "manifest.json").write_text('{"schema_version": 99, "recordings": {}}')
    with pytest.raises(WearcapError, match="schema version 99"):
        RecordingStore.open(tmp_path)


def test_a_manifest_cannot_point_outside(store):
    manifest = json.loads(store.manifest_path.read_text())
    manifest["recordings"]["all"]["file"] = "../../etc/passwd"
    store.manifest_path.write_text(json.dumps(manifest))
    with pytest.raises(WearcapError, match="outside"):
        RecordingStore.open(store.root)


def foreign(path: Path, description: str | None) -> Path:
    save_file({"motion.timestamps": torch.zeros(3)}, path, {"wearcap": description} if description else None)
    return path


@pytest.mark.parametrize(
    "recording",
    [
        None,
        3,
        [],
        "x",
        {},
        {"$type": "Recording"},
        {"$type": "Popen", "args": "ls"},
        {"$type": "Motion"},
        {"$type": "Recording", "name": "a", "surprise": 1},
        {"$type": "Recording", "name": "a", "motion": {"$tensor": "not there"}},
        {"$type": "Recording", "name": "a", "motion": {"$tensor": 5}},
        {"$type": "Recording", "name": "a", "skeleton": {"$tuple": 3}},
        {"$type": ["Recording"], "name": "a"},
        {
            "$type": "Skeleton",
            "name": "a",
            "joint_names": {"$tuple": ["a", "a"]},
            "parents": {"$tuple": [-1, 0]},
            "t_parent_joint": {"$tensor": "motion.timestamps"},
        },
    ],
)
def test_a_hostile_description_is_refused(tmp_path, recording):
    path = foreign(tmp_path / "x.safetensors", json.dumps({"schema_version": 1, "recording": recording}))
    with pytest.raises(WearcapError):
        RecordingFile(path).load()


@pytest.mark.parametrize(
    "description", [None, "", "{", "[]", "3", '{"recording": {}}', '{"schema_version": 2, "recording": {}}']
)
def test_a_foreign_file_is_refused_when_opened(tmp_path, description):
    with pytest.raises(WearcapError, match=r"x\.safetensors"):
        RecordingFile(foreign(tmp_path / "x.safetensors", description))


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"abc",
        struct.pack("<Q", 2**62) + b"{}",
        struct.pack("<Q", 2) + b"[]",
        struct.pack("<Q", 8) + b'{"a":[1}',
        b"PK\x03\x04" + bytes(64),
        b"\x80\x04cos\nsystem\n.",
    ],
)
def test_a_file_of_another_kind_is_refused(tmp_path, content):
    (tmp_path / "x.safetensors").write_bytes(content)
    with pytest.raises(WearcapError, match="not a readable recording"):
        RecordingFile(tmp_path / "x.safetensors")
    with pytest.raises(WearcapError):
        RecordingFile(tmp_path)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(where=st.floats(0, 1), what=st.binary(min_size=1, max_size=12))
def test_bytes_changed_anywhere_load_or_end_in_one_error(tmp_path, where, what):
    path = tmp_path / "fuzz.safetensors"
    save_recording(Recording("bare", points=PointCloud(torch.zeros(2, 3)), skeleton=xsens23()), path)
    content = bytearray(path.read_bytes())
    start = int(where * (len(content) - len(what)))
    content[start : start + len(what)] = what
    path.write_bytes(content)
    with contextlib.suppress(WearcapError):
        RecordingFile(path).load()


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.dictionaries(st.text(min_size=1).filter(lambda key: key[0] != "$"), inner, min_size=1),
)


@given(value=st.dictionaries(st.text(min_size=1).filter(lambda key: key[0] != "$"), json_values, max_size=4))
def test_plain_values_survive(value):
    tree, tensors = flatten(value)
    assert not tensors
    kept = unflatten(json.loads(dumps(tree)), tensors.get)
    assert kept == _without_empty(value)


def _without_empty(value):
    """What `flatten` leaves out: parts that are None or empty."""
    if not isinstance(value, dict):
        return value
    items = {key: _without_empty(item) for key, item in value.items()}
    empty = [key for key, item in value.items() if item is None or (isinstance(item, dict | str) and not item)]
    return {key: item for key, item in items.items() if key not in empty}


def test_what_json_cannot_say_is_refused():
    with pytest.raises(ValueError, match="not JSON compliant"):
        dumps({"height": float("nan")})


def test_poses_in_sixteen_bits_are_refused(tmp_path):
    """They do not compute with those in 32 bits."""
    recording = recording_of(swaying_motion(20, 0), "r0")
    assert recording.motion is not None
    halved = replace(recording.motion, t_world_root=recording.motion.t_world_root.bfloat16())
    save_recording(replace(recording, motion=halved), tmp_path / "r0.safetensors")
    with pytest.raises(WearcapError, match="t_world_root is a torch.bfloat16"):
        RecordingFile(tmp_path / "r0.safetensors").load()
