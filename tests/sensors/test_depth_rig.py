"""The rig's steps, each on a picture that shows what it must do; then all of them on a simulated recording."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from benchmarks.tables import depth_rig as rig
from benchmarks.tables import simulated_depth_rig as simulated
from wearcap.body.anny_body import anny_body
from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import xsens23
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.camera import Camera
from wearcap.geometry.mesh import Mesh
from wearcap.geometry.rigid import Rigid
from wearcap.metrics.surface import chamfer
from wearsim.places.builder import WorldBuilder

Background = rig.Background
DepthView = rig.DepthView
_unproject_depth = rig._unproject_depth
_visible_points = rig._visible_points
largest_cluster = rig.largest_cluster
person_cloud = rig.person_cloud

KINECT = simulated.KINECT
SimulatedRig = simulated.SimulatedRig
approximate = simulated.approximate
place_rig = simulated.place_rig
simulate_rig = simulated.simulate_rig

LENS = Camera("pinhole", 40, 30, 30.0, 30.0, 19.5, 14.5)


def test_the_background_is_the_mean_of_what_was_measured():
    frames = np.full((4, 3, 3), 2000, np.uint16)
    frames[:, 0, 0] = [1990, 2010, 0, 2000]
    frames[:, 1, 1] = [0, 0, 0, 1500]
    background = Background.of(frames)
    assert background.depth_m[0, 0] == pytest.approx(2.0)
    assert background.deviation_m[0, 0] == pytest.approx(0.01)
    assert np.isinf(background.depth_m[1, 1]), "seen in one frame of four"
    with pytest.raises(WearcapError, match="no frames of the empty scene"):
        Background.of(frames[:0])


def test_pixels_that_flicker_are_not_steady():
    frames = np.full((6, 12, 12), 2000, np.uint16)
    frames += np.random.default_rng(0).integers(0, 10, frames.shape).astype(np.uint16)
    frames[::2, 4, 4] = 2045
    frames[:, 8] = 0
    steady = Background.of(frames).steady
    assert not steady[4, 4], "now and then 4 cm further: its mean is neither place"
    assert not steady[8].any()
    assert steady.mean() > 0.85
    assert Background.of(frames[:1]).steady.mean() > 0.85, "a single frame shows no flicker"


def test_what_stands_before_the_background_is_kept_and_flying_pixels_are_not():
    background = Background(np.full((30, 40), 3.0, np.float32), np.full((30, 40), 0.002, np.float32))
    background.depth_m[:5] = np.inf
    image = np.full((30, 40), 2995, np.uint16)
    image[2:20, 10:20] = 2000
    image[22, 30] = 2500
    image[0, 0] = 0
    expected = np.zeros((30, 40), bool)
    expected[2:20, 10:20] = True
    mask = background.foreground(image)
    assert np.array_equal(mask[5:], expected[5:])
    assert mask[3, 12], "before an unmeasured background"
    assert not mask[0, 0]
    with pytest.raises(WearcapError, match="images of one camera"):
        background.foreground(image[:10])


def test_unprojection_puts_points_where_they_project_from():
    depth = np.random.default_rng(0).uniform(1, 3, (30, 40)).astype(np.float32)
    points = _unproject_depth(depth, np.ones((30, 40), bool), LENS)
    pixels, valid = LENS.project(torch.from_numpy(points))
    y, x = np.mgrid[:30, :40]
    assert valid.all()
    assert np.allclose(pixels.numpy(), np.stack([x, y], -1).reshape(-1, 2), atol=1e-4)
    assert np.allclose(points[:, 2], depth.ravel()), "depth lies along the axis, not along the ray"


def test_the_largest_cluster_is_the_heaviest_and_eps_bridges_gaps():
    random = np.random.default_rng(0)
    body = random.normal(scale=0.05, size=(3000, 3))
    hand = random.normal(scale=0.01, size=(300, 3)) + np.array([0.25, 0, 0])
    chair = random.uniform(0, 1, (1500, 3)) * [0.4, 0.4, 0.01] + [1.0, 1.0, 0.0]
    far = random.uniform(5, 9, (50, 3))
    kept = largest_cluster(np.concatenate([body, hand, chair, far]))
    assert kept[:2900].mean() > 0.99
    assert kept[3000:3300].all(), "9 cm from the rest: the same cluster"
    assert not kept[3300:].any()
    assert not largest_cluster(far).any(), "noise alone"
    assert len(largest_cluster(np.zeros((0, 3)))) == 0


def sampled(mesh: Mesh, spacing: float, rng: np.random.Generator) -> np.ndarray:
    """A laser scan: random points of the triangles with 2 mm of noise."""
    corners = mesh.vertices[mesh.faces].astype(float)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    chosen = np.repeat(corners, rng.poisson(area / spacing**2), axis=0)
    weight = rng.dirichlet(np.ones(3), len(chosen))
    points = (chosen * weight[..., None]).sum(1)
    return (points + 0.002 * rng.standard_normal(points.shape)).astype(np.float32)


@dataclass(frozen=True)
class Scene:
    rig: SimulatedRig
    scan: np.ndarray
    vertices: torch.Tensor
    faces: torch.Tensor
    rough: Rigid


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A furnished room of 6 x 5 m, someone standing in A-pose, three cameras at a quarter of a Kinect's pixels."""
    rng = np.random.default_rng(3)
    builder = WorldBuilder("room")
    builder.add_surface("floor", [[0, 0], [6, 0], [6, 5], [0, 5]], (0.6, 0.5, 0.4), thickness=0.05)
    for center, size in (
        ((3, -0.05, 1.2), (6, 0.1, 2.4)),
        ((3, 5.05, 1.2), (6, 0.1, 2.4)),
        ((-0.05, 2.5, 1.2), (0.1, 5, 2.4)),
        ((6.05, 2.5, 1.2), (0.1, 5, 2.4)),
        ((0.5, 0.4, 0.4), (0.9, 0.7, 0.8)),
        ((5.4, 4.3, 0.9), (0.8, 0.4, 1.8)),
        ((5.6, 1.0, 0.35), (0.6, 1.4, 0.7)),
    ):
        builder.add_block("block", center, size, (0.7, 0.7, 0.7))
    world = builder.finish(0.1)
    spot = np.array([2.8, 2.4, 0.0])
    skeleton = xsens23()
    body = anny_body(skeleton)
    R = torch.eye(3).repeat(len(skeleton), 1, 1)
    for side, sign in (("left", -1), ("right", 1)):
        R[skeleton.index(f"{side}_shoulder")] = rotation.about_axis("x", torch.tensor(sign * 0.9))
    root = torch.from_numpy(spot).float() + torch.tensor([0.0, 0.0, skeleton.root_height])
    vertices = body.vertices(forward_kinematics(skeleton, R, root))
    person = Mesh(vertices.numpy(), body.faces.numpy().astype(np.int32), np.ones(3, np.float32))
    camera = KINECT.scaled(320, 288)
    rig = simulate_rig([world.mesh], [person], place_rig(world, spot), rng, camera=camera, stills=8)
    return Scene(rig, sampled(world.mesh, 0.015, rng), vertices, body.faces, approximate(rig.T_world_cam, rng))


@pytest.fixture(scope="module")
def views(scene: Scene) -> list[DepthView]:
    """The cameras as ICP brings them back from 10 cm and 3° off."""
    found = []
    for number in range(3):
        rough = DepthView(scene.rig.camera, scene.rough[number], Background.of(scene.rig.empty_mm[number]))
        view, report = rough.registered(scene.scan)
        true = scene.rig.T_world_cam[number]
        assert (rough.T_world_cam.t - true.t).norm() == pytest.approx(0.1, rel=1e-4)
        assert (view.T_world_cam.t - true.t).norm() < 0.01
        assert rotation.geodesic(view.T_world_cam.R, true.R) < np.deg2rad(0.15)
        assert report.fitness > 0.95
        assert report.rmse_m < 0.01
        found.append(view)
    return found


def test_the_persons_cloud_lies_on_the_true_body_and_tells_a_shifted_one(scene: Scene, views: list[DepthView]):
    """The metric's floor: what a perfect capture scores."""
    cloud = torch.from_numpy(person_cloud(list(scene.rig.depth_mm[:, 0]), views))
    assert len(cloud) > 10_000
    floor = chamfer(scene.vertices, cloud, faces=scene.faces).mean_cm
    literal = chamfer(scene.vertices, cloud).mean_cm
    assert floor < literal < 1.5
    for shift_m, least_cm in ((0.05, 2.0), (0.1, 4.0)):
        moved = scene.vertices + torch.tensor([shift_m, 0.0, 0.0])
        assert least_cm < chamfer(moved, cloud, faces=scene.faces).mean_cm < 100 * shift_m


def test_a_hand_made_correction_saves_a_pose_that_icp_cannot_reach(scene: Scene, views: list[DepthView]):
    true = scene.rig.T_world_cam[0]
    away = Rigid(rotation.about_axis("z", torch.tensor(0.9).double()), torch.zeros(3).double())
    start = DepthView(scene.rig.camera, Rigid(away.R @ true.R, true.t), views[0].background)
    with pytest.raises(WearcapError, match="Check the camera's pose"):
        start.registered(scene.scan)
    by_hand = turned_about(away.inverse().R, true.t)
    mended, report = start.registered(scene.scan, Rigid(by_hand.R, by_hand.t + 0.05))
    assert (mended.T_world_cam.t - true.t).norm() < 0.01
    assert report.fitness > 0.95


def turned_about(R: torch.Tensor, center: torch.Tensor) -> Rigid:
    return Rigid(R, center - R @ center)


def test_walls_are_registered_from_the_side_that_is_seen(scene: Scene):
    """The outer faces of the walls, 10 cm behind the inner ones, are in the scan and out of sight."""
    kept = _visible_points(scene.scan, scene.rig.T_world_cam[0])
    outside = (scene.scan[:, :2] < -0.05).any(1) | (scene.scan[:, :2] > [6.05, 5.05]).any(1)
    assert outside.mean() > 0.2
    assert ((kept[:, :2] < -0.05).any(1) | (kept[:, :2] > [6.05, 5.05]).any(1)).mean() < 0.03
    assert len(kept) > 20_000


def test_with_unregistered_cameras_the_cloud_is_off(scene: Scene, views: list[DepthView]):
    rough = [DepthView(v.camera, scene.rough[i], v.background) for i, v in enumerate(views)]
    good, bad = (torch.from_numpy(person_cloud(list(scene.rig.depth_mm[:, 0]), rig)) for rig in (views, rough))
    assert chamfer(scene.vertices, bad).mean_cm > 2 * chamfer(scene.vertices, good).mean_cm


def test_an_empty_room_gives_no_cloud(scene: Scene, views: list[DepthView]):
    assert len(person_cloud(list(scene.rig.empty_mm[:, 0]), views)) < 50
    with pytest.raises(WearcapError, match="2 depth images for 3 cameras"):
        person_cloud(list(scene.rig.depth_mm[:2, 0]), views)


def test_voxels():
    points = torch.tensor([[0.01, 0, 0], [0.03, 0, 0], [-0.01, 0, 0], [5, 5, 5]])
    centres, voxel = rig.voxel_downsample(points, 0.05)
    assert len(centres) == 3
    assert voxel[0] == voxel[1]
    assert len({voxel[i].item() for i in (0, 2, 3)}) == 3
    assert torch.allclose(centres[voxel[0]], torch.tensor([0.02, 0, 0]))
    assert torch.allclose(centres[voxel[3]], points[3])
