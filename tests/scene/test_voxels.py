"""Voxel grids: the fast form against a plain one, growing against whole, mirrors, and hostile points."""

import math
import time

import pytest
import torch

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.scene.voxels import VoxelGrid, VoxelMap, mirrored, voxelize

FLIP = torch.tensor([1.0, -1.0, 1.0])


def room(count: int, seed: int = 0) -> torch.Tensor:
    """Points in 5 x 4 x 2.5 m, a quarter of them on the floor."""
    points = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed)) * torch.tensor([5.0, 4.0, 2.5])
    points[::4, 2] *= 0.01
    return points - torch.tensor([2.5, 2.0, 0.0])


def walk(frames: int, seed: int = 1) -> Rigid:
    """Devices at head height, turned about all axes."""
    random = torch.Generator().manual_seed(seed)
    turn = rotation.exp(0.5 * torch.randn(frames, 3, generator=random))
    R = rotation.about_axis("z", 6.3 * torch.rand(frames, generator=random)) @ turn
    t = (torch.rand(frames, 3, generator=random) - 0.5) * torch.tensor([5.0, 4.0, 0.4])
    return Rigid(R, t + torch.tensor([0.0, 0.0, 1.5]))


def plainly(points, pose: Rigid, grid: VoxelGrid, seen=None, now=None) -> torch.Tensor:
    """One frame after another: distance from every cell's centre to every point in the box."""
    along = (torch.arange(grid.cells, dtype=torch.float64) + 0.5) * grid.cell_m - 0.5 * grid.size_m
    centers = torch.stack(torch.meshgrid(along, along, along, indexing="ij"), -1)
    result = []
    for frame in range(len(pose.t)):
        yaw = rotation.about_axis("z", rotation.yaw_of(pose.R[frame].double()))
        box = (points.double() - pose.t[frame].double()) @ yaw + torch.tensor([0.0, 0.0, grid.below_m])
        inside = (box.abs() <= 0.5 * grid.size_m).all(-1)
        inside &= torch.ones_like(inside) if seen is None else seen <= now[frame]
        distance = torch.cdist(centers.reshape(-1, 3), box[inside]) if inside.any() else torch.ones(len(along) ** 3, 1)
        result.append(distance.amin(1).clamp_max(grid.clip_m).reshape(centers.shape[:3]))
    return torch.stack(result).float()


@pytest.mark.parametrize(
    "grid", [VoxelGrid(), VoxelGrid(cells=7, size_m=1.4, below_m=0.6, clip_m=0.08), VoxelGrid(cells=1)]
)
def test_equals_the_plain_form(grid):
    points, pose = room(6000), walk(25)
    fast, plain = voxelize(points, pose, grid), plainly(points, pose, grid)
    torch.testing.assert_close(fast, plain, atol=2e-6, rtol=0)
    assert 0.05 < (plain < grid.clip_m).float().mean() < 1


def test_points_count_from_when_they_were_seen():
    points, pose, now = room(6000), walk(25), torch.linspace(0, 10, 25, dtype=torch.float64)
    seen = torch.rand(6000, generator=torch.Generator().manual_seed(3), dtype=torch.float64) * 12
    seen[:100] = now[3]  # at the very moment
    fast = voxelize(points, pose, first_seen=seen, timestamps=now)
    torch.testing.assert_close(fast, plainly(points, pose, VoxelGrid(), seen, now), atol=2e-6, rtol=0)
    assert (fast[-1] < voxelize(points, pose)[-1] + 1).all()
    torch.testing.assert_close(voxelize(points, pose, timestamps=now), voxelize(points, pose))


def test_growing_equals_whole():
    points, pose, now = room(20000), walk(40), torch.arange(40, dtype=torch.float64)
    seen = torch.arange(20000, dtype=torch.float64) // 500
    whole, growing = voxelize(points, pose, first_seen=seen, timestamps=now), VoxelMap()
    for frame in range(40):
        growing.add(points[500 * frame : 500 * (frame + 1)])
        assert torch.equal(growing.voxelize(pose[frame : frame + 1])[0], whole[frame])
    assert len(growing) == 20000
    assert torch.equal(growing.voxelize(pose), voxelize(points, pose))


def test_a_wall_ahead_stands_ahead_and_the_hand_side_is_left():
    ahead = torch.tensor([[0.9, 0.0, 0.5]])  # in the box: x 0.9 ahead, z half a metre below the centre
    left = torch.tensor([[0.0, 0.9, 0.5]])
    pose = Rigid(rotation.about_axis("y", torch.tensor([0.4])), torch.tensor([[0.0, 0.0, 2.0]]))
    assert (voxelize(ahead, pose)[0] < 0.1).sum() == 0  # on the border of four cells
    cell = (voxelize(ahead + torch.tensor([0.0, 0.05, 0.05]), pose)[0] < 0.1).nonzero()
    assert cell.tolist() == [[9, 5, 2]]
    cell = (voxelize(left + torch.tensor([0.05, 0.0, 0.05]), pose)[0] < 0.1).nonzero()
    assert cell.tolist() == [[5, 9, 2]]
    turned = Rigid(rotation.about_axis("z", torch.tensor([math.pi / 2])), pose.t)
    cell = (voxelize(left + torch.tensor([-0.05, 0.0, 0.05]), turned)[0] < 0.1).nonzero()
    assert cell.tolist() == [[9, 5, 2]]


def test_mirror():
    points, pose = room(5000), walk(20)
    flipped = Rigid(pose.R * torch.outer(FLIP, FLIP), pose.t * FLIP)
    torch.testing.assert_close(voxelize(points * FLIP, flipped), mirrored(voxelize(points, pose)), atol=1e-6, rtol=0)


def test_moving_the_world_changes_nothing():
    points, pose = room(5000), walk(20)
    turn, shift = rotation.about_axis("z", torch.tensor(2.0)), torch.tensor([64.0, -32.0, 8.0])
    moved = Rigid(turn @ pose.R, pose.t @ turn.T + shift)
    torch.testing.assert_close(voxelize(points @ turn.T + shift, moved), voxelize(points, pose), atol=1e-4, rtol=0)


def test_hostile_points():
    pose, empty = walk(10), torch.full((10, 10, 10, 10), 0.1)
    assert torch.equal(voxelize(torch.zeros(0, 3), pose), empty)
    points = room(3000)
    wild = points.clone()
    wild[::3] = torch.tensor([[math.nan, 0, 0], [math.inf, 1, 1], [1e7, -1e7, 1e7], [3e38, 3e38, -3e38]]).repeat(250, 1)
    everything = VoxelMap()
    everything.add(wild)
    assert len(everything) == 2500
    kept = torch.ones(3000, dtype=torch.bool)
    kept[::3] = False
    assert torch.equal(everything.voxelize(pose), voxelize(points[kept], pose))
    one = voxelize(torch.tensor([[0.0, 0.0, 1.0]]), Rigid(torch.eye(3)[None], torch.tensor([[0.03, 0.0, 2.02]])))
    assert one.shape == (1, 10, 10, 10)
    never = torch.full((3000,), math.nan, dtype=torch.float64)
    assert torch.equal(voxelize(points, pose, first_seen=never), empty)


def test_hostile_poses():
    points, pose = room(3000), walk(8)
    t, R = pose.t.clone(), pose.R.clone()
    t[1, 0], t[2], R[3], t[4] = math.nan, math.inf, math.nan, 3e38
    t[5] = torch.tensor([1e7, -1e7, 3.0])
    grids = voxelize(points, Rigid(R, t))
    assert (grids[1:6] == torch.tensor(0.1)).all()
    assert torch.equal(grids[[0, 6, 7]], voxelize(points, pose[torch.tensor([0, 6, 7])]))
    assert voxelize(points, pose[:0]).shape == (0, 10, 10, 10)


def test_far_from_the_origin():
    points, pose = room(3000), walk(8)
    shift = torch.tensor([65536.0, -65536.0, 0.0])
    there = Rigid(pose.R, pose.t + shift)
    torch.testing.assert_close(
        voxelize(points + shift, there), plainly(points + shift, there, VoxelGrid()), atol=2e-6, rtol=0
    )


def test_a_grid_whose_cells_overlap_is_refused():
    with pytest.raises(WearcapError, match="half a cell"):
        VoxelGrid(clip_m=0.15)
    with pytest.raises(WearcapError, match="0 cells"):
        VoxelGrid(cells=0)


def test_adding_stays_cheap_as_the_map_grows():
    growing, points = VoxelMap(), room(400_000)
    pose, spent = walk(1), []
    growing.add(points[:10])
    growing.voxelize(pose)
    for start in range(0, 400_000, 200):
        begin = time.thread_time()
        growing.add(points[start : start + 200])
        spent.append(time.thread_time() - begin)
    late = sorted(spent[-500:])[250]
    assert late < 1e-3  # 200 points at a time, a frame lasting 16 ms
