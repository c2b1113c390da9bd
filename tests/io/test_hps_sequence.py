"""The HPS data set, whole: scans and sequences that were written in its layout come back; damage is named."""

import json
import shutil
import warnings
from pathlib import Path

import av
import hps_files
import pytest
import torch
from hps_files import CAM_START, IMU_START, NAME, SCAN, same_motion, write_hps, write_scan
from test_mvnx import mvnx, sample

from data_prep.hps import _scan_name, hps_names, read_hps_sequence, subject_of
from wearcap.body.skeletons import smpl24
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.io.formats.navvis import is_navvis_scan, read_navvis_scan

# Scans -------------------------------------------------------------------------------------------------------------


def test_scan(tmp_path):
    write_scan(tmp_path)
    assert is_navvis_scan(tmp_path)
    cloud, photos = read_navvis_scan(tmp_path)
    assert cloud == tmp_path / "pointcloud.ply"
    assert [photo.file.name for photo in photos] == [f"0000{f}-cam{k}.jpg" for f in (0, 1) for k in (0, 1)]
    assert photos[0].camera.model == "ocam"
    assert photos[2].T_world_cam.t.tolist() == pytest.approx([1.5, 2.0, 1.7])
    view = photos[0].T_world_cam.R @ torch.tensor([0.0, 0, 1])
    assert view.tolist() == pytest.approx([1.0, 0.0, 0.0], abs=1e-6) or view.norm() == pytest.approx(1.0)


def rewritten(path: Path, change) -> None:
    path.write_text(json.dumps(change(json.loads(path.read_text()))))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda scan: (scan / "pointcloud.ply").unlink(), "no pointcloud.ply"),
        (lambda scan: (scan / "sensor_frame.xml").unlink(), "no sensor_frame.xml"),
        (lambda scan: shutil.rmtree(scan / "info"), "no info"),
        (lambda scan: (scan / "info/00001-info.json").unlink(), "no such file"),
        (lambda scan: [path.unlink() for path in (scan / "cam").glob("*.jpg")], "no pictures"),
        (lambda scan: rewritten(scan / "info/00001-info.json", lambda info: {"cam0": info["cam0"]}), "no pose of cam1"),
        (lambda scan: rewritten(scan / "info/00001-info.json", lambda info: info | {"cam0": 3}), "cam0: no pose"),
        (lambda scan: (scan / "cam/00001-cam7.jpg").write_bytes(b""), "no pose of cam7"),
        (
            lambda scan: (scan / "sensor_frame.xml").write_text(
                (scan / "sensor_frame.xml").read_text().replace("<SensorName>cam1", "<SensorName>cam9")
            ),
            "no intrinsics of cam1",
        ),
    ],
)
def test_damaged_scan(damage, message, tmp_path):
    write_scan(tmp_path)
    damage(tmp_path)
    with pytest.raises(WearcapError, match=message):
        read_navvis_scan(tmp_path)


def test_invalid_frames_are_left_out(tmp_path):
    write_scan(tmp_path)
    rewritten(tmp_path / "info/00000-info.json", lambda info: info | {"valid": "false"})
    assert len(read_navvis_scan(tmp_path)[1]) == 2


# Sequences ---------------------------------------------------------------------------------------------------------


def write_video(path: Path, frames: int, size: tuple[int, int]) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=30)
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        for _ in range(frames):
            container.mux(stream.encode(av.VideoFrame(*size, "yuv420p")))
        container.mux(stream.encode())


def test_a_sequence_on_one_clock(tmp_path):
    truth = write_hps(tmp_path)
    assert hps_names(tmp_path) == [NAME]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read = read_hps_sequence(tmp_path, NAME)
    assert (read.name, read.subject, read.location, read.activity) == (NAME, "SUB4", SCAN, "walking")
    assert Path(read.scene or "").is_file()
    assert read.shape["beta_3"] == pytest.approx(0.3)
    same_motion(read.motion, truth)
    assert read.localization.timestamps[CAM_START].item() == pytest.approx(0.0)
    assert read.suit.timestamps[IMU_START].item() == pytest.approx(0.0)
    later = read.localization.timestamps >= 0
    sure = later & (read.localization.confidence > 0)
    head = truth.joint("head")
    seen = head @ read.camera.t_head_cam
    torch.testing.assert_close(read.localization.t_world_cam[sure], seen[sure[CAM_START:]], atol=1e-4, rtol=0)
    assert read.camera.camera.model == "opencv"
    assert read.camera.camera.fx == pytest.approx(871.80)
    assert read.camera.video is None


def test_the_video_keeps_its_own_rate(tmp_path):
    write_hps(tmp_path, scan=False)
    write_video(tmp_path / "head_camera_videos" / f"{NAME}.MP4", 12, (1920, 1080))
    read = read_hps_sequence(tmp_path, NAME)
    assert len(read.camera.timestamps) == 12
    assert read.camera.timestamps[0].item() == pytest.approx(-CAM_START / 30)
    assert Path(read.camera.video).is_file()
    assert read.scene is None


def test_an_mvnx_brings_contacts_and_sensors(tmp_path):
    write_hps(tmp_path, scan=False)
    (tmp_path / "hps_mvnx").mkdir()
    (tmp_path / "hps_mvnx" / f"{NAME}.mvnx").write_text(mvnx(sample()))
    rewritten(tmp_path / f"hps_inits/{NAME}.json", lambda starts: starts | {"imu_start": 1})
    read = read_hps_sequence(tmp_path, NAME)
    assert read.suit.skeleton.name == "xsens23"
    assert read.suit.contact_prob is not None
    assert read.suit.timestamps[1].item() == pytest.approx(0.0)
    assert all(imu.timestamps[1].item() == pytest.approx(0.0) for imu in read.imu.values())


def test_names_of_subjects_and_scans():
    assert subject_of("Double_SUB1_SUB2_talk") == "SUB1"
    assert _scan_name("Double_SUB1_SUB2_talk") == "MPI_EG"
    assert _scan_name("SUB1_MPI_BIB_AB_SEND_Exercises") == "MPI_BIB_AB_SEND"
    assert _scan_name("SUB3_MPI_KINO_lecture_multilevel") == "MPI_KINO"
    with pytest.raises(WearcapError, match="names no subject"):
        subject_of("walking")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda root: (root / f"hps_smpl/{NAME}.pkl").unlink(), "no sequence"),
        (lambda root: (root / f"hps_inits/{NAME}.json").unlink(), "no starts"),
        (
            lambda root: rewritten(root / f"hps_inits/{NAME}.json", lambda s: s | {"cam_start": 4000}),
            "beyond the 110 localised",
        ),
        (
            lambda root: rewritten(root / f"hps_inits/{NAME}.json", lambda s: s | {"imu_start": 4000}),
            "beyond the suit's",
        ),
        (
            lambda root: rewritten(
                root / "head_camera_videos/cameras.json", lambda c: {"029756": c["029756"] | {"captured_videos": []}}
            ),
            "no intrinsics for the video",
        ),
        (
            lambda root: write_video(root / f"head_camera_videos/{NAME}.mp4", 3, (640, 480)),
            "640x480 pixels. Expected 1920x1080",
        ),
        (
            lambda root: (root / f"head_camera_videos/{NAME}.mp4").write_bytes(b"no video at all"),
            "not a readable video",
        ),
        (lambda root: (root / "hps_betas/SUB4.json").write_text("{"), "not readable JSON"),
    ],
)
def test_damaged_sequences(damage, message, tmp_path):
    write_hps(tmp_path, scan=False)
    damage(tmp_path)
    with pytest.raises(WearcapError, match=message):
        read_hps_sequence(tmp_path, NAME)


@pytest.mark.parametrize("name", ["", "../hps_smpl/a", "*", "SUB4_none"])
def test_names_that_are_none(name, tmp_path):
    write_hps(tmp_path, scan=False)
    with pytest.raises(WearcapError, match="no sequence"):
        read_hps_sequence(tmp_path, name)


def test_a_camera_elsewhere_is_warned_of(tmp_path):
    truth = write_hps(tmp_path, scan=False)
    away = rotation.about_axis("z", torch.tensor(0.0))
    moved = hps_files.Motion(truth.timestamps, smpl24(), truth.R_parent_joint, truth.t_world_root @ away + 7.0)
    hps_files.write_localization(moved, tmp_path / f"head_camera_localizations/{NAME}.json")
    with pytest.warns(UserWarning, match="m apart"):
        read_hps_sequence(tmp_path, NAME)
