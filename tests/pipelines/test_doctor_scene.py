"""The doctor on scenes and on camera-localised recordings: the sound ones pass, each planted defect is named."""

import json
from dataclasses import replace

import av
import numpy as np
import pytest
import torch
from PIL import Image
from small_scene import LEVEL, inverted, room_cloud, write_room

from walking_person import sound_recording
from wearcap.apps.doctor import examine
from wearcap.checks import Finding, examine_recording, require_sound
from wearcap.checks.body import check_contact_prob
from wearcap.checks.consistency import check_localization, check_offset
from wearcap.errors import WearcapError
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import about_axis
from wearcap.io.formats.camera_json import write_photos
from wearcap.io.formats.ply import Ply, write_ply
from wearcap.localization.visual_map import Observations, VisualMap, _Landmarks
from wearcap.recording import CameraStream, Localization, Recording, RecordingStore

CAMERA = Camera("opencv", 64, 48, 40.0, 40.0, 31.5, 23.5, (0.0, 0.0, 0.0, 0.0))


def found(report, severity: str) -> list[Finding]:
    return [finding for _, finding in report.of_severity(severity)]


# Scenes ------------------------------------------------------------------------------------------------------------


def test_a_sound_scene(tmp_path):
    write_room(tmp_path)
    report = examine(tmp_path)
    assert not found(report, "error")
    assert not found(report, "warning")
    assert {"scan", "scan: density", "photos", "photos: size", "photos: poses"} <= {
        f.check for f in found(report, "ok")
    }


def rewritten(path, change) -> None:
    path.write_text(json.dumps(change(json.loads(path.read_text()))))


def without_intrinsics(content):
    del content["photos"][1]["camera"]["fx"]
    return content


def smaller(folder):
    Image.new("RGB", (40, 30)).save(folder / "photos/00002-cam0.jpg")


def sparse(folder):
    points = room_cloud(0.12)
    write_ply(
        Ply(points, np.random.default_rng(0).integers(0, 255, points.shape, dtype=np.uint8)), folder / "pointcloud.ply"
    )


def grey(folder):
    points = room_cloud()
    write_ply(Ply(points, np.full(points.shape, 128, np.uint8)), folder / "pointcloud.ply")


def y_up(folder):
    points = room_cloud()[:, [1, 2, 0]] * np.array([1, 1, 3], np.float32)
    write_ply(
        Ply(points, np.random.default_rng(0).integers(0, 255, points.shape, dtype=np.uint8)), folder / "pointcloud.ply"
    )


SCENE_DEFECTS = {
    "millimetres": (lambda folder: write_room(folder, unit=1000), "error", "millimetres"),
    "no colour": (lambda folder: write_room(folder, colors=False), "error", "no colour"),
    "one colour": (grey, "error", "one colour"),
    "no points": (
        lambda folder: write_ply(Ply(np.zeros((0, 3), np.float32)), folder / "pointcloud.ply"),
        "error",
        "no points",
    ),
    "no scan": (lambda folder: (folder / "pointcloud.ply").unlink(), "error", "the scan is missing"),
    "sparse": (sparse, "warning", "sparse"),
    "y up": (y_up, "warning", "taller than wide"),
    "no photos": (lambda folder: write_room(folder, photos=0), "error", "no photos"),
    "no list": (lambda folder: (folder / "photos.json").unlink(), "error", "no photos"),
    "no intrinsics": (lambda folder: rewritten(folder / "photos.json", without_intrinsics), "error", "lacks 'fx'"),
    "a photo is missing": (lambda folder: (folder / "photos/00001-cam0.jpg").unlink(), "error", "files are missing"),
    "a photo is damaged": (
        lambda folder: (folder / "photos/00001-cam0.jpg").write_bytes(b"\xff\xd8 cut"),
        "error",
        "cannot be read",
    ),
    "a photo is smaller": (smaller, "error", "image size and calibration differ"),
    "poses inverted": (
        lambda folder: write_photos(inverted(write_room(folder)), folder),
        "error",
        "do not see the scan",
    ),
}


@pytest.mark.parametrize("defect", SCENE_DEFECTS)
def test_a_defect_of_a_scene_is_named_once(defect, tmp_path):
    plant, severity, message = SCENE_DEFECTS[defect]
    write_room(tmp_path)
    plant(tmp_path)
    findings = [f for f in found(examine(tmp_path), severity) if message in f.what]
    assert len(findings) == 1
    assert findings[0].fix
    assert len(found(examine(tmp_path), "error")) == (severity == "error")


def test_a_scan_of_the_hps_data_set(tmp_path, monkeypatch):
    from pathlib import Path

    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "io")
    import hps_files

    hps_files.write_scan(tmp_path)
    for path in (tmp_path / "cam").glob("*.jpg"):
        Image.new("RGB", (918, 690)).save(path)
    report = examine(tmp_path)
    assert any("1 calibrations" in f.evidence for f in found(report, "ok"))
    assert {f.what for f in found(report, "error")} == {"all points have one colour", "photos do not see the scan"}


def test_sequences_of_the_hps_data_set(tmp_path, monkeypatch):
    from pathlib import Path

    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "io")
    import hps_files

    hps_files.write_hps(tmp_path, scan=False)
    report = examine(tmp_path)
    assert list(report.findings) == [hps_files.NAME]
    (tmp_path / "head_camera_videos/cameras.json").write_text("{}")
    assert [f.what for f in found(examine(tmp_path), "error")] == [f"no intrinsics for the video of {hps_files.NAME!r}"]


# Recordings --------------------------------------------------------------------------------------------------------


def localized(shift_s: float = 0.0) -> Recording:
    """A walk with its suit, and a camera on the head that was found in 9 frames of 10, with noise of 1 cm and 0.2°."""
    base = sound_recording()
    head, frames = base.motion.joint("head"), len(base.motion)
    random = torch.Generator().manual_seed(0)
    confidence = (torch.rand(frames, generator=random) > 0.1).float()
    R = head.R @ LEVEL @ about_axis("x", 0.003 * torch.randn(frames, generator=random))
    t = head.t + 0.01 * torch.randn(frames, 3, generator=random)
    return replace(
        base,
        suit=replace(base.motion, contact_prob=base.contacts.contact.float()),
        localization=Localization(base.motion.timestamps + shift_s, R, t, confidence),
        camera=CameraStream(base.motion.timestamps, CAMERA, LEVEL, torch.zeros(3)),
    )


@pytest.fixture(scope="module")
def sound() -> Recording:
    return localized()


def test_a_sound_localised_recording(sound):
    report = examine(sound)
    assert not [(f.check, f.what, f.evidence) for f in [*found(report, "error"), *found(report, "warning")]]
    assert {"localization", "localization: speed", "localization: clock offset", "suit: contacts"} <= {
        f.check for f in found(report, "ok")
    }
    assert [f.what[:13] for f in found(report, "note") if f.check == "claps"] == ["no clap found"]


def spot(recording: Recording, **changes) -> Recording:
    return replace(recording, localization=replace(recording.localization, **changes))


def jumping(recording: Recording) -> Recording:
    t = recording.localization.t_world_cam.clone()
    t[::4, 0] += 9.0
    return spot(recording, t_world_cam=t)


def suit(recording: Recording, contact) -> Recording:
    return replace(recording, suit=replace(recording.suit, contact_prob=contact))


DEFECTS = {
    "never found": (
        lambda r: spot(r, confidence=torch.zeros_like(r.localization.confidence)),
        "error",
        "hardly any frame",
    ),
    "seldom found": (
        lambda r: spot(r, confidence=r.localization.confidence * (torch.arange(len(r.suit)) % 4 == 0)),
        "warning",
        "few frames",
    ),
    "jumps": (jumping, "warning", "positions jump"),
    "no rotations": (lambda r: spot(r, R_world_cam=1.3 * r.localization.R_world_cam), "error", "no rotations"),
    "upside down": (
        lambda r: spot(r, R_world_cam=r.localization.R_world_cam @ about_axis("z", torch.tensor(3.14159))),
        "warning",
        "upside down",
    ),
    "late": (lambda r: localized(0.2), "error", "the camera is late"),
    "NaN": (lambda r: spot(r, t_world_cam=r.localization.t_world_cam * torch.nan), "error", "positions are NaN"),
    "no contact": (lambda r: suit(r, torch.zeros(len(r.suit), 4)), "warning", "feet never touch"),
    "no probability": (lambda r: suit(r, torch.full((len(r.suit), 4), 7.0)), "error", "no probabilities"),
}


@pytest.mark.parametrize("defect", DEFECTS)
def test_a_defect_of_a_recording_is_named(defect, sound):
    plant, severity, message = DEFECTS[defect]
    assert [f for f in found(examine(plant(sound)), severity) if message in f.what]


def clapped(recording: Recording) -> Recording:
    """With three claps at uneven intervals: shocks that stop the left palm within hundredths of a second."""
    wrist = recording.imu["left_wrist"]
    times = wrist.timestamps[:, None] - torch.tensor([1.3, 2.4, 3.9], dtype=torch.float64)
    shock = 60 * torch.exp(-0.5 * (times / 0.011) ** 2).sum(1, keepdim=True).float() * torch.tensor([0.0, 1.0, 0.0])
    return replace(recording, imu={"left_wrist": replace(wrist, acc_imu=None, acc_world=wrist.acc_world + shock)})


@pytest.mark.parametrize("shift_s", [0.2, -0.94, 2.5])
def test_a_camera_on_its_own_clock_is_an_error_only_without_claps(shift_s):
    """The offset is measured, beyond a second too; where claps join the clocks it stops nobody."""
    recording, what = localized(shift_s), f"the camera is {'late' if shift_s > 0 else 'early'}"
    for made, severity in ((recording, "error"), (clapped(recording), "note")):
        (clock,) = [f for f in examine_recording(made) if f.check == "localization: clock offset"]
        assert (clock.severity, clock.what) == (severity, what), clock
        measured_ms = float(clock.evidence.split(" at ")[1].split(" ms")[0])
        assert measured_ms == pytest.approx(1000 * shift_s, abs=10)
    require_sound(clapped(recording))
    with pytest.raises(WearcapError, match=what):
        require_sound(recording)


def test_claps_do_not_excuse_the_camera_of_another_walk(sound):
    """Turns that match the suit's at no offset stay a warning."""
    turns = about_axis("z", torch.sin(0.2 * sound.suit.timestamps**2).float())
    other = clapped(spot(sound, R_world_cam=turns @ LEVEL))
    clock = [(f.severity, f.what) for f in examine_recording(other) if f.check == "localization: clock offset"]
    assert clock == [("warning", "does not match this motion")]


@pytest.mark.parametrize(
    ("best", "clapped", "severity"), [(0.95, False, "error"), (0.7, False, "warning"), (0.7, True, "note")]
)
def test_an_offset_that_noise_may_feign_is_no_error(best, clapped, severity):
    (clock,) = check_offset("clock", (0.4, best, 0.1), "the camera", clapped)
    assert (clock.severity, clock.what) == (severity, "the camera is late")
    assert clock.fix.endswith("Add -0.400 s to its timestamps.")


def test_clocks_are_not_compared_where_nobody_turns(sound):
    """A wearer who sways by half a degree: the camera's noise is larger."""
    times, generator = sound.suit.timestamps, torch.Generator().manual_seed(1)
    R = sound.suit.R_parent_joint[:1].repeat(len(times), 1, 1, 1)
    R[:, 0] = about_axis("z", 0.01 * torch.sin(times).float()) @ R[:, 0]
    still = replace(sound.suit, R_parent_joint=R, t_world_root=sound.suit.t_world_root[:1].repeat(len(times), 1))
    head = still.joint("head")
    noise = about_axis("z", 0.01 * torch.randn(len(times), generator=generator))
    seen = replace(sound.localization, timestamps=times + 0.9, R_world_cam=noise @ head.R @ LEVEL, t_world_cam=head.t)
    (clock,) = [f for f in check_localization(seen, still, []) if f.check == "localization: clock offset"]
    assert (clock.severity, clock.what) == ("note", "not enough motion to compare clocks")


def cut_contacts(recording: Recording, rows: int) -> Recording:
    """What a reader without checks would make: the type itself does not allow it."""
    short = replace(recording.suit)
    object.__setattr__(short, "contact_prob", recording.suit.contact_prob[:rows])
    return replace(recording, suit=short)


def test_contacts_shorter_than_poses(sound, tmp_path):
    short = cut_contacts(sound, 50)
    assert [f.what for f in check_contact_prob("suit", short.suit)] == ["contacts are shorter than poses"]
    RecordingStore(tmp_path).add(short, split="test", config_hash="x")
    errors = found(examine(tmp_path), "error")
    assert len(errors) == 1
    assert f"Motion.contact_prob has 50 rows for {len(sound.suit)} timestamps" in errors[0].what


def filmed(recording: Recording, root, size: tuple[int, int], frames: int) -> Recording:
    with av.open(str(root / "head.mp4"), "w") as container:
        stream = container.add_stream("mpeg4", rate=60)
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        for _ in range(frames):
            container.mux(stream.encode(av.VideoFrame(*size, "yuv420p")))
        container.mux(stream.encode())
    return replace(recording, camera=replace(recording.camera, video="head.mp4"))


@pytest.mark.parametrize(
    ("size", "cut", "message"),
    [((64, 48), 0, ""), ((80, 48), 0, "image size and calibration differ"), ((64, 48), 100, "differ in number")],
)
def test_the_video_is_looked_at(size, cut, message, sound, tmp_path):
    recording = filmed(sound, tmp_path, size, len(sound.camera.timestamps) - cut)
    RecordingStore(tmp_path).add(recording, split="test", config_hash="x")
    errors = found(examine(tmp_path), "error")
    assert [message in f.what for f in errors] == ([True] if message else [])


def test_missing_files_are_named(sound, tmp_path):
    gone = replace(sound, scene="scenes/none.ply", camera=replace(sound.camera, video="none.mp4"))
    RecordingStore(tmp_path).add(gone, split="test", config_hash="x")
    assert {f.what for f in found(examine(tmp_path), "error")} == {"the scan is missing", "no such video"}


# Maps --------------------------------------------------------------------------------------------------------------


def small_map(pictures: int, each: int) -> VisualMap:
    random = np.random.default_rng(0)
    count = pictures * each
    positions = random.uniform(-3, 3, (count, 3)).astype(np.float32)
    descriptors = random.integers(-9, 9, (count, 128), dtype=np.int8)
    landmarks = _Landmarks(positions, descriptors)
    return VisualMap(
        "sift",
        "vlad",
        tuple(f"{k}.jpg" for k in range(pictures)),
        (CAMERA,) * pictures,
        Rigid.identity(pictures, dtype=torch.float64),
        np.zeros((pictures, 8), np.float32),
        Observations(
            np.zeros((count, 2), np.float32),
            descriptors,
            positions,
            np.arange(pictures + 1, dtype=np.int64) * each,
            np.arange(count, dtype=np.int32),
        ),
        landmarks,
        np.zeros((2, 128), np.float32),
        0.02,
    )


@pytest.mark.parametrize(
    ("pictures", "each", "severity", "message"),
    [
        (3, 100, "ok", "holds landmarks"),
        (3, 10, "warning", "hardly a keypoint"),
        (0, 0, "error", "the map is empty"),
        (3, 0, "error", "the map is empty"),
    ],
)
def test_maps(pictures, each, severity, message, tmp_path):
    small_map(pictures, each).save(tmp_path / "map.safetensors")
    assert [message in f.what for f in found(examine(tmp_path / "map.safetensors"), severity) if f.check == "map"] == [
        True
    ]


def test_a_damaged_map_is_one_error(tmp_path):
    small_map(3, 100).save(tmp_path / "map.safetensors")
    content = (tmp_path / "map.safetensors").read_bytes()
    (tmp_path / "map.safetensors").write_bytes(content[: len(content) // 2])
    assert len(found(examine(tmp_path / "map.safetensors"), "error")) == 1
