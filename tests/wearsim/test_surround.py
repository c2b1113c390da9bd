"""Surroundings for captured motion: nothing meets the body, something is near, seats and steps where they are needed."""

from functools import cache

import numpy as np
import pytest

import captured_motion as captured
from data_prep.shared.mocap import About, CleaningLimits, MocapSettings, mocap_recording
from wearcap.geometry.triangle_distance import TriangleIndex
from wearcap.io.formats.asf_amc import read_amc, read_asf
from wearsim.people.body_space import LIMBS, BodySpace, limb_ends
from wearsim.places.outline import points_in_convex
from wearsim.places.surround import MARGIN_M, NEAR_M, PELVIS_OVER_SEAT_M, find_sits, find_treads, surround

SEEDS = range(2)


MOTIONS = {
    "walk": captured.walk(3.0),
    "run": captured.walk(5.0, 4.0),
    "jump": captured.jump(),
    "sit": captured.sit(0.5),
    "perch": captured.sit(0.8),
    "step": captured.climb(0.15),
    "climb": captured.climb(0.7),
}


@cache
def made(name: str, seed: int):
    return surround(MOTIONS[name], np.random.default_rng(seed), "somewhere")


def distance_to(world, motion, touching: tuple[str, ...] = ()) -> float:
    """Least distance (m) of limbs' surfaces from all that stands on the floor, leaving out parts that may touch it."""
    corners = world.mesh.vertices[world.mesh.faces]
    standing = world.mesh.faces[corners[..., 2].max(1) > 0.025]
    index = TriangleIndex.build(world.mesh.vertices.astype(np.float64), standing.astype(np.int64))
    least = np.inf
    for (_, _, radius, _, part), (start, end) in zip(LIMBS, limb_ends(motion)):
        if part not in touching:
            share = np.linspace(0.0, 1.0, 9)[:, None, None]
            points = (start + share * (end - start)).reshape(-1, 3)[::2]
            least = min(least, float(index.nearest(np.ascontiguousarray(points))[0].min()) - radius)
    return least


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", ["walk", "run", "jump"])
def test_nothing_meets_the_body_yet_something_is_near(name, seed):
    world, motion = made(name, seed), MOTIONS[name]
    distance = distance_to(world, motion)
    assert distance > MARGIN_M - 0.005
    assert distance < NEAR_M[1] + 0.15
    assert len({item.kind for item in world.objects}) > 4


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", ["sit", "perch"])
def test_who_sits_has_a_seat(name, seed):
    world, motion = made(name, seed), MOTIONS[name]
    if name == "perch":  # feet hang
        assert motion.joint("left_ankle").t[-1, 2] > 0.2
    pelvis = motion.t_world_root[-1].double().numpy()
    below = [item for item in world.objects if points_in_convex(pelvis[None, :2], item.footprint)[0]]
    assert len(below) == 1
    faces = world.mesh.vertices[world.mesh.faces[world.face_object == world.objects.index(below[0])]]
    near = np.abs(faces.mean(1)[:, :2] - pelvis[:2]).max(1) < 0.25
    tops = faces[near][:, :, 2].max(1)
    assert np.abs(tops - (pelvis[2] - PELVIS_OVER_SEAT_M)).min() < 0.02
    assert distance_to(world, motion, ("seat", "hand", "foot", "shin")) > 0.0


@pytest.mark.parametrize(("name", "height"), [("step", 0.15), ("climb", 0.7)])
def test_who_climbs_has_a_step(name, height):
    world, motion = made(name, 0), MOTIONS[name]
    foot = motion.joint("left_ankle").t[-1].double().numpy()
    floor = world.floor_height(foot[None, :2], np.array([height]))
    assert abs(floor[0] - height) < 0.04
    start = motion.joint("left_ankle").t[0].double().numpy()
    assert world.floor_height(start[None, :2], np.array([0.0]))[0] == 0.0
    assert distance_to(world, motion, ("foot", "shin", "hand")) > 0.0


@pytest.mark.parametrize("motion", [MOTIONS["walk"], MOTIONS["jump"]])
def test_who_stands_on_the_floor_needs_nothing(motion):
    assert find_sits(motion) == []
    assert find_treads(motion, []) == []


def test_squatting_is_not_sitting():
    assert find_sits(captured.squat()) == []
    assert find_sits(captured.sit()) != []


def test_same_seed_same_world():
    first, other = made("walk", 1), made("walk", 0)
    again = surround(MOTIONS["walk"], np.random.default_rng(1), "somewhere")
    assert np.array_equal(first.mesh.vertices, again.mesh.vertices)
    assert not np.array_equal(first.mesh.vertices[:8], other.mesh.vertices[:8])


def test_runs_are_mostly_outdoors_and_walks_mostly_in():
    outside = {name: [made(name, seed).outdoors for seed in range(4)] for name in ("run", "walk")}
    assert sum(outside["run"]) > 2 > sum(outside["walk"])


def test_a_box_meets_the_body_where_it_is():
    body = BodySpace.of(captured.walk(2.0))
    here, far = np.array([0.0, 0.0, 1.0]), np.array([0.0, 3.0, 1.0])
    size = np.array([0.2, 0.2, 0.2])
    assert body.meets(here, size, 0.3, 0.0)
    assert not body.meets(far, size, 0.3, 0.0)
    assert body.meets(far, size, 0.3, 2.8)
    assert not body.meets(np.array([0.0, 0.0, 0.02]), size / 10, 0.0, 0.0, {"foot": 0.1})


@pytest.mark.real
def test_a_real_sitter_and_a_real_climber(real_data):
    folder = real_data / "cmu_mocap" / "trials" / "014"
    settings = MocapSettings(60, [0.09, 0.0, 0.09], CleaningLimits(8.0, 15.0, 0.5, 0.06, 0.12))
    skeleton = read_asf(next(folder.glob("14.asf*")))
    sitter, climber = (
        mocap_recording(
            read_amc(skeleton, folder / f"{name}.amc.xz", 120), About(name, "14", "cmu", ""), settings
        ).motion
        for name in ("14_31", "14_22")
    )
    assert len(find_sits(sitter)) == 1
    assert [round(tread.z, 1) for tread in find_treads(climber, find_sits(climber))] == [0.2, 0.4, 0.6]
    world = surround(sitter, np.random.default_rng(0), "somewhere")
    assert distance_to(world, sitter, ("seat", "hand", "foot", "shin")) > 0.0
    assert any(item.kind in ("stool", "chair", "bench") for item in world.objects)
