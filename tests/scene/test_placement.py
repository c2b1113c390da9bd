"""Objects that were measured centimetres off are found where the scan shows them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from wearcap.geometry.mesh import Mesh
from wearcap.scene.objects import Environment, Freedom, SceneObject
from wearcap.scene.placement import placed_on_scan
from wearcap.scene.scan import Scan
from wearsim.recordings.measured import EnvironmentErrors, as_measured

CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float64)
SIDES = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
FACES = np.array([part for a, b, c, d in SIDES for part in ([a, b, c], [a, c, d])], dtype=np.int32)


def box(name: str, size: tuple[float, float, float], at: tuple[float, float, float], freedom: Freedom) -> SceneObject:
    vertices = ((CORNERS - 0.5) * size).astype(np.float32)
    mesh = Mesh(vertices, FACES, np.ones(3, np.float32))
    return SceneObject(name, "box", mesh, torch.eye(3), torch.tensor(at), freedom)


TABLE = box("table", (1.2, 0.8, 0.7), (0.0, 0.0, 0.35), Freedom("plane"))
DOOR = box("door", (0.9, 0.04, 2.0), (4.0, 1.0, 1.0), Freedom("hinge", pivot=(3.55, 1.0, 0.0)))
ROOM = Environment((TABLE, DOOR))


def scanned(*objects: SceneObject, noise_m: float = 0.004) -> Scan:
    """Points on the objects' faces and on the floor around them."""
    rng = np.random.default_rng(0)
    clouds = [np.column_stack([rng.uniform(-2, 6, (40_000, 2)), np.zeros(40_000)])]
    for item in objects:
        corners = item.points_world[item.mesh.faces]
        share = rng.dirichlet(np.ones(3), (len(corners), 1500))
        clouds.append(np.einsum("fnk,fki->fni", share, corners).reshape(-1, 3))
    points = np.concatenate(clouds)
    return Scan((points + noise_m * rng.standard_normal(points.shape)).astype(np.float32))


def off_m(found: SceneObject, true: SceneObject) -> float:
    return float(np.linalg.norm(found.points_world - true.points_world, axis=1).mean())


@pytest.mark.parametrize("seed", range(6))
def test_objects_measured_badly_are_found_in_the_scan(seed):
    measured = as_measured(ROOM, EnvironmentErrors(hinge_m=0.0), np.random.default_rng(seed))
    found = placed_on_scan(measured, scanned(TABLE, DOOR))
    for name in ("table", "door"):
        before, after = (off_m(room.by_name(name), ROOM.by_name(name)) for room in (measured, found))
        assert after < max(0.006, 0.4 * before)
    pivot, true = (np.array(room.by_name("door").freedom.pivot) for room in (found, ROOM))
    assert np.linalg.norm((pivot - true)[:2]) < 0.015, "a hinge moves with its object"


def test_what_the_scan_does_not_show_stays():
    found = placed_on_scan(ROOM, scanned(TABLE))
    assert off_m(found.by_name("door"), DOOR) < 1e-6
    chair = replace(TABLE, name="chair", t_world_object=torch.tensor([40.0, 0.0, 0.35]))
    assert placed_on_scan(Environment((chair,)), scanned(TABLE)).objects[0] is chair


def test_measured_environments_have_the_errors_that_are_asked_for():
    errors = EnvironmentErrors()
    measured = [as_measured(ROOM, errors, np.random.default_rng(seed)) for seed in range(200)]
    shift = np.stack([room.by_name("table").box_world.mean(0) - TABLE.box_world.mean(0) for room in measured])
    assert np.sqrt((shift[:, :2] ** 2).sum(1).mean()) == pytest.approx(errors.position_m, rel=0.15)
    angle = [np.rad2deg(torch.atan2(*room.by_name("table").R_world_object[[1, 0], 0])) for room in measured]
    assert np.std(angle) == pytest.approx(errors.angle_deg, rel=0.15)
    exact = as_measured(ROOM, EnvironmentErrors(0.0, 0.0, 0.0, 0.0), np.random.default_rng(0))
    assert off_m(exact.by_name("door"), DOOR) < 1e-6
