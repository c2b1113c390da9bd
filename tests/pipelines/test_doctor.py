"""A sound recording is found sound; every planted defect is found, named, and comes with a way to mend it."""

import dataclasses
import json
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from walking_person import MOUNT, sound_recording
from wearcap.apps.doctor import examine
from wearcap.body.skeleton import xsens23
from wearcap.checks import Finding, Report
from wearcap.cli.doctor import main
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.camera import Camera
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.formats.poses import write_tum
from wearcap.recording import CameraStream, PointCloud, Recording, RecordingStore
from wearcap.recording.store import save_recording
from wearcap.sensors.imu import ImuNoise, synthesize_imu

Y_UP = torch.tensor([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
"""Turns a z-up world into a y-up one."""


@pytest.fixture(scope="module")
def sound():
    return sound_recording()


def head(recording, **changes):
    return replace(recording, head=replace(recording.head, **changes))


def motion(recording, **changes):
    return replace(recording, motion=replace(recording.motion, **changes))


def wrist(recording, **changes):
    return replace(recording, imu=recording.imu | {"left_wrist": replace(recording.imu["left_wrist"], **changes)})


def every(part, keep):
    """A stream with only some of its frames."""
    tensors = {f.name: getattr(part, f.name) for f in dataclasses.fields(part)}
    frames = len(part.timestamps)
    return replace(
        part, **{k: v[keep] for k, v in tensors.items() if isinstance(v, torch.Tensor) and v.ndim and len(v) == frames}
    )


def requaternion(R, shift):
    """The rotations that come of reading quaternions in another order."""
    return rotation.matrix_from_quat_wxyz(rotation.quat_wxyz_from_matrix(R).roll(shift, -1))


def mirrored(recording):
    """Left joints' rotations under right joints' names and the other way round."""
    skeleton = recording.motion.skeleton
    swap = [
        skeleton.index(n.replace("left", "#").replace("right", "left").replace("#", "right"))
        for n in skeleton.joint_names
    ]
    offsets = skeleton.t_parent_joint[swap]
    return motion(
        recording, R_parent_joint=recording.motion.R_parent_joint[:, swap], skeleton=skeleton.with_offsets(offsets)
    )


def knees_reversed(recording):
    skeleton, R = recording.motion.skeleton, recording.motion.R_parent_joint.clone()
    for side in ("left", "right"):
        R[:, skeleton.index(f"{side}_knee")] = rotation.about_axis("y", torch.full((len(R),), -0.9))
    return motion(recording, R_parent_joint=R)


def frozen_gap():
    keep = torch.ones(1440, dtype=torch.bool)
    for start in range(100, 1400, 130):
        keep[start : start + 7] = False
    return keep


def nan_at(tensor, *index):
    spoiled = tensor.clone()
    spoiled[index] = float("nan")
    return spoiled


def jumped(tensor):
    moved = tensor.clone()
    moved[700:710, 0] += 2.5
    return moved


DEFECTS = {
    "head: world y up": (
        lambda r: head(r, R_world_device=Y_UP @ r.head.R_world_device, t_world_device=r.head.t_world_device @ Y_UP.T),
        "error",
        "head: up axis",
        r"world's \+y axis is up",
    ),
    "head: device axes not the head's": (
        lambda r: head(r, R_world_device=r.head.R_world_device @ rotation.about_axis("x", torch.tensor(-1.5708))),
        "error",
        "head: up axis",
        r"body's [+-]y axis points up",
    ),
    "head: forward is sideways": (
        lambda r: head(r, R_world_device=r.head.R_world_device @ rotation.about_axis("z", torch.tensor(1.5708))),
        "error",
        "head: forward axis",
        "does not point forward",
    ),
    "head: poses inverted": (
        lambda r: head(r, R_world_device=r.head.R_world_device.mT),
        "error",
        "head",
        "rotations are inverted|hardly agree|not point forward",
    ),
    "head: xyzw read as wxyz": (
        lambda r: head(r, R_world_device=requaternion(r.head.R_world_device, -1)),
        "error",
        "head: up axis",
        "wrong order",
    ),
    "head: wxyz read as xyzw": (
        lambda r: head(r, R_world_device=requaternion(r.head.R_world_device, 1)),
        "error",
        "head: up axis",
        "wrong order",
    ),
    "head: millimetres": (
        lambda r: head(r, t_world_device=1000 * r.head.t_world_device),
        "error",
        "head: positions",
        "not in metres",
    ),
    "head: centimetres": (
        lambda r: head(r, t_world_device=100 * r.head.t_world_device),
        "error",
        "head: positions",
        "not in metres",
    ),
    "head: no rotations": (
        lambda r: head(r, R_world_device=1.3 * r.head.R_world_device),
        "error",
        "head: rotations",
        "no rotations",
    ),
    "head: mirrored": (
        lambda r: head(r, R_world_device=r.head.R_world_device * torch.tensor([1.0, -1, 1])),
        "error",
        "head: rotations",
        "mirrored",
    ),
    "head: NaN": (
        lambda r: head(r, t_world_device=nan_at(r.head.t_world_device, 3)),
        "error",
        "head: positions",
        "NaN",
    ),
    "head: jump": (
        lambda r: head(r, t_world_device=jumped(r.head.t_world_device)),
        "warning",
        "head: positions",
        "jumps",
    ),
    "head: dropped frames": (
        lambda r: replace(r, head=every(r.head, frozen_gap())),
        "warning",
        "head: clock",
        "dropped frames",
    ),
    "head: repeated timestamps": (
        lambda r: head(r, timestamps=r.head.timestamps.clone().index_fill(0, torch.tensor(5), 0.05)),
        "error",
        "head: clock",
        "do not rise",
    ),
    "head: microseconds": (lambda r: head(r, timestamps=1e6 * r.head.timestamps), "error", "head: clock", "a rate of"),
    "head: jittery clock": (
        lambda r: head(r, timestamps=r.head.timestamps + 0.004 * torch.sin(1e3 * r.head.timestamps)),
        "warning",
        "head: clock",
        "uneven",
    ),
    "head: late by 100 ms": (
        lambda r: head(r, timestamps=r.head.timestamps + 0.1),
        "error",
        "head against body: clock",
        "the head stream is late",
    ),
    "head: another seat": (
        lambda r: head(r, t_head_device=torch.tensor([0.3, 0.0, 0.1])),
        "warning",
        "head against body: seat",
        "stated seat",
    ),
    "head: another world": (
        lambda r: head(
            r,
            t_world_device=r.head.t_world_device @ rotation.about_axis("z", torch.tensor(0.6)).T,
            R_world_device=rotation.about_axis("z", torch.tensor(0.6)) @ r.head.R_world_device,
        ),
        "error",
        "head against body: seat",
        "does not ride",
    ),
    "streams apart": (
        lambda r: head(r, timestamps=r.head.timestamps + 500),
        "error",
        "streams' time spans",
        "do not overlap",
    ),
    "body: world y up": (
        lambda r: motion(
            r,
            R_parent_joint=torch.cat([Y_UP @ r.motion.R_parent_joint[:, :1], r.motion.R_parent_joint[:, 1:]], 1),
            t_world_root=r.motion.t_world_root @ Y_UP.T,
        ),
        "error",
        "motion: up axis",
        r"stands along \+y",
    ),
    "body: 170 m tall": (
        lambda r: motion(r, skeleton=xsens23().scaled(100.0), t_world_root=100 * r.motion.t_world_root),
        "error",
        "motion: body size",
        "no person's size",
    ),
    "body: 1.7 mm tall": (
        lambda r: motion(r, skeleton=xsens23().scaled(0.001)),
        "error",
        "motion: body size",
        "no person's size",
    ),
    "body: xyzw read as wxyz": (
        lambda r: motion(r, R_parent_joint=requaternion(r.motion.R_parent_joint, -1)),
        "error",
        "motion: joint rotations",
        "beyond what a body can",
    ),
    "body: sides exchanged": (mirrored, "error", "motion: sides", "exchanged"),
    "body: knees bend forwards": (knees_reversed, "warning", "motion: knees", "bend forwards"),
    "body: floats": (
        lambda r: motion(r, t_world_root=r.motion.t_world_root + torch.tensor([0, 0, 0.25])),
        "warning",
        "motion: feet on the floor",
        "float above",
    ),
    "body: sinks": (
        lambda r: motion(r, t_world_root=r.motion.t_world_root - torch.tensor([0, 0, 0.2])),
        "warning",
        "motion: feet on the floor",
        "sink into",
    ),
    "body: path of twice the length": (
        lambda r: motion(r, t_world_root=r.motion.t_world_root * torch.tensor([2.0, 2.0, 1.0])),
        "warning",
        "motion: foot sliding",
        "slide",
    ),
    "imu: shifted by 200 ms": (
        lambda r: wrist(r, timestamps=r.imu["left_wrist"].timestamps + 0.2),
        "error",
        "imu left_wrist: clock offset",
        "late",
    ),
    "imu: early by 60 ms": (
        lambda r: wrist(r, timestamps=r.imu["left_wrist"].timestamps - 0.06),
        "error",
        "imu left_wrist: clock offset",
        "early",
    ),
    "imu: in g": (
        lambda r: wrist(r, acc_imu=r.imu["left_wrist"].acc_imu / 9.81),
        "error",
        "imu left_wrist: accelerometer",
        "is in g",
    ),
    "imu: reversed sign": (
        lambda r: wrist(r, acc_imu=-r.imu["left_wrist"].acc_imu),
        "error",
        "imu left_wrist: accelerometer",
        "sign is reversed",
    ),
    "imu: gravity left in": (
        lambda r: wrist(r, acc_world=r.imu["left_wrist"].acc_world + torch.tensor([0, 0, 9.81])),
        "error",
        "imu left_wrist: free acceleration",
        "gravity is still in it",
    ),
    "imu: free acceleration in g": (
        lambda r: wrist(r, acc_world=r.imu["left_wrist"].acc_world / 9.81),
        "error",
        "imu left_wrist: acceleration",
        "is in g",
    ),
    "imu: free acceleration negated": (
        lambda r: wrist(r, acc_world=-r.imu["left_wrist"].acc_world),
        "error",
        "imu left_wrist: acceleration",
        "opposite sign",
    ),
    "imu: gyroscope in degrees": (
        lambda r: wrist(r, gyro_imu=57.29578 * r.imu["left_wrist"].gyro_imu),
        "error",
        "imu left_wrist: gyroscope",
        "degrees",
    ),
    "imu: named for the wrong arm": (
        lambda r: wrist(r, joint="right_wrist"),
        "error",
        "imu left_wrist: mounting",
        "does not ride",
    ),
    "imu: gyroscope in world axes": (
        lambda r: wrist(
            r, gyro_imu=(r.imu["left_wrist"].R_world_imu @ r.imu["left_wrist"].gyro_imu[..., None])[..., 0]
        ),
        "warning",
        "imu left_wrist: gyroscope",
        "does not agree",
    ),
    "imu: world y up": (
        lambda r: wrist(r, R_world_imu=Y_UP @ r.imu["left_wrist"].R_world_imu),
        "error",
        "imu left_wrist",
        "along z|ride",
    ),
    "imu: stale mounting": (
        lambda r: wrist(r, R_joint_imu=MOUNT @ rotation.about_axis("x", torch.tensor(0.6))),
        "warning",
        "imu left_wrist: mounting",
        "stated mounting",
    ),
    "imu: NaN": (
        lambda r: wrist(r, gyro_imu=nan_at(r.imu["left_wrist"].gyro_imu, 9)),
        "error",
        "imu left_wrist: gyro_imu",
        "NaN",
    ),
    "points: millimetres": (
        lambda r: replace(r, points=PointCloud(1000 * r.points.points_world)),
        "error",
        "points",
        "not a surrounding in metres",
    ),
    "points: elsewhere": (
        lambda r: replace(r, points=PointCloud(r.points.points_world + torch.tensor([500.0, 0, 0]))),
        "error",
        "points: floor",
        "no points below",
    ),
    "points: y up": (
        lambda r: replace(r, points=PointCloud(r.points.points_world @ Y_UP.T)),
        "note",
        "points: floor",
        "no clear floor",
    ),
}


def spoiled(values, random):
    """In a unit of anyone's guess, with noise."""
    return values * 10 ** (8 * torch.rand(1, generator=random).item() - 4) + torch.randn(values.shape, generator=random)


def camera_stream(R_head_cam):
    camera = Camera("pinhole", 640, 480, 400.0, 400.0, 320.0, 240.0)
    return CameraStream(
        torch.arange(20, dtype=torch.float64) / 10,
        camera,
        R_head_cam,
        torch.zeros(3),
        tuple(f"{i}.jpg" for i in range(20)),
    )


def test_sound_recording_is_found_sound(sound):
    report = examine(sound)
    assert report.sound
    assert report.of_severity("error", "warning", "note") == []
    assert len(report.of_severity("ok")) > 20


@pytest.mark.parametrize("name", DEFECTS)
def test_planted_defect_is_found(sound, name):
    """Found with its severity, in the right place, in words that name it, and with a way to mend it."""
    plant, severity, check, words = DEFECTS[name]
    report = examine(plant(sound))
    found = [f for _, f in report.of_severity("error", "warning", "note")]
    hits = [f for f in found if f.check.startswith(check) and re.search(words, f.what)]
    assert hits, [(f.severity, f.check, f.what, f.evidence) for f in found]
    assert severity in {f.severity for f in hits}
    assert all(f.fix for f in hits)
    assert report.sound == (severity != "error" and not report.of_severity("error"))


def test_a_real_sensors_errors_are_no_defect(sound):
    """Attitude error, bias, noise and a loose strap of a watch-like sensor: nothing to mend."""
    for seed in range(4):
        rng = np.random.default_rng(seed)
        imu = {
            joint: synthesize_imu(sound.motion, joint, R_joint_imu=MOUNT, noise=ImuNoise(), rng=rng)
            for joint in ("left_wrist", "head", "pelvis")
        }
        report = examine(replace(sound, imu=imu))
        assert not [(f.check, f.what, f.evidence) for _, f in report.of_severity("error", "warning")]


def test_measured_lag_is_the_planted_one(sound):
    finding = next(
        f
        for _, f in examine(DEFECTS["imu: shifted by 200 ms"][0](sound)).of_severity("error")
        if "clock offset" in f.check
    )
    assert finding.fix == "Add -0.200 s to its timestamps."


def test_camera_axes(sound):
    ahead = torch.tensor([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    assert not examine(replace(sound, camera=camera_stream(ahead))).of_severity("warning", "error")
    wrong = examine(replace(sound, camera=camera_stream(torch.eye(3)))).of_severity("warning")
    assert wrong[0][1].what == "the camera does not look ahead"


def test_empty_and_tiny_recordings():
    assert examine(Recording("empty")).of_severity("error")[0][1].what == "is empty"
    one = sound_recording(seconds=0.1)
    assert examine(replace(one, head=every(one.head, slice(0, 1)), imu={})).of_severity("warning")
    assert examine(replace(one, imu={}, points=None)).findings


def test_data_set_folder_with_one_bad_recording(sound, tmp_path):
    store = RecordingStore(tmp_path)
    store.add(replace(sound, name="good"), split="train", config_hash="x")
    store.add(replace(DEFECTS["head: millimetres"][0](sound), name="large"), split="train", config_hash="x")
    store.add(replace(sound, name="cut"), split="train", config_hash="x")
    path = store.path_of("cut")
    path.write_bytes(path.read_bytes()[:1000])
    done = []
    report = examine(tmp_path, lambda n, of: done.append((n, of)))
    errors = report.of_severity("error")
    assert {name for name, _ in errors} == {"large", "cut"}
    assert next(f for name, f in errors if name == "cut").check == "reading"
    assert done == [(1, 3), (2, 3), (3, 3)]
    (group, names) = next(g for g in report.grouped() if g[0].check == "head: up axis")
    assert (group.severity, names) == ("ok", ["good", "large"])


def test_single_files(sound, tmp_path):
    save_recording(sound, tmp_path / "walk.safetensors")
    assert examine(tmp_path / "walk.safetensors").sound
    write_tum(
        Trajectory(sound.head.timestamps, sound.head.R_world_device, sound.head.t_world_device), tmp_path / "head.txt"
    )
    assert examine(tmp_path / "head.txt").sound
    (tmp_path / "broken.bvh").write_text("HIERARCHY\nROOT")
    assert examine(tmp_path / "broken.bvh").of_severity("error")[0][1].check == "reading"


def test_nothing_to_examine(tmp_path):
    with pytest.raises(WearcapError, match="nothing to examine"):
        examine(tmp_path)
    with pytest.raises(WearcapError, match="no such file"):
        examine(tmp_path / "absent")
    (tmp_path / "notes.docx").write_text("hello")
    with pytest.raises(WearcapError, match="not a kind of file that holds a recording"):
        examine(tmp_path / "notes.docx")


def test_random_numbers_never_crash():
    """Whatever a recording holds, the doctor answers."""
    base = sound_recording(seconds=5.0)
    for seed in range(8):
        random = torch.Generator().manual_seed(seed)
        wild = head(
            motion(base, t_world_root=spoiled(base.motion.t_world_root, random)),
            t_world_device=spoiled(base.head.t_world_device, random),
            R_world_device=rotation.exp(3 * torch.randn(len(base.head.timestamps), 3, generator=random)),
        )
        wild = wrist(
            wild,
            acc_imu=spoiled(base.imu["left_wrist"].acc_imu, random),
            gyro_imu=spoiled(base.imu["left_wrist"].gyro_imu, random),
        )
        assert examine(wild).findings


def test_command_prints_and_exits(sound, tmp_path, capsys):
    save_recording(sound, tmp_path / "good.safetensors")
    main([str(tmp_path / "good.safetensors")])
    assert "sound" in capsys.readouterr().out
    save_recording(DEFECTS["body: 170 m tall"][0](sound), tmp_path / "bad.safetensors")
    with pytest.raises(SystemExit) as exit_code:
        main([str(tmp_path / "bad.safetensors"), "--json"])
    assert exit_code.value.code == 1
    content = json.loads(capsys.readouterr().out)
    assert content["sound"] is False
    assert any("no person's size" in f["what"] for f in content["findings"]["bad.safetensors"])


def test_findings_refuse_unknown_severities():
    with pytest.raises(ValueError, match="none of"):
        Finding("bad", "check", "what")
    assert Report("x", {}).sound


@pytest.mark.real
def test_real_aria_recording_is_sound(real_data):
    report = examine(real_data / "aria_mps")
    assert report.of_severity("error", "warning") == []
    assert {f.check for _, f in report.of_severity("ok")} >= {
        "head: up axis",
        "points: floor",
        "MPS summary",
        "closed-loop file: gravity",
    }


@pytest.mark.real
def test_real_walks_are_sound(real_data):
    report = examine(real_data / "cmu_mocap" / "trials" / "007")
    assert len(report.findings) > 5
    assert report.sound
