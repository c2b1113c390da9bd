"""What head camera and depth cameras see of simulated interactions: hands, objects, and distances to them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from wearcap.errors import WearcapError
from wearcap.geometry.rotation import about_axis
from wearcap.recording import Recording
from wearcap_testing import benchmark
from wearsim.recordings.interaction_session import InteractionConfig, simulate_interactions

seen_flat, detecting, rgb, rig = map(benchmark, ("seen_flat", "simulated_detections", "rgb_objects", "interaction_rig"))
PERFECT = detecting.Detector(found=1.0, side=1.0, state=1.0, apart=1.0, false_hands=0.0, whole=0.01)
EVERY = 15


@pytest.fixture(scope="module")
def recording() -> Recording:
    """Half a minute, filmed by a camera that looks down at the hands."""
    found = simulate_interactions(InteractionConfig(minutes=0.5), "session", "val", 3)[0]
    assert found.camera is not None
    down = about_axis("y", torch.tensor(np.deg2rad(40.0)).float())
    return replace(found, camera=replace(found.camera, R_head_cam=down @ found.camera.R_head_cam))


@pytest.fixture(scope="module")
def seen(recording):
    found = seen_flat.SeenFlat.of(recording)
    assert found is not None
    return found


@pytest.fixture(scope="module")
def hands(seen):
    return detecting.seen_hands(seen, EVERY)


@pytest.fixture(scope="module")
def touching(recording):
    return recording.interactions.hand_contact(recording.camera.timestamps[::EVERY].contiguous()).numpy()


def test_a_flat_that_is_not_the_recordings_is_not_taken_for_it(recording):
    name, track = next(iter(recording.object_motion.items()))
    moved = replace(track, t_world_body=track.t_world_body + 0.1)
    assert seen_flat.SeenFlat.of(replace(recording, object_motion=recording.object_motion | {name: moved})) is None
    assert seen_flat.SeenFlat.of(replace(recording, location="MPI_EG")) is None


def test_hands_are_seen_in_the_picture_and_mostly_while_they_are_at_work(hands, touching):
    inside = hands.share > 0
    assert 0.01 < inside.mean() < 0.6
    assert inside[touching].mean() > inside[~touching].mean()
    boxes = hands.box[inside]
    assert (boxes[:, :2] <= boxes[:, 2:]).all()
    assert (boxes >= -0.5).all()
    assert (boxes < [960, 540, 960, 540]).all()
    assert hands.object_box.any(-1)[inside & touching].mean() > 0.9, "what is touched is behind the hand"


def test_a_perfect_detector_knows_every_hand_in_sight_and_none_else(hands, touching):
    size, rng = (960, 540), np.random.default_rng(0)
    frames = detecting.detections(hands, touching, PERFECT, rng, EVERY, size)
    found = np.full((len(frames), 2), -1)
    for k, frame in enumerate(frames):
        assert frame["frame"] == EVERY * k
        for row in frame["hand_dets"] or ():
            found[k, int(row[-1])] = row[5] > 0
    whole = hands.share >= PERFECT.whole
    assert ((found >= 0) <= (hands.share > 0)).all()
    assert (found[whole] == touching[whole]).all()


def test_a_real_detector_misses_and_mistakes_as_often_as_published(hands, touching):
    count = 40_000
    many = detecting.SeenHands(np.ones((count, 2)), np.ones((count, 2, 4)), np.ones((count, 2, 4)))
    contact = np.zeros((count, 2), bool)
    frames = detecting.detections(many, contact, detecting.HOD, np.random.default_rng(0), 1, (960, 540))
    rows = np.array([row for frame in frames for row in frame["hand_dets"] or ()])
    assert len(rows) / (2 * count) == pytest.approx(0.905 + 0.01, abs=0.01)
    assert (rows[:, 5] > 0).mean() == pytest.approx(1 - 0.75 / 0.90, abs=0.015)


def test_an_object_is_found_by_its_own_keypoints(seen):
    """From where a photo was taken, the object's pose in the camera comes out; without its keypoints none does."""
    item = next(item for item in seen.flat.environment.objects if item.category in ("sofa", "armchair", "table"))
    landmarks = rgb._photographed(seen, item.name, np.random.default_rng(0))
    middle = item.box_world.mean(0)
    T_world_cam = rgb.look_at(middle + np.array([1.3, 0.4, 1.1]), middle)
    scenery = rgb.Scenery.of(seen.flat.world)
    image = rgb.render_view(scenery, rgb.PHOTO_CAMERA, T_world_cam)
    picture = rgb._Picture.of(image, scenery, rgb.PHOTO_CAMERA, T_world_cam)
    apart, _ = seen.flat.environment.distance(item.name, torch.from_numpy(picture.points), item.T_world_object)
    inside = apart.numpy() < rgb.MASK_M
    T = rgb._pose(picture.features.subset(inside), landmarks, rgb.PHOTO_CAMERA)
    assert T is not None
    assert ((T_world_cam @ T).t - item.t_world_object).norm() < 0.05
    assert rgb._pose(picture.features.subset(~inside & (apart.numpy() > 0.3)), landmarks, rgb.PHOTO_CAMERA) is None


def test_tripods_stand_apart_where_there_is_floor(seen):
    spots = seen.flat.world.sample_floor(np.random.default_rng(0), 12)
    placed = []
    for spot in spots:
        try:
            placed.append((spot, rig.place_tripods(seen.flat.world, spot)))
        except WearcapError:
            continue
    assert placed
    for spot, poses in placed:
        offset = poses.t[:, :2].numpy() - spot[:2]
        assert (np.linalg.norm(offset, axis=1) <= rig.REACH_M[1] + 1e-6).all()
        angles = np.arctan2(*offset.T[::-1])
        assert rig._least_angle(angles) >= np.deg2rad(rig.APART_DEG) - 1e-6
        assert (seen.flat.world.navigation.clearance_at(poses.t.numpy()) > rig.CLEAR_M - 0.1).all()


def test_distances_to_a_measured_cloud_grow_with_the_error(seen, recording):
    name = recording.interactions.objects[0]
    times = recording.interactions.start_s[:1].contiguous()
    surface = rig.surface_points(seen.flat.environment.by_name(name).mesh)
    pose = seen.poses(times)[name]
    cloud = np.concatenate([(pose[0] @ surface).numpy(), seen.wearer(times)[1][0]])
    looks = rig.RigLooks(name, times, (cloud,))
    truth = replace(recording.motion, object_motion=recording.object_motion)
    exact = rig.rig_distances(looks, truth, seen)
    assert max(exact.values()) < 0.1
    off = replace(truth, t_world_root=truth.t_world_root + torch.tensor([0.0, 0.0, 0.2]), object_motion={})
    assert rig.rig_distances(looks, off, seen)["body_cm"] > 3
