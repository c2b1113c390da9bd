"""`wearcap scene`: a scanned or photographed scene goes in; the map that cameras are localised in comes out."""

from collections.abc import Sequence

import numpy as np
from hydra.utils import instantiate
from omegaconf import DictConfig
from rich import print as show
from rich.console import Console
from rich.progress import track
from rich.table import Table

from wearcap.cli.conf import hydra_main
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.io.formats.colmap import Tracks
from wearcap.io.formats.scene_folder import read_scene
from wearcap.io.formats.video import read_image
from wearcap.localization.localizer import Localizer
from wearcap.localization.map_builder import build_map, extended
from wearcap.localization.visual_map import VisualMap
from wearcap.scene.scan import Photo, Scan


def run(config: DictConfig) -> VisualMap:
    """Build or extend the config's map, report on it, and save it."""
    if config.every < 1 or config.check < 0:
        expected = "every=1 (all photos) or more, check=0 or more"
        raise WearcapError(f"every={config.every} check={config.check}", expected=expected)
    photos, source = read_scene(config.scene, config.images, config.metres_per_unit)
    extractor, matcher = (instantiate(config.localization[part]) for part in ("extractor", "matcher"))
    options = {"settings": instantiate(config.settings), "progress": True}
    taken = np.arange(0, len(photos), config.every)
    held_out = (
        taken[:: len(taken) // config.check][: config.check] if 0 < config.check <= len(taken) // 4 else taken[:0]
    )
    rest = np.setdiff1d(taken, held_out)
    if config.extend is None:
        made = build_map(*_part(photos, source, rest), extractor, **options)
    else:
        made = extended(VisualMap.load(config.extend), *_part(photos, source, rest), extractor, **options)
    if len(held_out):
        localizer = Localizer(made, extractor, matcher, instantiate(config.localizer))
        _check(localizer, [photos[number] for number in held_out])
        made = extended(made, *_part(photos, source, held_out), extractor, **options)
    _show_report(made)
    made.save(config.output)
    show(f"map: {config.output}")
    return made


def _part(photos: list[Photo], source: Scan | Tracks, chosen: np.ndarray) -> tuple[list[Photo], Scan | Tracks]:
    part = source.of_photos(chosen) if isinstance(source, Tracks) else source
    return [photos[number] for number in chosen], part


def _show_report(made: VisualMap) -> None:
    counts = np.diff(made.observations.first)
    low, high = (reduce(made.T_world_cam.t.numpy(), 0) for reduce in (np.min, np.max))
    table = Table(show_header=False)
    table.add_row("pictures", f"{len(made)}")
    table.add_row(
        "keypoints with a 3D position", f"{len(made.observations)} ({np.median(counts):.0f} in the median picture)"
    )
    table.add_row("landmarks", f"{len(made.landmarks.points_world)}")
    table.add_row("features", f"{made.extractor}, {made.descriptor}")
    table.add_row("cameras from", " ".join(f"{value:.2f}" for value in low))
    table.add_row("to", " ".join(f"{value:.2f}" for value in high))
    show(table)
    poor = np.flatnonzero(counts < 50)
    if len(poor):
        names = ", ".join(made.names[number] for number in poor[:5])
        show(f"[yellow]{len(poor)} pictures have fewer than 50 keypoints on the scene: {names}[/yellow]")


def _check(localizer: Localizer, photos: Sequence[Photo]) -> None:
    """Localise photos that are not in the map yet."""
    errors = []
    for photo in track(photos, "check", console=Console(stderr=True)):
        pose = localizer(read_image(photo.file), photo.camera)
        if pose is not None:
            turn = rotation.log(pose.R_world_cam.double().T @ photo.T_world_cam.R.double()).norm().rad2deg()
            errors.append(((pose.t_world_cam - photo.T_world_cam.t).norm().item(), turn.item()))
    show(f"{len(errors)} of {len(photos)} photos are found in the map of the others", end="")
    if errors:
        shift, turn = np.median(errors, axis=0)
        show(f"; median error {shift:.3f} (m, or the model's own unit), {turn:.2f}°", end="")
    show("")


def main(arguments: list[str]) -> None:
    hydra_main("scene", run, arguments)
