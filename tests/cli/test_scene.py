"""`wearcap scene`: from folders of each kind to a map, and what it reports about folders that are none."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from wearcap.cli import scene
from wearcap.cli.conf import compose
from wearcap.errors import WearcapError
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.io.formats.camera_json import write_photos
from wearcap.io.formats.ply import Ply, write_ply
from wearcap.localization.visual_map import VisualMap
from wearcap.scene.scan import Photo

CAMERA = Camera.pinhole(240, 180, 60.0)
FACING_WALL = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""An OpenCV camera that looks along x, z up."""


def painted_wall(folder: Path, photos: int = 9) -> list[Photo]:
    """A wall at x = 3 m with random squares, as cloud and photos."""
    random = np.random.default_rng(0)
    paint = np.kron(random.integers(0, 256, (40, 60, 3)), np.ones((8, 8, 1))).astype(np.uint8)
    row, column = np.mgrid[: paint.shape[0], : paint.shape[1]]
    points = np.stack([0 * row + 3.0, 2.4 - 0.01 * column, 3.2 - 0.01 * row], -1).reshape(-1, 3)
    write_ply(Ply(points.astype(np.float32), paint.reshape(-1, 3)), folder / "pointcloud.ply")
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    taken = []
    for number in range(photos):
        eye = np.array([0.6, *random.uniform(-0.4, 0.4, 1), *random.uniform(1.3, 1.9, 1)])
        y = eye[1] - (u - CAMERA.cx) / CAMERA.fx * (3 - eye[0])
        z = eye[2] - (v - CAMERA.cy) / CAMERA.fy * (3 - eye[0])
        place = np.rint([(3.2 - z) / 0.01, (2.4 - y) / 0.01]).astype(int)
        seen = paint[place[0].clip(0, paint.shape[0] - 1), place[1].clip(0, paint.shape[1] - 1)]
        file = folder / "photos" / f"{number:05}.png"
        file.parent.mkdir(exist_ok=True)
        Image.fromarray(seen).save(file)
        taken.append(Photo(file, CAMERA, Rigid(FACING_WALL, torch.from_numpy(eye).float())))
    write_photos(taken, folder)
    return taken


def run(folder: Path, *overrides: str) -> VisualMap:
    output = folder / "map.safetensors"
    settings = ["localization.extractor.max_keypoints=300", "settings.splat_m=0.008", "settings.words=8"]
    config = compose("scene", [f"scene={folder}", f"output={output}", *settings, *overrides])
    made = scene.run(config)
    assert VisualMap.load(output).names == made.names
    return made


def test_a_scanned_scene_becomes_a_map(tmp_path, capsys):
    painted_wall(tmp_path)
    made = run(tmp_path, "check=2")
    assert len(made) == 9
    assert np.abs(made.observations.positions[:, 0] - 3).max() < 0.01
    printed = capsys.readouterr().out
    assert "2 of 2 photos are found in the map of the others" in printed
    assert "rootsift" in printed
    few = run(tmp_path, "check=0", "every=3")
    assert few.names == ("00000.png", "00003.png", "00006.png")
    more = run(tmp_path, "check=0", "every=4", f"extend={tmp_path / 'map.safetensors'}")
    assert more.names == (*few.names, "00000.png", "00004.png", "00008.png")


def test_a_colmap_model_becomes_a_map(tmp_path, capsys):
    photos = painted_wall(tmp_path)
    (tmp_path / "photos.json").unlink()
    random = np.random.default_rng(1)
    points = np.stack([np.full(4000, 3.0), *random.uniform([[-1.2], [0.5]], [[1.2], [2.7]], (2, 4000))], -1)
    images, tracks = [], [[] for _ in points]
    for number, photo in enumerate(photos):
        back = photo.T_world_cam.inverse()
        pixels, valid = CAMERA.project(back @ torch.from_numpy(points).float())
        row = []
        for place, (point, (x, y)) in enumerate(zip(np.flatnonzero(valid), pixels[valid].tolist())):
            row.append(f"{x + 0.5} {y + 0.5} {point}")
            tracks[point] += [number, place]
        quaternion = "0.5 0.5 -0.5 0.5"  # of R_cam_world
        images.append(
            f"{number} {quaternion} {' '.join(map(str, back.t.tolist()))} 1 {photo.file.name}\n{' '.join(row)}\n"
        )
    (tmp_path / "images.txt").write_text("".join(images))
    (tmp_path / "cameras.txt").write_text(
        f"1 PINHOLE 240 180 {CAMERA.fx} {CAMERA.fy} {CAMERA.cx + 0.5} {CAMERA.cy + 0.5}\n"
    )
    (tmp_path / "points3D.txt").write_text(
        "".join(f"{k} {x} {y} {z} 9 9 9 0.1 {' '.join(map(str, tracks[k]))}\n" for k, (x, y, z) in enumerate(points))
    )
    made = run(tmp_path, f"images={tmp_path / 'photos'}", "check=2", "settings.track_distance_px=1")
    assert len(made) == 9
    assert np.abs(made.observations.positions[:, 0] - 3).max() < 1e-4
    assert "of 2 photos are found" in capsys.readouterr().out


def test_what_is_wrong_is_reported(tmp_path):
    for overrides, match in (
        ([f"scene={tmp_path / 'none'}"], "no such folder"),
        ([f"scene={tmp_path}"], "no scene of a known kind"),
        ([f"scene={tmp_path}", "every=0"], "every=0"),
        ([f"scene={tmp_path}", "evry=2"], "Did you mean 'every'"),
        ([], "scene has no value"),
    ):
        with pytest.raises(WearcapError, match=match):
            scene.main([*overrides, f"paths.outputs={tmp_path / 'out'}"])
    painted_wall(tmp_path, 2)
    (tmp_path / "pointcloud.ply").unlink()
    with pytest.raises(WearcapError, match="pointcloud.ply"):
        run(tmp_path)
