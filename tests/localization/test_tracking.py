"""Tracking a plain video: what surrounds COLMAP on a small model, and COLMAP itself on real photos."""

import json
import sys

import numpy as np
import pytest
import roma
import torch
from PIL import Image
from small_model import HEIGHT, WIDTH, camera_path, write_model, write_pictures

from wearcap.cli import track as verb
from wearcap.cli.main import run_verb
from wearcap.cli.verbs import overrides
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.camera import Camera
from wearcap.io.formats.camera_json import read_camera, write_camera
from wearcap.io.formats.colmap import read_colmap
from wearcap.io.formats.ply import read_ply
from wearcap.io.formats.trajectory import read_trajectory
from wearcap.io.formats.video import write_frames
from wearcap.localization import tracking
from wearcap.localization.structure import MappingSettings, colmap_camera
from wearcap.localization.tracking import TrackSettings, track_pictures

SETTINGS = TrackSettings(10.0, 0.5, MappingSettings(threads=2))


@pytest.fixture
def mapped(monkeypatch):
    """Mapping replaced by the small model; tells how often it was asked for."""
    calls = []

    def map_pictures(names, images, folder, camera, settings, advance):
        calls.append(list(names))
        write_model(folder / "model", list(names), missing=(0, 4, 5))
        return folder / "model"

    monkeypatch.setattr(tracking, "map_pictures", map_pictures)
    return calls


def quiet(step: str, done: int, total: int) -> None:
    assert 0 <= done <= total


def test_a_folder_of_pictures(tmp_path, mapped):
    write_pictures(tmp_path / "in", 12)
    found = track_pictures(tmp_path / "in", tmp_path / "out", SETTINGS, None, quiet)
    assert (found.pictures, found.placed, len(found.T_world_cam)) == (12, 9, 11)
    assert found.gaps_s == ((0.0, pytest.approx(0.1), False), (pytest.approx(0.3), pytest.approx(0.6), True))
    t, R = camera_path(12)
    assert found.T_world_cam.timestamps.tolist() == pytest.approx([k / 10 for k in range(1, 12)])
    placed = torch.tensor([1, 2, 3, 6, 7, 8, 9, 10, 11])
    mine = found.T_world_cam[placed - 1]
    np.testing.assert_allclose(mine.t_world_body.numpy(), t[placed], atol=1e-6)
    expected = torch.from_numpy(R[placed.numpy()].as_matrix()).float()
    assert rotation.geodesic(mine.R_world_body, expected).max() < 1e-4
    assert found.T_world_cam.t_world_body[3].tolist() == pytest.approx((t[3] + (t[6] - t[3]) / 3).tolist(), abs=1e-5)
    assert found.reprojection_px < 1e-3


def test_a_video_is_thinned_and_keeps_its_times(tmp_path, mapped):
    frames = np.random.default_rng(0).integers(0, 255, (60, 64, 96, 3), np.uint8)
    write_frames(tmp_path / "v.mp4", frames, 30.0)
    found = track_pictures(tmp_path / "v.mp4", tmp_path / "out", SETTINGS, None, quiet)
    assert len(mapped[0]) == 20
    assert found.T_world_cam.timestamps.tolist() == pytest.approx([k / 10 for k in range(1, 20)], abs=1e-3)
    assert Image.open(tmp_path / "out/frames/000003.jpg").size == (96, 64)
    stamp = (tmp_path / "out/frames/000003.jpg").stat().st_mtime_ns
    track_pictures(tmp_path / "v.mp4", tmp_path / "out", SETTINGS, None, quiet)
    assert (tmp_path / "out/frames/000003.jpg").stat().st_mtime_ns == stamp


def test_another_source_or_other_settings_are_refused(tmp_path, mapped):
    write_pictures(tmp_path / "in", 6)
    track_pictures(tmp_path / "in", tmp_path / "out", SETTINGS, None, quiet)
    write_pictures(tmp_path / "other", 6)
    with pytest.raises(WearcapError, match="another source, or of other settings"):
        track_pictures(tmp_path / "other", tmp_path / "out", SETTINGS, None, quiet)
    slower = TrackSettings(5.0, 0.5, SETTINGS.mapping)
    with pytest.raises(WearcapError, match="Choose another: output=DIR"):
        track_pictures(tmp_path / "in", tmp_path / "out", slower, None, quiet)


def test_what_cannot_be_tracked_is_named(tmp_path, mapped):
    with pytest.raises(WearcapError, match="no such file or folder"):
        track_pictures(tmp_path / "none", tmp_path / "a", SETTINGS, None, quiet)
    (tmp_path / "empty").mkdir()
    with pytest.raises(WearcapError, match="no pictures in this folder"):
        track_pictures(tmp_path / "empty", tmp_path / "b", SETTINGS, None, quiet)
    write_pictures(tmp_path / "two", 2)
    with pytest.raises(WearcapError, match="2 pictures. Expected at least 3"):
        track_pictures(tmp_path / "two", tmp_path / "c", SETTINGS, None, quiet)
    write_pictures(tmp_path / "six", 6)
    with pytest.raises(WearcapError, match="calibration for 640x480"):
        track_pictures(tmp_path / "six", tmp_path / "d", SETTINGS, Camera.pinhole(640, 480, 60), quiet)
    with pytest.raises(WearcapError, match="fps=0"):
        verb.main([f"source={tmp_path / 'six'}", "settings.fps=0", f"paths.outputs={tmp_path}"])
    with pytest.raises(WearcapError, match="nothing to track"):
        verb.main([f"paths.outputs={tmp_path}"])


def test_without_the_extra_it_names_what_to_install(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    write_pictures(tmp_path / "in", 6)
    assert run_verb("track", [str(tmp_path / "in"), f"paths.outputs={tmp_path / 'out'}"]) == 2
    assert 'pip install "wearcap[track]"' in capsys.readouterr().err


def test_from_a_finished_model(tmp_path, monkeypatch, capsys):
    """Neither pycolmap nor the pictures are needed; with their folder, missing ones are gaps."""
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    names = write_pictures(tmp_path / "in put", 12)
    points = write_model(tmp_path / "model", names, missing=(4, 5), error_px=1.5)
    out = tmp_path / "o"
    verb.main([f"from_model={tmp_path / 'model'}", f"output={out}", "settings.fps=10", f"paths.outputs={tmp_path}"])
    assert "10 of 10 pictures placed" in capsys.readouterr().out
    arguments = [
        f"from_model={tmp_path / 'model'}",
        f"source={tmp_path / 'in put'}",
        f"output={out}",
        "settings.fps=10",
    ]
    verb.main([*arguments, f"paths.outputs={tmp_path}"])
    assert "scale and axes are arbitrary" in " ".join(capsys.readouterr().out.split())
    report = json.loads((out / "report.json").read_text())
    assert (report["pictures"], report["placed"], report["interpolated"], report["points"]) == (12, 10, 2, 60)
    assert report["reprojection_px"] == pytest.approx(1.5, abs=1e-3)
    assert report["gaps"] == [{"start_s": 0.3, "stop_s": 0.6, "interpolated": True}]
    assert report["scale"].startswith("arbitrary")
    assert len(read_trajectory(out / "trajectory.txt")) == 12
    np.testing.assert_allclose(read_ply(out / "points.ply").points, points, atol=1e-6)
    camera = read_camera(out / "camera.json")
    assert (camera.width, camera.height, camera.cx) == (WIDTH, HEIGHT, WIDTH / 2 - 0.5)


def test_a_model_of_other_pictures_or_of_several_cameras_is_refused(tmp_path):
    names = write_pictures(tmp_path / "in", 6)
    write_model(tmp_path / "model", [f"x{name}" for name in names])
    with pytest.raises(WearcapError, match="places none of 6 pictures"):
        verb.main([f"from_model={tmp_path / 'model'}", f"source={tmp_path / 'in'}", f"paths.outputs={tmp_path}"])
    write_model(tmp_path / "model", names)
    cameras = tmp_path / "model/cameras.txt"
    cameras.write_text(cameras.read_text() + f"2 PINHOLE {WIDTH} {HEIGHT} 99 99 80 60\n")
    images = tmp_path / "model/images.txt"
    images.write_text(images.read_text().replace(" 1 p003.jpg", " 2 p003.jpg"))
    with pytest.raises(WearcapError, match="2 cameras"):
        verb.main([f"from_model={tmp_path / 'model'}", f"paths.outputs={tmp_path}"])


def test_cameras_as_colmap_writes_them():
    lens = (0.1, -0.02, 0.003, 0.004)
    assert colmap_camera(Camera("pinhole", 640, 480, 500, 510, 319.5, 239.5)) == ("PINHOLE", "500,510,320,240")
    assert colmap_camera(Camera("fisheye", 640, 480, 500, 510, 319.5, 239.5, lens)) == (
        "OPENCV_FISHEYE",
        "500,510,320,240,0.1,-0.02,0.003,0.004",
    )
    with pytest.raises(WearcapError, match="COLMAP has no camera 'opencv' with 5 coefficients"):
        colmap_camera(Camera("opencv", 640, 480, 500, 510, 319.5, 239.5, (*lens, 0.1)))


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["a b.mp4", "settings.fps=3"], ["source=a b.mp4", "settings.fps=3"]),
        (["--from-model", "it's"], ["from_model=it's"]),
        (["--cfg", "job", "v.mp4"], ["--cfg", "job", "source=v.mp4"]),
        (["--help"], ["--help"]),
    ],
)
def test_arguments_of_the_command(arguments, expected):
    assert overrides("track", arguments) == expected


@pytest.mark.real
@pytest.mark.slow
def test_real_photos_are_tracked(real_data, tmp_path):
    """Of 24 photos all are placed, within 1 % of the path's extent and 1° of the model that was made of 97."""
    pytest.importorskip("pycolmap")
    truth = {photo.file.name: photo for photo in read_colmap(real_data / "visual_loc" / "sfm_full").photos}
    (tmp_path / "in").mkdir()
    for name in sorted(truth)[:24]:
        (tmp_path / "in" / name).symlink_to(truth[name].file)
    camera = next(iter(truth.values())).camera
    write_camera(camera, tmp_path / "camera.json")
    arguments = [
        f"source={tmp_path / 'in'}",
        f"camera={tmp_path / 'camera.json'}",
        f"output={tmp_path / 'out'}",
        "settings.mapping.max_keypoints=2048",
        f"paths.outputs={tmp_path}",
    ]
    verb.main(arguments)
    report = json.loads((tmp_path / "out/report.json").read_text())
    assert report["placed"] == 24
    assert report["reprojection_px"] < 1.0
    assert read_camera(tmp_path / "out/camera.json").fx == pytest.approx(camera.fx)
    found = read_trajectory(tmp_path / "out/trajectory.txt")
    t = torch.stack([truth[name].T_world_cam.t for name in sorted(truth)[:24]])
    R = torch.stack([truth[name].T_world_cam.R for name in sorted(truth)[:24]])
    turn, move, scale = roma.rigid_points_registration(found.t_world_body.double(), t, compute_scaling=True)
    off = (scale * found.t_world_body.double() @ turn.T + move - t).norm(dim=-1)
    extent = (t.amax(0) - t.amin(0)).norm()
    assert off.max() < 0.01 * extent
    assert rotation.geodesic(turn @ found.R_world_body.double(), R).rad2deg().max() < 1.0
    stamp = (tmp_path / "out/model/images.bin").stat().st_mtime_ns
    verb.main(arguments)
    assert (tmp_path / "out/model/images.bin").stat().st_mtime_ns == stamp
