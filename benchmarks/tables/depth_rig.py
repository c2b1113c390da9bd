"""Three simulated depth cameras around a spot (thesis §4.5.1): the person's point cloud in the scene.

The thesis registers its Kinects to the scan by ICP, takes the background off and keeps the largest cluster. Here the
cameras' poses have the errors that are left of that, and the pixels of the person are those that the renderer says.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int64
from scipy import ndimage
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry.camera import Camera
from wearcap.geometry.mesh import Mesh
from wearcap.geometry.render import render
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import exp
from wearsim.places.world import World

KINECT = Camera("pinhole", 640, 576, 504.0, 504.0, 319.5, 287.5)
"""Azure Kinect's unbinned narrow mode: 65° x 59° of its 75° x 65°, whose rim the lens bends."""
NOISE_M, NOISE_PER_M, BIAS_M = 0.0015, 0.0015, 0.003
"""White noise of a depth (m), what it grows by with each metre, and the deviation of a camera's constant offset (the data
sheet allows 11 mm)."""
REGISTERED_M, REGISTERED_DEG = 0.004, 0.05
"""Errors of a pose that ICP to a scan leaves."""
_EDGE_M = 0.05
"""Pixels whose neighbours differ more in depth lie between two surfaces, and are left out."""
_CLEARANCE_M = 0.2
"""Least distance of a tripod from a wall or a piece of furniture."""
_TALLEST_M = 2.0
_NEAREST_M = 1.4
"""A camera nearer than this does not see a person from head to foot."""


def look_at(position: Float[np.ndarray, "*batch 3"], target: Float[np.ndarray, "*#batch 3"]) -> Rigid:
    """Poses of upright cameras (z forward, y down; float64) at positions, looking at targets (m)."""
    forward = target - position
    forward = forward / np.linalg.norm(forward, axis=-1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right = right / np.linalg.norm(right, axis=-1, keepdims=True)
    R = np.stack([right, np.cross(forward, right), forward], -1)
    return Rigid(torch.from_numpy(R), torch.from_numpy(np.array(position, dtype=np.float64)))


def place_rig(world: World, spot: Float[np.ndarray, "3"], radius_m: float = 2.4, height_m: float = 1.8) -> Rigid:
    """Poses "camera" of three tripods around a floor point, evenly turned, that see a person there from all sides.

    The turn chosen lets the nearest camera stand furthest away, up to `radius_m`, with nothing in between.
    Raises WearcapError where one would stand nearer than 1.4 m.
    """
    count = 3
    reach = np.arange(0.3, radius_m + 1e-6, 0.05)
    turn = np.deg2rad(np.arange(0, 360, 5))
    direction = np.stack([np.cos(turn), np.sin(turn), 0 * turn], -1)
    along = spot + direction[:, None] * reach[:, None]
    free = world.navigation.clearance_at(along.astype(np.float64)) > _CLEARANCE_M
    room = reach[np.cumprod(free, 1).sum(1).clip(min=1) - 1]
    apart = len(turn) // count
    worst = np.min([np.roll(room, -k * apart) for k in range(count)], 0)
    first = int(worst.argmax())
    if worst[first] < _NEAREST_M:
        what = f"no room for {count} cameras around {np.round(spot, 2).tolist()}"
        raise WearcapError(what, expected="a spot with 1.6 m of free floor on all sides")
    chosen = (first + apart * np.arange(count)) % len(turn)
    distance = room[chosen]
    feet, crown = np.arctan2(-height_m, distance), np.arctan2(_TALLEST_M - height_m, distance)
    position = spot + direction[chosen] * distance[:, None] + [0, 0, height_m]
    aim = np.zeros((count, 3)) + spot
    aim[:, 2] += height_m + distance * np.tan((feet + crown) / 2)
    return look_at(position, aim)


def registered(poses: Rigid, rng: np.random.Generator) -> Rigid:
    """Poses "camera" as far off as registration leaves them, each in a random direction."""
    shift, axis = (torch.from_numpy(rng.standard_normal(poses.t.shape)) for _ in range(2))
    turn, shift = (part / part.norm(dim=-1, keepdim=True) for part in (axis, shift))
    return Rigid(exp(np.deg2rad(REGISTERED_DEG) * turn) @ poses.R, poses.t + REGISTERED_M * shift)


def person_clouds(
    world: Sequence[Mesh],
    people: Sequence[Mesh],
    true: Rigid,
    believed: Rigid,
    rng: np.random.Generator,
    camera: Camera = KINECT,
) -> list[Float[np.ndarray, "point 3"]]:
    """The person in the scene (m) as a cloud for each mesh, of all cameras: those stand at `true` poses, and the points are
    put where the cameras are `believed` to stand."""
    y, x = torch.meshgrid(torch.arange(camera.height).double(), torch.arange(camera.width).double(), indexing="ij")
    rays = camera.unproject(torch.stack([x, y], -1))
    rays, parts = rays / rays[..., 2:], [[] for _ in people]
    for number in range(len(true.t)):
        background, bias = render(camera, true[number], world).depth, BIAS_M * rng.standard_normal()
        for cloud, body in zip(parts, people):
            depth = render(camera, true[number], [body]).depth
            filled = np.where(np.isfinite(depth), depth, 100.0)
            edge = ndimage.maximum_filter(filled, 3) - ndimage.minimum_filter(filled, 3) > _EDGE_M
            seen = np.isfinite(depth) & (depth < background) & ~edge
            noise = bias + (NOISE_M + NOISE_PER_M * depth[seen]) * rng.standard_normal(int(seen.sum()))
            points = rays[torch.from_numpy(seen)] * torch.from_numpy(depth[seen] + noise)[:, None]
            cloud.append((believed[number] @ points).numpy())
    return [np.concatenate(cloud) for cloud in parts]


def voxel_downsample(
    points: Float[Tensor, "point 3"], voxel_size: float
) -> tuple[Float[Tensor, "voxel 3"], Int64[Tensor, "point"]]:
    """Mean of the points in each occupied voxel (edge length in m), and the voxel index of every point."""
    cell = torch.floor(points.double() / voxel_size).long()
    _, voxel, count = torch.unique(cell, dim=0, return_inverse=True, return_counts=True)
    total = torch.zeros(len(count), 3, dtype=torch.float64, device=points.device)
    total.index_add_(0, voxel, points.double())
    return (total / count[:, None]).to(points.dtype), voxel
