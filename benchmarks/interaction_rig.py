"""Three depth cameras around an interaction (thesis Table 5.5): distances of captured body and object to what they measure.

The rig is that of HPS's tables: simulated time-of-flight cameras on tripods, registered to the scan by their own depth
images. As documented, distances go from the captured surfaces to the measured cloud; what the cameras cannot see of a
surface counts too, so that the truth itself has a distance.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
import torch
from depth_rig import Background, DepthView, scene_cloud
from jaxtyping import Float, Float32, Float64
from scipy.spatial import KDTree
from seen_flat import SeenFlat
from simulated_depth_rig import approximate, look_at, simulate_rig
from torch import Tensor

from wearcap.body.anny_body import anny_body
from wearcap.errors import WearcapError
from wearcap.geometry.mesh import Mesh
from wearcap.geometry.rigid import Rigid
from wearcap.metrics.objects import handlings
from wearcap.recording import Motion
from wearcap.recording.timing import at_times
from wearcap.systems.ireplica.scores import poses_at, surface_points
from wearsim.places.world import World

INSTANTS = 6
"""Of the handling, at which the cameras look."""
STILLS = 8
"""Depth images of the empty room, by which a camera is registered."""
SCENE_M, NEAR_M = 8.0, 3.0
"""The scan within the first distance of the spot registers the rig; of its cloud what is within the second is used."""


CAMERAS, CAMERA_M, AIM_M = 3, 1.8, 0.9
"""Number of tripods, height of the cameras and of what they look at (m)."""
REACH_M, CLEAR_M, APART_DEG = (1.2, 2.6), 0.2, 30
"""Distances of a tripod from the spot, its least distance from a wall, and the least angle between two."""


@dataclass(frozen=True, eq=False)
class RigLooks:
    """What the rig measured during one handling."""

    name: str
    times: Float64[Tensor, "instant"]
    clouds: tuple[Float[np.ndarray, "point 3"], ...]
    """Everything in sight, in the scene (m)."""


def rig_looks(seen: SeenFlat, scan: Float32[np.ndarray, "point 3"]) -> RigLooks | None:
    """The rig at the longest handling that has room for it; None where none has, or the rig cannot be registered."""
    held = seen.recording.interactions
    assert held is not None
    rows = sorted(handlings(held.start_s, held.stop_s, held.objects), key=lambda row: row[1] - row[2])
    rng = np.random.default_rng(44)
    for name, start, stop in rows:
        times = torch.linspace(start, stop, INSTANTS, dtype=torch.float64)
        motion, vertices = seen.wearer(times)
        poses = seen.poses(times)
        spot = torch.cat([motion.t_world_root[INSTANTS // 2, :2], torch.zeros(1)]).double().numpy()
        try:
            true = place_tripods(seen.world(poses, 0), spot)
            views = _registered(seen.world(poses, 0).mesh, true, scan, spot, rng)
        except WearcapError:
            continue
        clouds = []
        for k in range(INSTANTS):
            body = Mesh(vertices[k], seen.body.faces.numpy().astype(np.int32), np.ones(3, np.float32))
            images = simulate_rig([seen.world(poses, k).mesh], [body], true, rng, stills=0).depth_mm
            cloud = scene_cloud(list(images[:, 0]), views)
            clouds.append(cloud[np.linalg.norm(cloud - spot, axis=1) < NEAR_M])
        return RigLooks(name, times, tuple(clouds))
    return None


def place_tripods(world: World, spot: Float[np.ndarray, "3"]) -> Rigid:
    """Poses "camera" of tripods with free floor between them and a spot, as far around it as a furnished room allows.

    Raises WearcapError where they would stand closer together than `APART_DEG`.
    """
    reach, turn = np.arange(0.3, REACH_M[1] + 1e-6, 0.05), np.deg2rad(np.arange(0, 360, 10))
    direction = np.stack([np.cos(turn), np.sin(turn), 0 * turn], -1)
    along = spot + direction[:, None] * reach[:, None]
    free = world.navigation.clearance_at(along.astype(np.float64)) > CLEAR_M
    free[:, reach < REACH_M[0] / 2] = True  # the wearer stands close to what is handled
    room = reach[np.cumprod(free, 1).sum(1).clip(min=1) - 1]
    open_ = np.flatnonzero(room >= REACH_M[0])
    sets = [(_least_angle(turn[list(chosen)]), chosen) for chosen in combinations(open_.tolist(), CAMERAS)]
    widest, chosen = max(sets, default=(0.0, ()))
    if widest < np.deg2rad(APART_DEG):
        raise WearcapError(f"no room for {CAMERAS} cameras around {np.round(spot, 2).tolist()}", expected="free floor")
    position = spot + direction[list(chosen)] * room[list(chosen)][:, None] + [0, 0, CAMERA_M]
    return look_at(position, np.array([spot[0], spot[1], spot[2] + AIM_M]))


def _least_angle(turns: Float[np.ndarray, "camera"]) -> float:
    """Least angle between two of some directions (rad)."""
    apart = np.abs(np.angle(np.exp(1j * (turns[:, None] - turns))))
    return float(apart[~np.eye(len(turns), dtype=bool)].min())


def _registered(
    world: Mesh, true: Rigid, scan: Float32[np.ndarray, "point 3"], spot: np.ndarray, rng: np.random.Generator
) -> list[DepthView]:
    """The cameras at the poses that their depth images of the room without the wearer give."""
    rig = simulate_rig([world], [], true, rng, stills=STILLS)
    near = scan[np.linalg.norm(scan - spot, axis=1) < SCENE_M]
    rough = approximate(true, rng)
    views = [DepthView(rig.camera, rough[k], Background.of(rig.empty_mm[k])) for k in range(len(true.t))]
    return [view.registered(near)[0] for view in views]


def rig_distances(looks: RigLooks, motion: Motion, seen: SeenFlat) -> dict[str, float]:
    """Mean distances (cm) from captured body and object to the measured clouds."""
    body = anny_body(motion.skeleton, seen.recording.shape or None)
    item = seen.flat.environment.by_name(looks.name)
    inside = looks.times.clamp(motion.timestamps[0], motion.timestamps[-1])
    vertices = body.vertices(at_times(motion, inside).T_world_joint).numpy()
    poses, surface = (
        poses_at((motion.object_motion or {}).get(looks.name), item, looks.times),
        surface_points(item.mesh),
    )
    placed = surface @ poses.R.to(surface).mT + poses.t.to(surface)[:, None]
    found = {"body_cm": [], "object_cm": []}
    for k, cloud in enumerate(looks.clouds):
        tree = KDTree(cloud)
        found["body_cm"].append(tree.query(vertices[k])[0].mean())
        found["object_cm"].append(tree.query(placed[k].numpy())[0].mean())
    return {name: 100 * float(np.mean(values)) for name, values in found.items()}
