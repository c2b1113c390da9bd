"""The parts of localisation, one by one, against what is known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from textured_room import CAMERA, SIZE, color_picture, looking, textured_room

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.io.formats.colmap import Tracks
from wearcap.localization.absolute_pose import Fit, Matches, match_landmarks, match_nearby
from wearcap.localization.features import Features, RootSift, Vlad, most_similar, root
from wearcap.localization.localizer import confidence
from wearcap.localization.map_builder import MapSettings, _lift
from wearcap.localization.point_map import PointMapper, _PointMap, undistortion
from wearcap.localization.visual_map import from_bytes, merge, to_bytes
from wearcap.scene.scan import Photo, Scan

FISHEYE = Camera("fisheye", 300, 300, 95.0, 95.0, 150.0, 149.0, (0.01, -0.004, 0.001, 0.0))


def unit_rows(count: int, width: int, seed: int = 0) -> np.ndarray:
    rows = np.random.default_rng(seed).normal(size=(count, width)).astype(np.float32)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


# Features


def blobs(centers: list[tuple[float, float]]) -> np.ndarray:
    y, x = np.mgrid[:240, :320]
    gray = sum(200 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / 32) for cx, cy in centers)
    return np.repeat((20 + gray).astype(np.uint8)[..., None], 3, 2)


@pytest.mark.parametrize("max_side", [None, 160])
def test_keypoints_lie_where_blobs_are(max_side):
    centers = [(60.3, 80.6), (200.0, 50.0), (150.5, 180.25)]
    features = RootSift(20, max_side=max_side)(blobs(centers))
    assert features.size == (320, 240)
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1, atol=1e-5)
    for center in centers:
        assert np.linalg.norm(features.keypoints - center, axis=1).min() < 0.12


def test_no_more_keypoints_than_asked_for_and_the_strongest_of_them():
    image = np.random.default_rng(0).integers(0, 256, (120, 160, 3)).astype(np.uint8)
    many, few = RootSift(1000)(image), RootSift(30)(image)
    assert len(few) == 30
    assert few.scores.min() >= np.sort(many.scores)[-31] - 1e-6
    assert len(RootSift()(np.full((100, 100, 3), 99, np.uint8))) == 0
    with pytest.raises(WearcapError, match="SIFT with 0 keypoints"):
        RootSift(0)


def test_root_turns_euclidean_into_hellinger():
    a, b = np.random.default_rng(0).random((2, 5, 128)).astype(np.float32)
    p, q = a / a.sum(1, keepdims=True), b / b.sum(1, keepdims=True)
    np.testing.assert_allclose((root(a) * root(b)).sum(1), np.sqrt(p * q).sum(1), rtol=1e-5)


# Point maps


def test_keypoints_are_lifted_onto_the_walls_and_not_at_edges():
    wall = np.stack(np.meshgrid(np.arange(-2, 2, 0.01), np.arange(-1.5, 1.5, 0.01)), -1).reshape(-1, 2)
    slanted = np.concatenate([wall, 3 + 0.7 * wall[:, :1]], 1)
    pole = np.stack(np.meshgrid(np.arange(-0.1, 0.1, 0.01), np.arange(-1.5, 1.5, 0.01)), -1).reshape(-1, 2)
    pole = np.concatenate([pole, np.full((len(pole), 1), 1.8)], 1)
    scan = Scan(np.concatenate([slanted, pole]).astype(np.float32))
    camera = Camera("opencv", 200, 160, 150.0, 150.0, 99.5, 79.5, (-0.05, 0.01, 0.001, 0.001))
    point_map = PointMapper(scan, 0.009)(camera, Rigid.identity())
    random = np.random.default_rng(0)
    keypoints = random.uniform([60, 30], [140, 130], (400, 2)).astype(np.float32)
    positions, valid = point_map.lift(scan.points, keypoints)
    on_wall = np.abs(positions[:, 2] - 3 - 0.7 * positions[:, 0])
    on_pole = np.abs(positions[:, 2] - 1.8)
    assert np.minimum(on_wall, on_pole)[valid].max() < 0.002
    pixels, _ = camera.project(torch.from_numpy(positions).double())
    np.testing.assert_allclose(pixels.numpy()[valid], keypoints[valid], atol=1e-3)
    edges = camera.project(torch.tensor([[-0.1, 0.0, 1.8], [0.1, 0.0, 1.8]], dtype=torch.float64))[0][:, 0]
    at_edge = np.abs(keypoints[:, :1] - edges.numpy()).min(1) < 1
    assert at_edge.sum() > 5
    assert not valid[at_edge].any()
    assert valid[np.abs(keypoints[:, :1] - edges.numpy()).min(1) > 5].mean() > 0.95
    outside = np.array([[-5, 20], [400, 20], [np.float32(0.2), 0.4]], np.float32)
    assert not point_map.lift(scan.points, outside)[1].any()


def test_a_fisheye_and_its_point_map_are_undistorted_alike():
    scan = textured_room(0.02)
    mapper = PointMapper(scan, 0.016)
    pose = looking((2.0, 2.2, 1.3), 0.8, 0.1, 0.05)
    remap = undistortion(FISHEYE, 90.0)
    flat = remap.point_map(mapper(FISHEYE, pose))
    assert (flat.camera.model, flat.camera.fx) == ("pinhole", pytest.approx(150.0))
    direct = mapper(flat.camera, pose)
    seen = (flat.index >= 0) & (direct.index >= 0)
    assert seen.mean() > 0.95
    apart = np.linalg.norm(scan.points[flat.index[seen]] - scan.points[direct.index[seen]], axis=1)
    assert np.median(apart) < 0.025
    assert np.median(np.abs(flat.depth - direct.depth)[seen]) < 0.015
    picture, other = remap.image(color_picture(mapper, FISHEYE, pose)), color_picture(mapper, flat.camera, pose)
    assert np.abs(picture.astype(int) - other)[seen].mean() < 35  # shifted pictures differ by 60 and more
    keypoints = np.random.default_rng(0).uniform(40, 260, (200, 2)).astype(np.float32)
    positions, valid = flat.lift(scan.points, keypoints)
    off = np.minimum(np.abs(positions), np.abs(positions - SIZE)).min(1)
    assert valid.mean() > 0.7
    assert np.median(off[valid]) < 0.003
    with pytest.raises(WearcapError, match="perspective view of 179"):
        undistortion(FISHEYE, 179.0)


def test_a_narrow_fisheye_does_not_reach_a_wide_view():
    narrow = Camera("fisheye", 300, 300, 190.0, 190.0, 150.0, 149.0, (0.0,) * 4)
    remap = undistortion(narrow, 120.0)
    assert 0.2 < remap.valid.mean() < 0.9
    assert not remap.image(np.full((300, 300, 3), 200, np.uint8))[~remap.valid].any()


def test_a_border_between_two_pixels_does_not_lead_out_of_the_picture():
    """float32 rounds what lies a hair within the border at 299.5 up to it, and that to pixel 300."""
    lens = Camera("fisheye", 300, 300, 190.0, 190.0, 150.0, 149.5, (0.0,) * 4)
    flat = undistortion(lens, 90.0).camera
    seen, _ = lens.project(flat.unproject(torch.tensor([250.0, 149.0], dtype=torch.float64)))
    lens = replace(lens, cx=lens.cx + 299.5 - 1e-9 - seen[0].item())
    remap = undistortion(lens, 90.0)
    assert remap.valid[149, 250]
    index, depth = np.zeros((300, 300), np.int32), np.ones((300, 300), np.float32)
    flat_map = remap.point_map(_PointMap(lens, Rigid.identity(), index, depth))
    assert flat_map.index[149, 250] == 0


def test_tracks_behind_the_perspective_view_lift_nothing():
    wide = Camera("fisheye", 400, 400, 80.0, 80.0, 200.0, 200.0, (0.0,) * 4)
    flat = undistortion(wide, 100.0).camera
    points = torch.tensor([[0.3, 0.1, 2.0], [0.5, 0.2, -0.3]], dtype=torch.float64)
    pixels, seen = wide.project(points)
    assert seen.all()
    tracks = Tracks(
        points.numpy(), np.zeros((2, 3), np.uint8), np.zeros(2, np.int64), np.arange(2), pixels.float().numpy()
    )
    ahead = flat.project(points[:1])[0][0].tolist()
    direction = points[1] / points[1].norm()
    mirrored = [flat.fx * direction[0].item() + flat.cx, flat.fy * direction[1].item() + flat.cy]
    keypoints = np.array([ahead, mirrored], np.float32)
    features = Features(keypoints, unit_rows(2, 8), np.ones(2, np.float32), (400, 400))
    lift = _lift(tracks, MapSettings())
    positions, valid = lift(0, Photo(Path("a.png"), wide, Rigid.identity()), flat, features)
    assert valid.tolist() == [True, False]
    np.testing.assert_allclose(positions[0], points[0], atol=1e-6)


# Retrieval


def test_vlad_is_the_sum_of_residuals():
    vocabulary = np.eye(3, 8, dtype=np.float32)
    descriptors = unit_rows(40, 8)
    nearest = np.argmin(((descriptors[:, None] - vocabulary) ** 2).sum(-1), 1)
    expected = np.zeros((3, 8))
    for word, row in zip(nearest, descriptors):
        expected[word] += row - vocabulary[word]
    expected /= 3**0.5 * np.linalg.norm(expected, axis=1, keepdims=True)  # the same length for each word
    np.testing.assert_allclose(Vlad(vocabulary).aggregate(descriptors), expected.ravel(), atol=1e-6)
    assert not Vlad(vocabulary).aggregate(np.zeros((0, 8), np.float32)).any()


def test_the_vocabulary_finds_planted_clusters():
    centers = 5 * unit_rows(6, 8)
    samples = np.repeat(centers, 50, 0) + 0.05 * unit_rows(300, 8, 1)
    found = Vlad.trained(samples, 6).vocabulary
    distance = np.linalg.norm(found[:, None] - centers, axis=-1)
    assert sorted(distance.argmin(1)) == list(range(6))
    assert distance.min(1).max() < 0.05
    np.testing.assert_array_equal(found, Vlad.trained(samples, 6).vocabulary)
    with pytest.raises(WearcapError, match="3 descriptors for a vocabulary of 6 words"):
        Vlad.trained(samples[:3], 6)


def test_most_similar_sorts_by_cosine():
    database = unit_rows(50, 16)
    query = database[7] + 0.01 * database[3]
    best = most_similar(query, database, 5)
    assert best.tolist() == np.argsort(-(database @ query))[:5].tolist()
    assert best[0] == 7
    assert len(most_similar(query, database[:3], 40)) == 3


# Landmarks and matches


def test_descriptors_survive_their_bytes():
    rows = np.sqrt(np.abs(unit_rows(50, 128)) / np.abs(unit_rows(50, 128)).sum(1, keepdims=True))
    assert (from_bytes(to_bytes(rows)) * rows).sum(1).min() > 0.999


def test_observations_of_one_place_become_one_landmark():
    looks = unit_rows(3, 32)
    places = np.array([[0.005, 0.005, 0.005], [1.005, 0.005, 0.005]], np.float32)
    which = [(0, 0), (0, 0), (0, 1), (1, 0), (0, 1), (1, 2)]
    positions = np.stack([places[place] for place, _ in which]) + 0.002 * unit_rows(6, 3, 4)
    descriptors = to_bytes(np.stack([looks[look] for _, look in which]))
    landmarks, landmark = merge(positions, descriptors, 0.02)
    assert len(landmarks.points_world) == 4
    assert landmark[0] == landmark[1] != landmark[2] == landmark[4]
    np.testing.assert_allclose(landmarks.points_world[landmark[0]], positions[:2].mean(0), atol=1e-6)
    assert (from_bytes(landmarks.descriptors)[landmark] * from_bytes(descriptors)).sum(1).min() > 0.99
    exact, by_track = merge(places[[0, 1, 0]], descriptors[:3], 0.0)
    assert by_track.tolist() == [0, 1, 0]
    assert len(exact.points_world) == 2


def test_matches_are_mutual_and_pass_the_ratio_test():
    descriptors = unit_rows(3000, 32)
    positions = np.random.default_rng(1).normal(size=(3000, 3)).astype(np.float32)
    chosen = np.random.default_rng(2).permutation(3000)[:200]
    query = descriptors[chosen] + 0.15 * unit_rows(200, 32, 3)
    query /= np.linalg.norm(query, axis=1, keepdims=True)
    found = match_landmarks(query, descriptors, positions, tile=700)
    assert len(found) > 180
    np.testing.assert_array_equal(found[:, 1], chosen[found[:, 0]])
    similarity = query @ descriptors.T
    order = np.sort(np.sqrt(2 - 2 * np.clip(similarity, -1, 1)), axis=1)
    assert (order[found[:, 0], 0] < 0.85 * order[found[:, 0], 1]).all()
    assert not len(match_landmarks(query[:0], descriptors, positions))


def test_a_double_at_the_same_place_does_not_spoil_the_ratio_test():
    base = unit_rows(40, 32)
    near = base + 0.02 * unit_rows(40, 32, 1)
    descriptors = np.concatenate([base, near / np.linalg.norm(near, axis=1, keepdims=True)])
    places = np.random.default_rng(1).normal(size=(40, 3)).astype(np.float32)
    together = np.concatenate([places, places + np.float32(0.01)])
    apart = np.concatenate([places, places + np.float32(5.0)])
    query = base + 0.05 * unit_rows(40, 32, 2)
    query /= np.linalg.norm(query, axis=1, keepdims=True)
    assert len(match_landmarks(query, descriptors, together)) == 40
    assert len(match_landmarks(query, descriptors, apart)) < 10


def test_nearby_pairs_are_one_to_one_and_alike():
    descriptors = unit_rows(20, 32)
    near = np.array([[0, 0], [0, 1], [1, 1], [2, 5], [3, 1]])
    found = match_nearby(descriptors, descriptors, near, 0.75)
    assert found.tolist() == [[0, 0], [1, 1]]
    assert not len(match_nearby(descriptors, descriptors, near[:0], 0.75))


# Absolute pose


def planted(camera: Camera, noise_px: float, outliers: float, seed: int, count: int = 300):
    random = np.random.default_rng(seed)
    pose = Rigid(rotation.exp(torch.from_numpy(random.normal(size=3))), torch.from_numpy(random.normal(size=3)))
    pixels = random.uniform([0, 0], [camera.width - 1, camera.height - 1], (count, 2))
    rays = camera.unproject(torch.from_numpy(pixels))
    points = (pose @ (rays * torch.from_numpy(random.uniform(2, 8, (count, 1))))).numpy()
    seen = pixels + noise_px * random.normal(size=pixels.shape)
    wrong = random.random(count) < outliers
    seen[wrong] = random.uniform([0, 0], [camera.width, camera.height], (int(wrong.sum()), 2))
    return pose, seen.astype(np.float32), points.astype(np.float32), wrong


def pose_error(fit: Fit, pose: Rigid) -> np.ndarray:
    """Rotation vector (rad) and shift (m) of the true pose from the found one, in the world."""
    turn = rotation.log(pose.R @ torch.from_numpy(fit.R_world_cam).T).numpy()
    return np.concatenate([turn, pose.t.numpy() - fit.t_world_cam])


PINHOLE = Camera("pinhole", 960, 540, 600.0, 610.0, 470.0, 260.0)
LENSES = [
    PINHOLE,
    Camera("opencv", 960, 540, 600.0, 610.0, 470.0, 260.0, (-0.2, 0.05, 0.003, -0.002)),
    Camera("opencv", 960, 540, 600.0, 610.0, 470.0, 260.0, (-0.2, 0.05, 0.003, -0.002, 0.01)),
]


@pytest.mark.parametrize("camera", LENSES, ids=lambda camera: f"{camera.model}{len(camera.distortion)}")
@pytest.mark.parametrize("outliers", [0.0, 0.7])
def test_planted_poses(camera, outliers):
    for seed in range(3):
        pose, pixels, points, wrong = planted(camera, 0.0, outliers, seed)
        matches = Matches(pixels, points, camera)
        start = matches.ransac(4.0)
        assert start is not None
        fit = matches.refined(start, 4.0)
        assert np.abs(pose_error(fit, pose)).max() < 1e-5
        assert fit.inlier[~wrong].all()
        assert fit.inlier[wrong].mean() < 0.05 if outliers else True


def test_the_covariance_is_that_of_many_draws():
    errors, covariances = [], []
    for seed in range(60):
        pose, pixels, points, _ = planted(LENSES[1], 1.0, 0.0, seed, 60)
        matches = Matches(pixels, points, LENSES[1])
        start = matches.ransac(6.0)
        assert start is not None
        fit = matches.refined(start, 20.0)
        errors.append(pose_error(fit, pose))
        covariances.append(matches.covariance(fit))
    square = [error @ np.linalg.solve(cov, error) for error, cov in zip(errors, covariances)]
    assert np.mean(square) / 6 == pytest.approx(1.0, abs=0.35)  # 60 draws: standard deviation 0.075, robust loss more


def test_few_matches_and_other_lenses():
    none = np.zeros((4, 2), np.float32), np.zeros((4, 3), np.float32)
    assert Matches(none[0][:3], none[1][:3], PINHOLE).ransac(4.0) is None
    with pytest.raises(WearcapError, match="camera model 'fisheye'"):
        Matches(*none, FISHEYE).ransac(4.0)


def test_confidence_rises_with_spread_matches_only():
    random = np.random.default_rng(0)
    spread = random.uniform([0, 0], [CAMERA.width, CAMERA.height], (200, 2)).astype(np.float32)
    values = [confidence(spread[:count], CAMERA) for count in (0, 6, 12, 30, 200)]
    assert values == sorted(values)
    assert values[0] == 0
    assert values[-1] > 0.99
    assert confidence(np.tile(spread[:1], (200, 1)), CAMERA) == 0


def test_features_are_chosen_by_mask_and_by_number():
    features = Features(
        spread := np.arange(8, dtype=np.float32).reshape(4, 2), unit_rows(4, 3), np.ones(4, np.float32), (9, 9)
    )
    assert features.subset(np.array([3, 0])).keypoints.tolist() == spread[[3, 0]].tolist()
    assert len(features.subset(np.array([True, False, False, True]))) == 2


@pytest.mark.parametrize("distortion", [None, (-0.25, 0.08, 1e-3, -2e-3), (-0.25, 0.08, 1e-3, -2e-3, 0.01)])
def test_a_fit_projects_as_its_camera_does(distortion):
    camera = Camera.pinhole(640, 480, 70.0) if distortion is None else Camera("opencv", 640, 480, 400.0, 410.0, 310.0, 250.0, distortion)  # fmt: skip
    random = np.random.default_rng(2)
    R = rotation.exp(torch.tensor([0.3, -1.0, 0.4]).double()).numpy()
    fit = Fit(R, np.array([1.0, 2.0, 3.0]), np.ones(500, bool))
    points = random.normal(0, 4, (500, 3))
    pixels, valid = fit.project(points, camera)
    expected, seen = camera.project(torch.from_numpy((points - fit.t_world_cam) @ R))
    assert 30 < seen.sum() < 470
    np.testing.assert_array_equal(valid, seen.numpy())
    np.testing.assert_allclose(pixels[valid], expected[seen].numpy(), atol=1e-6)


def test_the_covariance_of_a_pose_is_that_of_least_squares():
    """Against derivatives by differences."""
    camera = Camera("opencv", 640, 480, 400.0, 410.0, 310.0, 250.0, (-0.2, 0.05, 1e-3, -2e-3))
    random = np.random.default_rng(3)
    R, t = rotation.exp(torch.tensor([0.3, -1.0, 0.4]).double()), torch.tensor([1.0, 2.0, 3.0]).double()
    rays = np.concatenate([random.uniform(-0.4, 0.4, (60, 2)), np.ones((60, 1))], 1) * random.uniform(2, 6, (60, 1))
    points = (rays @ R.numpy().T + t.numpy()).astype(np.float32)
    everything = np.ones(60, bool)

    def pixels(change: np.ndarray) -> np.ndarray:
        turned = rotation.exp(torch.from_numpy(change[:3])) @ R
        return Fit(turned.numpy(), t.numpy() + change[3:], everything).project(points, camera)[0].ravel()

    steps = 1e-6 * np.eye(6)
    jacobian = np.stack([(pixels(step) - pixels(-step)) / 2e-6 for step in steps], 1)
    seen = (pixels(np.zeros(6)).reshape(-1, 2) + random.normal(0, 1.5, (60, 2))).astype(np.float32)
    residual = seen.ravel() - pixels(np.zeros(6))
    expected = (residual**2).sum() / (120 - 6) * np.linalg.inv(jacobian.T @ jacobian)
    found = Matches(seen, points, camera).covariance(Fit(R.numpy(), t.numpy(), everything))
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-12)
