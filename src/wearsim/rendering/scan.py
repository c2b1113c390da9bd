"""A simulated scene as a scanning company would deliver it: coloured cloud, fisheye photos, their poses.

The cloud is what a laser scanner on a trolley measures from its stations. Every file is written atomically under a
deterministic name, so that several processes may fill one folder, and a killed run can be continued.
"""

import json
import math
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image

from wearcap.errors import WearcapError
from wearcap.files import atomic_path, write_text
from wearcap.geometry import rotation
from wearcap.geometry.camera import Camera
from wearcap.geometry.compiled import compiled
from wearcap.geometry.mesh import face_normals, random_points
from wearcap.geometry.rigid import Rigid
from wearcap.io.formats.camera_json import PHOTOS_FILE, write_photos
from wearcap.io.formats.ply import Ply, write_ply
from wearcap.io.formats.scene_folder import CLOUD
from wearcap.scene.scan import Photo, Scan
from wearsim.places.world import World
from wearsim.rendering.views import CUBE, Development, Scenery, View, render_view, visible
from wearsim.sensors.slam import R_DEVICE_CAM

CHUNK = 1_000_000
"""Number of surface samples that are measured at a time."""
CELL_M = 1.0
"""Side of the cells that share a list of near stations."""
TRIED = 40
"""Number of nearest stations that are checked for visibility of a point."""
PROBES = 6
"""Random points per face that decide whether it is seen at all."""
RIG_CAMERA = Camera("fisheye", 800, 800, 330.0, 330.0, 399.5, 399.5, (-0.012, 0.004, -0.002, 0.0))
"""139° across and 180° from corner to corner."""
RIG_CAMERAS = 4
RIG_HEIGHT_M, RIG_TILT_DEG, RIG_RADIUS_M = 1.85, 8.0, 0.12
MADE = "made.json"


@dataclass(frozen=True)
class Scanner:
    """Settings of a scan."""

    station_m: float = 2.2
    """Distance between stations."""
    clearance_m: float = 0.45
    height_m: float = 1.75
    full_m: float = 4.0
    """Distance up to which surfaces have the full density; beyond it, density falls with the square of the distance."""
    max_m: float = 15.0
    noise_m: float = 0.003
    """Deviation of the range."""
    mixed: float = 0.25
    """Share of the points just behind an outline that float between it and what it hides."""
    wrong: float = 0.0004
    """Share of points with a range that is plainly wrong."""
    view_px: int = 224
    """Side of the six visibility images of a station."""


def scan_world(
    scenery: Scenery,
    spacing_m: float,
    rng: np.random.Generator,
    scanner: Scanner = Scanner(),
    walked: World | None = None,
) -> Scan:
    """The scan of a world: points about `spacing_m` apart on surfaces seen by any station, in the world's axes (m).

    Stations stand where one can walk in the world, or in `walked`: the same world without its doors.
    Raises WearcapError for a spacing that is not positive.
    """
    if not spacing_m > 0:
        raise WearcapError(f"points {spacing_m} m apart", expected="a positive spacing")
    stations = place_stations(walked or scenery.world, scanner.station_m, scanner.clearance_m)
    stations[:, 2] += scanner.height_m
    size = scanner.view_px
    nearness = np.empty((len(stations), len(CUBE), size, size), np.float32)
    for station, views in zip(stations, nearness):
        for view, R in zip(views, CUBE):
            view[:] = visible(scenery, R, station, View(R, size / 2, (size - 1) / 2, (size - 1) / 2, size, size))[0]
    # For every cell of the plan the nearest stations in reach, in order, and the index of each cell's first.
    origin = scenery.vertices[:, :2].min(0).astype(np.float64) - 0.1
    shape = np.ceil((scenery.vertices[:, :2].max(0) + 0.1 - origin) / CELL_M).astype(np.int64)
    grid = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 2)
    middle = origin + (grid + 0.5) * CELL_M
    distance = np.linalg.norm(middle[:, None] - stations[None, :, :2], axis=-1)
    order = np.argsort(distance, axis=1)[:, :TRIED]
    within = np.take_along_axis(distance, order, 1) < scanner.max_m + CELL_M
    first = np.concatenate([[0], within.sum(1).cumsum()])
    survey = (stations, order[within], first, CELL_M, origin, shape, nearness)
    # Most faces of a world are inside or below others: a face is sampled if some of a few random points are seen.
    probed = np.repeat(np.arange(len(scenery.faces)), PROBES)
    corners = scenery.vertices.astype(np.float64)[scenery.faces]
    _, kept = _measured(scenery, survey, scanner, probed, random_points(corners[probed], rng), rng)
    area = 0.5 * np.linalg.norm(face_normals(corners), axis=1)
    ends = rng.poisson(kept.reshape(-1, PROBES).any(1) * area / spacing_m**2).cumsum()
    points, colors = [], []
    for start in range(0, int(ends[-1]), CHUNK):
        face = np.searchsorted(ends, np.arange(start, min(start + CHUNK, int(ends[-1]))), side="right")
        place = random_points(corners[face], rng)
        measured, kept = _measured(scenery, survey, scanner, face, place, rng)
        points.append(measured[kept].astype(np.float32))
        footprint = np.full(int(kept.sum()), max(spacing_m, 0.01))
        colors.append(scenery.paint.colors_of(place[kept], face[kept], footprint))
    return Scan(np.concatenate(points), np.concatenate(colors))


def _measured(scenery: Scenery, survey: tuple, scanner: Scanner, face, place, rng) -> tuple:
    """Measured positions of surface samples, and a mask of those that were measured."""
    measured, kept = np.empty_like(place), np.zeros(len(place), bool)
    draws = rng.random((len(place), 3)), rng.standard_normal(len(place))
    errors = scanner.full_m, scanner.max_m, scanner.noise_m, scanner.mixed, scanner.wrong
    _measure(place, scenery.paint.frames[face, 9:12], survey, draws, errors, measured, kept)
    return measured, kept


def place_stations(world: World, spacing_m: float, clearance_m: float = 0.45) -> Float[np.ndarray, "station 3"]:
    """Floor points (m) that cover the walkable area, none nearer to another than the spacing; always the same."""
    points = world.navigation.node_points
    free = points[world.navigation.clearance_at(points) > clearance_m]
    points = free if len(free) else points
    left = np.ones(len(points), bool)
    chosen = []
    while left.any():
        chosen.append(int(left.argmax()))
        left &= np.linalg.norm(points - points[chosen[-1]], axis=1) >= spacing_m
    return points[chosen]


@compiled
def _measure(points, normals, survey, draws, errors, out, kept):
    """Measured position of every point that a station sees; `kept` is their mask.

    The stations of a point's cell are tried from near to far; the last of the `survey` is 1/depth (station side row
    column) of their views through the sides of a cube. Beyond `full_m` fewer points are met. Range noise, range errors
    and points that float between an outline and what lies behind it lie along the ray. The `draws` are uniform
    (point 3) and normal (point); `errors` are the scanner's.
    """
    stations, near_stations, near_first, cell, origin, shape, nearness = survey
    luck, normal_draw = draws
    full_m, max_m, noise_m, mixed, wrong = errors
    size = nearness.shape[-1]
    for k in range(len(points)):
        kept[k] = False
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        i, j = int((x - origin[0]) / cell), int((y - origin[1]) / cell)
        if i < 0 or j < 0 or i >= shape[0] or j >= shape[1]:
            continue
        slot = i * shape[1] + j
        for n in range(near_first[slot], near_first[slot + 1]):
            station = near_stations[n]
            dx, dy, dz = x - stations[station, 0], y - stations[station, 1], z - stations[station, 2]
            distance = math.sqrt(dx * dx + dy * dy + dz * dz)
            facing = -(dx * normals[k, 0] + dy * normals[k, 1] + dz * normals[k, 2]) / distance
            if distance > max_m or distance < 0.3 or facing < 0.03:
                continue
            # side of the cube around the station, depth before that side, row and column
            ax, ay, az = abs(dx), abs(dy), abs(dz)
            if az >= ax and az >= ay:
                side, depth, u, v = (0 if dz > 0 else 5), az, (dx if dz > 0 else -dx), dy
            elif ax >= ay:
                side, depth, u, v = (1 if dx > 0 else 2), ax, (-dz if dx > 0 else dz), dy
            else:
                side, depth, u, v = (3 if dy > 0 else 4), ay, dx, (-dz if dy > 0 else dz)
            depth = max(depth, 1e-6)
            column = int(min(size - 1.0, max(0.0, math.floor(0.5 * size * (1.0 + u / depth)))))
            row = int(min(size - 1.0, max(0.0, math.floor(0.5 * size * (1.0 + v / depth)))))
            drawn = nearness[station, side, row, column]
            if drawn * depth > 1.02 + 0.08 * (1.0 - min(1.0, 4.0 * facing)):
                continue
            if luck[k, 0] * max(1.0, (distance / full_m) ** 2) > min(1.0, 2.5 * facing):
                break
            stretch = noise_m * normal_draw[k] / distance
            if luck[k, 1] < wrong:
                stretch = -0.5 * luck[k, 2]
            elif luck[k, 1] < wrong + mixed:
                beyond = max(
                    nearness[station, side, row, min(size - 1, column + 1)],
                    nearness[station, side, row, max(0, column - 1)],
                )
                if beyond * depth > 1.15:
                    stretch = luck[k, 2] * (1.0 / (beyond * depth) - 1.0)
            out[k, 0], out[k, 1], out[k, 2] = x + stretch * dx, y + stretch * dy, z + stretch * dz
            kept[k] = True
            break


@dataclass(frozen=True)
class SceneSettings:
    """Resolution of a scene's scan and photos."""

    spacing_m: float = 0.015
    """Spacing of the scan's points."""
    photo_m: float = 1.5
    """Spacing of the rig's stations; 0: no photos."""
    photo_size: int = 800
    noise: float = 2.0
    """Noise of the photos (grey levels)."""
    scanner: Scanner = field(default_factory=Scanner)


def plan_photos(scenery: Scenery, settings: SceneSettings) -> list[Photo]:
    """The rig's photos by station and camera, files relative to the scene's folder; always the same."""
    if not settings.photo_m > 0:
        return []
    lens = RIG_CAMERA.scaled(settings.photo_size, settings.photo_size)
    photos = []
    for number, station in enumerate(place_stations(scenery.world, settings.photo_m)):
        rng = np.random.default_rng([11, number])
        heading = rng.uniform(-np.pi, np.pi)
        height = RIG_HEIGHT_M + rng.normal(0.0, 0.01)
        lean = rotation.exp(torch.from_numpy(np.deg2rad(1.0) * rng.standard_normal(3)).float())
        for camera in range(RIG_CAMERAS):
            yaw = torch.tensor(heading + 2 * np.pi * camera / RIG_CAMERAS).float()
            down = rotation.about_axis("y", torch.tensor(np.deg2rad(RIG_TILT_DEG)).float())
            R_rig = lean @ rotation.about_axis("z", yaw)
            t = torch.from_numpy(station).float() + R_rig @ torch.tensor([RIG_RADIUS_M, 0.0, height])
            photos.append(
                Photo(Path(f"photos/{number:05d}-cam{camera}.jpg"), lens, Rigid(R_rig @ down @ R_DEVICE_CAM, t))
            )
    return photos


def write_scene(scenery: Scenery, folder: str | Path, settings: SceneSettings, seed: int, turn: int = 0) -> None:
    """Write the missing files of a scene: `pointcloud.ply`, `photos/*.jpg`, `photos.json`; settings go to `made.json`.

    Files of other settings or another seed are made again. Processes that fill one folder at once should have different
    `turn`s: each begins with other photos.
    """
    folder = Path(folder)
    wanted = json.dumps({"settings": asdict(settings), "seed": seed, "world": scenery.world.name}, sort_keys=True)
    plan = plan_photos(scenery, settings)
    note = folder / MADE
    if not note.is_file() or note.read_text(encoding="utf-8") != wanted:
        for path in (folder / CLOUD, folder / PHOTOS_FILE, *(folder / "photos").glob("*.jpg")):
            path.unlink(missing_ok=True)
        write_text(note, wanted)
    if not (folder / CLOUD).is_file():
        scan = scan_world(scenery, settings.spacing_m, np.random.default_rng([12, seed]), settings.scanner)
        write_ply(Ply(scan.points, scan.colors), folder / CLOUD)
    for number in np.random.default_rng([13, turn]).permutation(len(plan)):
        photo = plan[number]
        if not (folder / photo.file).is_file():
            rng = np.random.default_rng([14, seed, int(number)])
            light = Development(exposure=float(rng.uniform(0.92, 1.06)), noise=settings.noise, vignetting=0.25)
            picture = Image.fromarray(render_view(scenery, photo.camera, photo.T_world_cam, light, rng))
            with atomic_path(folder / photo.file) as temporary:
                picture.save(temporary, "JPEG", quality=92, subsampling=0)
    if not (folder / PHOTOS_FILE).is_file():
        write_photos(plan, folder)
