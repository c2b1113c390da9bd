"""Three simulated depth cameras around a spot: the depth images that Kinects would record of a person in a world."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt16
from scipy import ndimage

from wearcap.errors import WearcapError
from wearcap.geometry.camera import Camera
from wearcap.geometry.mesh import Mesh
from wearcap.geometry.render import render
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import exp
from wearsim.places.world import World

KINECT = Camera("pinhole", 640, 576, 504.0, 504.0, 319.5, 287.5)
"""Azure Kinect's unbinned narrow mode: 65° x 59° of its 75° x 65°, whose rim the lens bends."""
_CLEARANCE_M = 0.2
"""Least distance of a tripod from a wall or a piece of furniture."""
_TALLEST_M = 2.0
_NEAREST_M = 1.4
"""A camera nearer than this does not see a person from head to foot."""


@dataclass(frozen=True)
class DepthNoise:
    """Noise of a time-of-flight camera (deviations of the data sheet's kind, the shares are ours)."""

    floor_m: float = 0.0015
    per_metre: float = 0.0015
    """White noise: deviation floor_m + per_metre · depth."""
    bias_m: float = 0.003
    """Deviation of each camera's constant offset (the data sheet allows 11 mm)."""
    flying_share: float = 0.4
    """Share of the pixels along edges that lie between both surfaces."""
    edge_m: float = 0.05
    edge_dropout: float = 0.2
    dropout: float = 0.003
    nearest_m: float = 0.25
    farthest_m: float = 5.5
    """Largest measurable distance (3.9 m by the data sheet, further from light surfaces)."""


@dataclass(frozen=True, eq=False)
class SimulatedRig:
    """Images of the rig (mm) and the true poses of its cameras."""

    camera: Camera
    T_world_cam: Rigid
    """Poses over "camera"."""
    empty_mm: UInt16[np.ndarray, "camera still height width"]
    depth_mm: UInt16[np.ndarray, "camera time height width"]


def look_at(position: Float[np.ndarray, "*batch 3"], target: Float[np.ndarray, "*#batch 3"]) -> Rigid:
    """Poses of upright cameras (z forward, y down; float64) at positions, looking at targets (m)."""
    forward = target - position
    forward = forward / np.linalg.norm(forward, axis=-1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right = right / np.linalg.norm(right, axis=-1, keepdims=True)
    R = np.stack([right, np.cross(forward, right), forward], -1)
    return Rigid(torch.from_numpy(R), torch.from_numpy(np.array(position, dtype=np.float64)))


def place_rig(
    world: World, spot: Float[np.ndarray, "3"], *, radius_m: float = 2.4, height_m: float = 1.8, count: int = 3
) -> Rigid:
    """Poses "camera" of tripods around a floor point, evenly turned, that see a person there from all sides.

    The turn chosen lets the nearest camera stand furthest away, up to `radius_m`, with nothing in between.
    Raises WearcapError where one would stand nearer than 1.4 m.
    """
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
        raise WearcapError(
            f"no room for {count} cameras around {np.round(spot, 2).tolist()}",
            expected="a spot with 1.6 m of free floor on all sides",
        )
    chosen = first + apart * np.arange(count)
    distance = room[chosen % len(turn)]
    feet, crown = np.arctan2(-height_m, distance), np.arctan2(_TALLEST_M - height_m, distance)
    position = spot + direction[chosen % len(turn)] * distance[:, None] + [0, 0, height_m]
    aim = np.zeros((count, 3)) + spot
    aim[:, 2] += height_m + distance * np.tan((feet + crown) / 2)
    return look_at(position, aim)


def approximate(poses: Rigid, rng: np.random.Generator, translation_m: float = 0.1, rotation_deg: float = 3.0) -> Rigid:
    """Poses with errors of the size that visual localisation leaves, each in a random direction."""
    shift, axis = (torch.from_numpy(rng.standard_normal(poses.t.shape)) for _ in range(2))
    unit = [part / part.norm(dim=-1, keepdim=True) for part in (shift, axis)]
    return Rigid(
        exp(np.deg2rad(rotation_deg) * unit[1]).to(poses.R) @ poses.R, poses.t + translation_m * unit[0].to(poses.t)
    )


def simulate_rig(
    world: Sequence[Mesh],
    people: Sequence[Mesh],
    T_world_cam: Rigid,
    rng: np.random.Generator,
    *,
    camera: Camera = KINECT,
    noise: DepthNoise = DepthNoise(),
    stills: int = 20,
) -> SimulatedRig:
    """Depth images of the empty world (`stills` of them), then with the person's mesh of each frame.

    T_world_cam: poses "camera".
    """
    count, size = len(T_world_cam.t), (camera.height, camera.width)
    empty = np.zeros((count, stills, *size), np.uint16)
    depth = np.zeros((count, len(people), *size), np.uint16)
    for number in range(count):
        pose, bias = T_world_cam[number], noise.bias_m * rng.standard_normal()
        background = render(camera, pose, world).depth
        for still in range(stills):
            empty[number, still] = _sensed(background, bias, noise, rng)
        for frame, body in enumerate(people):
            true = np.minimum(background, render(camera, pose, [body]).depth)
            depth[number, frame] = _sensed(true, bias, noise, rng)
    return SimulatedRig(camera, T_world_cam, empty, depth)


def _sensed(
    depth_m: Float32[np.ndarray, "height width"], bias_m: float, noise: DepthNoise, rng: np.random.Generator
) -> UInt16[np.ndarray, "height width"]:
    """A true depth image as the camera reports it, in whole millimetres, 0 without a return."""
    true = np.where(np.isfinite(depth_m), depth_m, 2 * noise.farthest_m)
    near, far = ndimage.minimum_filter(true, 3), ndimage.maximum_filter(true, 3)
    edge = far - near > noise.edge_m + 0.02 * near
    chance = rng.random(true.shape, np.float32)
    flying = edge & (chance < noise.flying_share)
    value = np.where(flying, near + rng.random(true.shape, np.float32) * (far - near), true)
    deviation = noise.floor_m + noise.per_metre * value
    value = value + bias_m + deviation * rng.standard_normal(true.shape, np.float32)
    lost = rng.random(true.shape, np.float32) < np.where(edge, noise.edge_dropout, noise.dropout)
    lost |= (value < noise.nearest_m) | (value > noise.farthest_m)
    return np.where(lost, 0, np.rint(1000 * value)).astype(np.uint16)
