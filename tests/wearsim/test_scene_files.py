"""A simulated scene on disk is whole, is continued after a kill, and is made again when its settings change."""

from dataclasses import replace

import av
import numpy as np
import pytest
import torch
from PIL import Image

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.formats.camera_json import read_photos
from wearcap.io.formats.scene_folder import read_scan
from wearcap.recording.recording import CameraStream
from wearcap.sensors.claps import camera_claps
from wearsim.places.site import MOVABLE, build_site, changed_world
from wearsim.rendering.head_camera import HEAD_CAMERA, Filming, film, write_head_video
from wearsim.rendering.scan import SceneSettings, plan_photos, write_scene
from wearsim.rendering.views import Scenery, exposed, render_view
from wearsim.sensors.slam import R_DEVICE_CAM

COARSE = SceneSettings(spacing_m=0.15, photo_m=6.0, photo_size=128)
SMALL = HEAD_CAMERA.scaled(160, 90)


@pytest.fixture(scope="module")
def scenery() -> Scenery:
    return Scenery.of(build_site(np.random.default_rng(4), "site", scale=0.5))


@pytest.fixture(scope="module")
def folder(scenery, tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    write_scene(scenery, folder, COARSE, seed=1)
    return folder


def test_a_scene_is_whole(scenery, folder):
    photos = read_photos(folder)
    assert len(photos) % 4 == 0
    assert len(photos) >= 12
    for photo in photos:
        with Image.open(photo.file) as picture:
            assert picture.size == (128, 128) == (photo.camera.width, photo.camera.height)
    scan = read_scan(folder / "pointcloud.ply")
    assert len(scan.points) > 30_000
    assert not list(folder.rglob(".*.tmp-*"))


def test_a_photo_shows_the_scan_where_it_is_registered(scenery, folder):
    """Points of the scan that are not hidden have the colour of the pixel that they fall on."""
    photos, scan = read_photos(folder), read_scan(folder / "pointcloud.ply")
    photo = photos[4]
    depth = exposed(scenery, photo.camera, photo.T_world_cam)[1]
    in_cam = photo.T_world_cam.inverse()[None] @ torch.from_numpy(scan.points)
    pixels, valid = photo.camera.project(in_cam)
    column, row = pixels.nan_to_num(0.0).round().long().clamp(0, 127).numpy().T
    near = valid.numpy() & (np.abs(in_cam.norm(dim=-1).numpy() / depth[row, column] - 1) < 0.01)
    picture = np.asarray(Image.open(photo.file)).astype(float)
    seen, there = picture[row[near], column[near]], scan.colors[near].astype(float)
    assert near.sum() > 500
    away = np.abs(seen - there).mean()
    shuffled = np.abs(seen - np.random.default_rng(0).permutation(there)).mean()
    assert away < 0.6 * shuffled


def test_what_is_missing_is_made_and_what_is_there_is_kept(scenery, folder):
    photos = read_photos(folder)
    before = {photo.file: photo.file.read_bytes() for photo in photos}
    stamp = (folder / "pointcloud.ply").stat().st_mtime_ns
    photos[3].file.unlink()
    (folder / "photos.json").unlink()
    write_scene(scenery, folder, COARSE, seed=1, turn=9)
    assert {photo.file: photo.file.read_bytes() for photo in read_photos(folder)} == before
    assert (folder / "pointcloud.ply").stat().st_mtime_ns == stamp


def test_other_settings_make_it_again(scenery, tmp_path):
    settings = replace(COARSE, photo_m=0.0, spacing_m=0.4)
    write_scene(scenery, tmp_path, settings, seed=1)
    first = (tmp_path / "pointcloud.ply").stat().st_size
    assert read_photos(tmp_path) == []
    write_scene(scenery, tmp_path, replace(settings, spacing_m=0.3), seed=1)
    assert (tmp_path / "pointcloud.ply").stat().st_size > 1.3 * first


def test_the_rig_looks_all_around(scenery):
    photos = plan_photos(scenery, COARSE)[:4]
    forward = torch.stack([photo.T_world_cam.R[:, 2] for photo in photos])
    assert forward.mean(0).norm() < 0.3
    assert (forward @ forward.T)[0, 2] < -0.9


def test_a_changed_world_keeps_its_walls_and_loses_some_things(scenery):
    world = scenery.world
    changed = changed_world(world, np.random.default_rng(0), moved=0.5, removed=0.3)
    assert len(changed.mesh.faces) < len(world.mesh.faces)
    moved = [b for a, b in zip(world.objects, changed.objects) if a.position != b.position]
    assert moved
    assert {item.kind for item in moved} <= set(MOVABLE)
    assert len(changed.face_object) == len(changed.face_texture) == len(changed.mesh.faces)
    item = next(n for n, (a, b) in enumerate(zip(world.objects, changed.objects)) if a.position != b.position)
    old, new = Scenery.of(world).paint, Scenery.of(changed).paint
    before, after = world.face_object == item, changed.face_object == item
    np.testing.assert_array_equal(old.seeds[before], new.seeds[after])
    np.testing.assert_allclose(old.extents[before], new.extents[after], atol=1e-4)


@pytest.fixture(scope="module")
def glance(scenery):
    """Two seconds of turning at the spot, at 30 Hz, on a clock that starts at 7 s."""
    time = 7.0 + torch.arange(61, dtype=torch.float64) / 30
    x, y, z = scenery.world.places.spots[0].position
    turn = rotation.about_axis("z", 1.2 * (time - 7).float())
    return Trajectory(time, turn @ R_DEVICE_CAM, torch.tensor([[x, y, z + 1.6]]).repeat(61, 1))


def test_a_video_has_a_frame_per_time_and_the_claps_sound(scenery, glance, tmp_path):
    times = glance.timestamps[::6]
    rng = np.random.default_rng(0)
    write_head_video(tmp_path / "head.mp4", scenery, SMALL, glance, times, Filming(), rng, claps_s=(7.61, 8.4))
    with av.open(str(tmp_path / "head.mp4")) as video:
        frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    assert len(frames) == len(times)
    clean = render_view(scenery, SMALL, Rigid(glance.R_world_body[30], glance.t_world_body[30]))
    shown = [np.abs(frame.astype(float) - clean).mean() for frame in frames]
    assert int(np.argmin(shown)) == 5
    stream = CameraStream(times, SMALL, torch.eye(3), torch.zeros(3), video="head.mp4")
    torch.testing.assert_close(
        camera_claps(stream, tmp_path), torch.tensor([7.61, 8.4], dtype=torch.float64), atol=0.003, rtol=0
    )


def test_turning_blurs_and_glare_blinds(scenery, glance):
    times = glance.timestamps[10:13]
    films = {
        name: next(iter(film(scenery, SMALL, glance, times, how, np.random.default_rng(0))))
        for name, how in {
            "sharp": Filming(shutter_s=0.0, noise=0.0, exposure=0.0, vignetting=0.0),
            "blurred": Filming(shutter_s=1 / 15, noise=0.0, exposure=0.0, vignetting=0.0),
            "blind": Filming(glare_s=((7.3, 7.4),), noise=0.0),
        }.items()
    }
    edge = {name: np.abs(np.diff(picture.astype(float), axis=1)).mean() for name, picture in films.items()}
    assert edge["blurred"] < 0.92 * edge["sharp"]
    assert edge["blind"] < 0.15 * edge["sharp"]


def test_a_video_of_odd_size_or_one_frame_is_refused(scenery, glance, tmp_path):
    rng = np.random.default_rng(0)
    with pytest.raises(WearcapError, match="frames"):
        write_head_video(tmp_path / "x.mp4", scenery, SMALL, glance, glance.timestamps[:1], Filming(), rng)
