"""A simulated scene on disk, as a scanning company would deliver it: cloud, fisheye photos, their poses.

Every file is written atomically under a deterministic name, so that several processes may fill one folder, and a
killed run can be continued.
"""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from wearcap.files import atomic_path, write_text
from wearcap.geometry import rotation
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.io.formats.camera_json import PHOTOS_FILE, write_photos
from wearcap.io.formats.ply import Ply, write_ply
from wearcap.io.formats.scene_folder import CLOUD
from wearcap.scene.scan import Photo
from wearcap.sensors.slam import R_DEVICE_CAM
from wearcap.simulation.rendering.scan import Scanner, place_stations, scan_world
from wearcap.simulation.rendering.views import Development, Scenery, render_view

RIG_CAMERA = Camera("fisheye", 800, 800, 330.0, 330.0, 399.5, 399.5, (-0.012, 0.004, -0.002, 0.0))
"""139° across and 180° from corner to corner."""
RIG_CAMERAS = 4
RIG_HEIGHT_M, RIG_TILT_DEG, RIG_RADIUS_M = 1.85, 8.0, 0.12
MADE = "made.json"


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
