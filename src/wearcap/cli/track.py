"""`wearcap track VIDEO`: a plain video goes in; the camera's path and points of its surroundings come out."""

from pathlib import Path

from hydra.utils import instantiate
from omegaconf import DictConfig
from rich import print as show
from rich.console import Console
from rich.progress import Progress

from wearcap.cli.conf import hydra_main
from wearcap.errors import WearcapError
from wearcap.io.formats.camera_json import read_camera
from wearcap.io.formats.colmap import read_colmap
from wearcap.localization.tracking import Pictures, Track, track_pictures


def run(config: DictConfig) -> Track:
    """Track the config's source, or take the path from a COLMAP model, and write the result."""
    if config.source is None and config.from_model is None:
        raise WearcapError("nothing to track", expected="wearcap track VIDEO, or from_model=DIR")
    settings = instantiate(config.settings)
    fps = settings.fps
    if not fps > 0:
        raise WearcapError(f"settings.fps={fps}", expected="pictures a second, above 0")
    named = config.from_model or config.source
    output = Path(config.output or Path(config.paths.outputs) / "track" / Path(named).stem)
    if config.from_model is not None:
        model = read_colmap(config.from_model, config.source)
        pictures = Pictures.of_model(model, fps) if config.source is None else Pictures.of_folder(config.source, fps)
        found = Track.of_model(model, pictures, settings.max_gap_s, where=config.from_model)
    else:
        camera, tasks = None if config.camera is None else read_camera(config.camera), {}
        with Progress(console=Console(stderr=True)) as progress:

            def advance(step: str, done: int, total: int) -> None:
                if step not in tasks:
                    tasks[step] = progress.add_task(step, total=total)
                progress.update(tasks[step], completed=done, total=total)

            found = track_pictures(config.source, output, settings, camera, advance)
    found.write(output, Path(named).name)
    _show_report(found, output)
    return found


def _show_report(found: Track, output: Path) -> None:
    show(
        f"{found.placed} of {found.pictures} pictures placed, {len(found.points_world)} points, reprojection "
        f"{found.reprojection_px:.2f} px; scale and axes are arbitrary"
    )
    for start, stop, bridged in found.gaps_s:
        show(f"[yellow]no place from {start:.2f} s to {stop:.2f} s: {'interpolated' if bridged else 'left out'}[/]")
    show(f"trajectory.txt, points.ply, camera.json, report.json: {output}")


def main(arguments: list[str]) -> None:
    hydra_main("track", run, arguments)
