"""ICP: planted poses come back, doubtful results say so, and two real laser scans meet."""

import numpy as np
import pytest
import torch

from benchmarks.tables import depth_rig as rig
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.io.formats.pcd import read_pcd

_register = rig._register


def room(points: int, seed: int) -> np.ndarray:
    """A floor, two walls and a box, with 3 mm of noise (m)."""
    random = np.random.default_rng(seed)
    u, v = random.uniform(0, 1, (2, points))
    zero = np.zeros(points)
    faces = [
        np.stack([4 * u, 3 * v, zero], 1),
        np.stack([4 * u, zero, 2.5 * v], 1),
        np.stack([zero, 3 * u, 2.5 * v], 1),
        np.stack([1.5 + u, 1 + v, zero + 0.7], 1),
        np.stack([1.5 + u, zero + 1, 0.7 * v], 1),
        np.stack([zero + 2.5, 1 + u, 0.7 * v], 1),
    ]
    return np.concatenate(faces) + 0.003 * random.normal(size=(6 * points, 3))


def turned(degrees: float, shift: float, seed: int) -> Rigid:
    random = torch.Generator().manual_seed(seed)
    axis, direction = torch.randn(2, 3, generator=random, dtype=torch.float64)
    return Rigid(rotation.exp(axis / axis.norm() * np.deg2rad(degrees)), direction / direction.norm() * shift)


POSE = Rigid(rotation.about_axis("z", torch.tensor(0.7, dtype=torch.float64)), torch.tensor([1.0, 1.5, 1.2]).double())


@pytest.fixture(scope="module")
def scene() -> np.ndarray:
    return room(25_000, 0)


@pytest.fixture(scope="module")
def cloud() -> np.ndarray:
    """The room as seen from `POSE`: other points of it, in the camera's axes."""
    return (POSE.inverse() @ torch.from_numpy(room(3_000, 1))).numpy()


@pytest.mark.parametrize(("degrees", "shift", "seed"), [(3, 0.1, 0), (3, 0.1, 1), (8, 0.3, 2), (8, 0.3, 3)])
def test_a_planted_pose_comes_back(scene: np.ndarray, cloud: np.ndarray, degrees: float, shift: float, seed: int):
    off = turned(degrees, shift, seed)
    result = _register(cloud, scene, Rigid(off.R @ POSE.R, POSE.t + off.t))
    assert (result.T_scene_cloud.t - POSE.t).norm() < 0.002
    assert rotation.geodesic(result.T_scene_cloud.R, POSE.R) < np.deg2rad(0.05)
    assert result.fitness > 0.95
    assert 0.001 < result.rmse_m < 0.006
    assert result.converged
    assert result.least_seen > 0.05
    assert "slide" not in result.summary


def test_a_bare_floor_may_slide_and_it_is_reported(scene: np.ndarray):
    floor = scene[(np.abs(scene[:, 2]) < 0.01) & (scene[:, :2] > 0.5).all(1) & (scene[:, :2] < [1.4, 2.5]).all(1)]
    result = _register(floor[::3], scene, Rigid.identity(dtype=torch.float64))
    assert result.least_seen < 0.01
    assert "slide" in result.summary


@pytest.mark.parametrize("broken", ["millimetres", "far away", "NaN", "empty"])
def test_what_does_not_overlap_is_refused(scene: np.ndarray, cloud: np.ndarray, broken: str):
    start = POSE
    if broken == "far away":
        start = Rigid(POSE.R, POSE.t + 50)
    elif broken == "millimetres":
        scene = 1000 * scene + 2000
    elif broken == "NaN":
        cloud = np.where(np.arange(len(cloud))[:, None] == 7, np.nan, cloud)
    else:
        cloud = cloud[:5]
    with pytest.raises(WearcapError):
        _register(cloud, scene, start)


@pytest.mark.real
def test_two_real_scans_of_a_room_meet(real_data):
    """From a robot's odometry, 0.7 m and 2° off; the way back and other starts end at the same place."""
    first, second = (read_pcd(real_data / f"pcl_room_scan/tutorials/room_scan{n}.pcd").points for n in (1, 2))
    odometry = Rigid(
        rotation.about_axis("z", torch.tensor(0.6931).double()), torch.tensor([1.79387, 0.720047, 0.0]).double()
    )
    there = _register(second, first, odometry)
    back = _register(first, second, odometry.inverse())
    loop = back.T_scene_cloud @ there.T_scene_cloud
    assert loop.t.norm() < 0.02
    assert rotation.geodesic(loop.R, torch.eye(3).double()) < np.deg2rad(0.5)
    assert there.fitness > 0.45, "the scans show different parts of the house, and thin out with distance"
    assert back.fitness > 0.55
    assert max(there.rmse_m, back.rmse_m) < 0.02
    off = turned(5.0, 0.2, 0)
    start = Rigid(off.R @ there.T_scene_cloud.R, there.T_scene_cloud.t + off.t)
    assert (_register(second, first, start).T_scene_cloud.t - there.T_scene_cloud.t).norm() < 0.005
