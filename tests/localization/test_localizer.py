"""The whole way in a painted room: map, retrieval, matching, pose; and what users can get wrong."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from textured_room import CAMERA, looking, photo_poses, photograph, take_photos, textured_room

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.localization.features import Features, RootSift, most_similar
from wearcap.localization.localizer import Localizer, LocalizerSettings, localize_video
from wearcap.localization.map_builder import MapSettings, build_map, extended
from wearcap.localization.point_map import PointMapper
from wearcap.localization.visual_map import Observations, VisualMap
from wearcap.scene.scan import Photo, Scan

EXTRACTOR = RootSift(600)
SETTINGS = MapSettings(splat_m=0.01, words=16)
QUERY = Camera("opencv", 480, 270, 300.0, 300.0, 240.0, 134.0, (-0.08, 0.02, 0.001, 0.001))
SPLAT_M = 0.01


@pytest.fixture(scope="module")
def mapper() -> PointMapper:
    return PointMapper(textured_room(), SPLAT_M)


@pytest.fixture(scope="module")
def photos(mapper, tmp_path_factory) -> list[Photo]:
    return take_photos(mapper, CAMERA, photo_poses(24), tmp_path_factory.mktemp("photos"))


@pytest.fixture(scope="module")
def room_map(mapper, photos) -> VisualMap:
    return build_map(photos, Scan(mapper.scan.points), EXTRACTOR, settings=SETTINGS)


def errors(pose, truth) -> tuple[float, float]:
    """Degrees and metres."""
    turn = rotation.log(pose.R_world_cam.double().T @ truth.R).norm().rad2deg().item()
    return turn, (pose.t_world_cam.double() - truth.t).norm().item()


def planted(count: int) -> list:
    random = np.random.default_rng(5)
    return [
        looking((*random.uniform([1.2, 1.2, 1.4], [3.8, 2.8, 1.9]),), *random.uniform([0, -0.2, -0.2], [6.28, 0.3, 0.2]))
        for _ in range(count)
    ]  # fmt: skip


def test_planted_poses_are_found(mapper, room_map):
    localizer = Localizer(room_map, EXTRACTOR)
    found = []
    for truth in planted(6):
        pose = localizer(photograph(mapper, QUERY, truth), QUERY)
        assert pose is not None
        assert pose.confidence > 0.9
        found.append(errors(pose, truth))
    turns, shifts = np.array(found).T
    assert turns.max() < 0.1
    assert shifts.max() < 0.004


def test_the_covariance_speaks_of_the_error(mapper, room_map):
    localizer = Localizer(room_map, EXTRACTOR)
    normalised = []
    for truth in planted(6):
        pose = localizer(photograph(mapper, QUERY, truth), QUERY)
        turn = rotation.log(truth.R @ pose.R_world_cam.double().T)
        error = torch.cat([turn, truth.t - pose.t_world_cam.double()])
        assert torch.linalg.eigvalsh(pose.covariance.double()).min() > 0
        normalised.append((error @ torch.linalg.solve(pose.covariance.double(), error)).item() / 6)
    assert 0.3 < np.mean(normalised) < 3  # 1 where errors of matches are independent


def test_positions_lie_on_the_walls(mapper, room_map):
    size = np.array([5.0, 4.0, 2.6])
    off = np.minimum(np.abs(room_map.observations.positions), np.abs(room_map.observations.positions - size)).min(1)
    assert np.median(off) < 0.002
    assert np.quantile(off, 0.99) < 0.02
    assert len(room_map.landmarks.points_world) < 0.9 * len(room_map.observations.positions)


def test_a_map_survives_its_file(mapper, room_map, tmp_path):
    path = tmp_path / "room.safetensors"
    room_map.save(path)
    loaded = VisualMap.load(path)
    assert loaded.cameras == room_map.cameras
    assert loaded.names == room_map.names
    for name, array in vars(room_map.observations).items():
        np.testing.assert_array_equal(getattr(loaded.observations, name), array)
    np.testing.assert_array_equal(loaded.T_world_cam.R, room_map.T_world_cam.R)
    np.testing.assert_array_equal(loaded.vocabulary, room_map.vocabulary)
    truth = planted(1)[0]
    image = photograph(mapper, QUERY, truth)
    one, other = (Localizer(m, EXTRACTOR)(image, QUERY) for m in (room_map, loaded))
    torch.testing.assert_close(one.t_world_cam, other.t_world_cam)
    assert len(list(tmp_path.iterdir())) == 1


def test_an_extended_map_knows_both_parts(mapper, photos, room_map):
    scan = Scan(mapper.scan.points)
    half = build_map(photos[:12], scan, EXTRACTOR, settings=SETTINGS)
    both = extended(half, photos[12:], scan, EXTRACTOR, settings=SETTINGS)
    both.check()
    assert both.names == room_map.names
    np.testing.assert_array_equal(both.observations.positions, room_map.observations.positions)
    np.testing.assert_array_equal(both.observations.landmark, room_map.observations.landmark)
    np.testing.assert_array_equal(both.vocabulary, half.vocabulary)
    truth = photos[20].T_world_cam
    pose = Localizer(both, EXTRACTOR)(photograph(mapper, QUERY, truth), QUERY)
    assert errors(pose, truth)[1] < 0.01


def test_retrieval_finds_what_shows_the_same_wall(mapper, room_map):
    localizer = Localizer(room_map, EXTRACTOR)
    ranks = []
    for truth in planted(8):
        image = photograph(mapper, QUERY, truth)
        summary = localizer.vlad.aggregate(EXTRACTOR(image).descriptors)
        best = most_similar(summary, room_map.global_descriptors, 3)
        angle = np.arccos(np.clip(room_map.T_world_cam.R.numpy()[:, :, 2] @ truth.R[:, 2].numpy(), -1, 1))
        ranks.append(angle[best].min() < np.radians(40))
    assert np.mean(ranks) > 0.8


def test_a_fisheye_map_and_a_fisheye_query(mapper, tmp_path):
    fisheye = Camera("fisheye", 420, 420, 130.0, 130.0, 210.0, 209.0, (0.01, -0.004, 0.001, 0.0))
    photos = take_photos(mapper, fisheye, photo_poses(8), tmp_path)
    visual_map = build_map(photos, Scan(mapper.scan.points), EXTRACTOR, settings=SETTINGS)
    assert {camera.model for camera in visual_map.cameras} == {"pinhole"}
    truth = planted(2)[1]
    pose = Localizer(visual_map, EXTRACTOR)(photograph(mapper, fisheye, truth), fisheye)
    turn, shift = errors(pose, truth)
    assert turn < 0.3
    assert shift < 0.03


def test_a_video_with_lost_frames_and_a_wrong_prior(mapper, room_map):
    poses = [looking((1.5 + 0.1 * k, 2.0, 1.6), 0.3 + 0.1 * k) for k in range(5)]
    frames = [photograph(mapper, QUERY, pose) for pose in poses]
    frames[0] = frames[2] = np.full_like(frames[0], 90)
    times = torch.arange(5, dtype=torch.float64) / 10
    localizer = Localizer(room_map, EXTRACTOR)
    found = localize_video(frames, times, QUERY, localizer)
    assert (found.confidence == 0).tolist() == [True, False, True, False, False]
    assert found.R_world_cam.isfinite().all()
    torch.testing.assert_close(found.t_world_cam[2], found.t_world_cam[1])
    torch.testing.assert_close(found.t_world_cam[0], found.t_world_cam[1])
    truth = torch.stack([pose.t for pose in poses])
    assert (found.t_world_cam - truth)[[1, 3, 4]].norm(dim=1).max() < 0.01
    assert found.covariance[2].diagonal().min() > 100 * found.covariance[1].diagonal().max()
    wrong = looking((4.0, 3.5, 1.2), 3.6)
    assert errors(localizer(frames[4], QUERY, wrong), poses[4])[1] < 0.01
    nothing = localize_video([frames[0]] * 2, times[:2], QUERY, localizer)
    assert not nothing.confidence.any()
    assert nothing.t_world_cam.isfinite().all()
    for count in (4, 6):
        with pytest.raises(WearcapError, match="timestamps"):
            localize_video(frames, torch.arange(count).double(), QUERY, localizer)


def test_a_place_that_is_not_in_the_map_has_no_pose(mapper, room_map):
    other = PointMapper(textured_room(0.02, seed=9), 0.015)
    localizer = Localizer(room_map, EXTRACTOR)
    found = [localizer(photograph(other, QUERY, pose), QUERY) for pose in planted(6)]
    assert all(pose is None or pose.confidence < 0.5 for pose in found)


def test_a_matcher_of_picture_pairs(mapper, room_map):
    """What LightGlue would do: here, mutual nearest neighbours."""

    def mutual(query: Features, other: Features) -> np.ndarray:
        similarity = query.descriptors @ other.descriptors.T
        forth, back = similarity.argmax(1), similarity.argmax(0)
        keep = np.flatnonzero(back[forth] == np.arange(len(query)))
        return np.stack([keep, forth[keep]], 1)

    truth = planted(1)[0]
    settings = LocalizerSettings(retrieved=10)
    localizer = Localizer(room_map, EXTRACTOR, mutual, settings)
    image = photograph(mapper, QUERY, truth)
    assert errors(localizer(image, QUERY), truth)[1] < 0.03
    T, seen = room_map.T_world_cam, room_map.observations
    first = np.concatenate([seen.first, seen.first[-1] + seen.first[1:]])
    doubled = {name: np.concatenate([array] * 2) for name, array in vars(seen).items()} | {"first": first}
    twice = replace(
        room_map,
        names=room_map.names * 2,
        cameras=room_map.cameras * 2,
        T_world_cam=Rigid(torch.cat([T.R] * 2), torch.cat([T.t] * 2)),
        global_descriptors=np.concatenate([room_map.global_descriptors] * 2),
        observations=Observations(**doubled),
    )
    again = Localizer(twice, EXTRACTOR, mutual, replace(settings, retrieved=20))
    # the same pictures once more tell no more
    assert again(image, QUERY).inliers == localizer(image, QUERY).inliers


def test_the_nearest_pictures_look_the_same_way(room_map):
    prior = room_map.T_world_cam[7]
    chosen = room_map.nearest(prior, 4)
    assert chosen[0] == 7
    assert len(chosen) == 4


# What users can get wrong


def test_photos_of_another_size_than_their_calibration(mapper, photos):
    wrong = [Photo(photos[0].file, replace(CAMERA, width=640), photos[0].T_world_cam)]
    with pytest.raises(WearcapError, match=r"00000.png: a picture of 400x300 pixels with a calibration for 640x300"):
        build_map(wrong, Scan(mapper.scan.points), EXTRACTOR, settings=SETTINGS)


def test_queries_of_another_size_and_without_intrinsics(room_map):
    localizer = Localizer(room_map, EXTRACTOR)
    with pytest.raises(WearcapError, match="calibration for 480x270"):
        localizer(np.zeros((100, 100, 3), np.uint8), QUERY)
    with pytest.raises(WearcapError, match="no intrinsics"):
        localizer(np.zeros((270, 480, 3), np.uint8), None)


def test_no_photos_and_photos_that_do_not_see_the_scan(mapper, photos, room_map):
    with pytest.raises(WearcapError, match="no photos"):
        extended(room_map, [], Scan(mapper.scan.points), EXTRACTOR, settings=SETTINGS)
    with pytest.raises(WearcapError, match="no photos"):
        build_map([], Scan(mapper.scan.points), EXTRACTOR)
    with pytest.raises(WearcapError, match=r"would be empty.*one unit"):
        build_map(photos[:3], Scan(mapper.scan.points - 100), EXTRACTOR, settings=SETTINGS)


def test_missing_and_unreadable_photos(mapper, photos, tmp_path):
    absent = [Photo(tmp_path / "none.jpg", CAMERA, photos[0].T_world_cam)]
    with pytest.raises(WearcapError, match="none.jpg: no such picture"):
        build_map(absent, Scan(mapper.scan.points), EXTRACTOR)
    (tmp_path / "none.jpg").write_bytes(b"\xff\xd8 no more")
    with pytest.raises(WearcapError, match="not a readable picture"):
        build_map(absent, Scan(mapper.scan.points), EXTRACTOR)


def test_a_map_of_other_features(room_map):
    class Other(RootSift):
        name = "other"

    with pytest.raises(WearcapError, match="made with 'rootsift' features, not 'other'"):
        Localizer(room_map, Other())


def test_an_empty_map(room_map):
    keep = slice(0, 0)
    landmarks = replace(
        room_map.landmarks,
        points_world=room_map.landmarks.points_world[keep],
        descriptors=room_map.landmarks.descriptors[keep],
    )
    with pytest.raises(WearcapError, match="the map is empty"):
        Localizer(replace(room_map, landmarks=landmarks), EXTRACTOR)


def test_files_that_are_no_maps(room_map, tmp_path):
    from safetensors.numpy import save_file

    path = tmp_path / "map.safetensors"
    with pytest.raises(WearcapError, match="no such visual map"):
        VisualMap.load(path)
    save_file({"a": np.zeros(3)}, path)
    with pytest.raises(WearcapError, match="not a visual map"):
        VisualMap.load(path)
    room_map.save(path)
    content = path.read_bytes()
    path.write_bytes(content[:-100])
    with pytest.raises(WearcapError, match="not a readable visual map"):
        VisualMap.load(path)
    shifted = replace(room_map.observations, first=room_map.observations.first + 1)
    replace(room_map, observations=shifted).save(path)
    with pytest.raises(WearcapError, match="damaged map .*share out the observations"):
        VisualMap.load(path)


def test_a_cloud_without_colour_maps(mapper):
    bare = PointMapper(Scan(mapper.scan.points), SPLAT_M)
    point_map = bare(CAMERA, looking((2.0, 2.0, 1.5), 0.0))
    assert (point_map.index >= 0).mean() > 0.99


def test_an_image_file_reads_as_rgb(tmp_path):
    from wearcap.io.formats.video import read_image

    Image.fromarray(np.full((4, 6), 7, np.uint8)).save(tmp_path / "gray.png")
    assert read_image(tmp_path / "gray.png").tolist() == [[[7] * 3] * 6] * 4
