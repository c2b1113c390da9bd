"""`wearcap calibrate`: a video or pictures of a checkerboard go in; a camera's intrinsics come out.

`wearcap calibrate steps=watches` calibrates MocapEvery's sensors: watches and head camera.
"""

from dataclasses import asdict
from pathlib import Path

from hydra.utils import instantiate
from omegaconf import DictConfig
from rich import print as show
from rich.table import Table

from wearcap.cli.conf import hydra_main
from wearcap.io.formats.camera_json import write_camera
from wearcap.io.formats.video import read_pictures
from wearcap.localization.checkerboard import Board, Calibration, calibrate_from_pictures

HELP = (
    "camera intrinsics from a checkerboard: wearcap calibrate source=VIDEO columns=9 rows=6 square_m=0.025; "
    "watches: wearcap calibrate steps=watches left=LEFT.csv right=RIGHT.csv --guide"
)
ENOUGH = 0.6
"""Coverage below which a hint is printed."""


def run(config: DictConfig) -> Calibration:
    """Calibrate from the config's source and write camera.json."""
    board = Board(config.columns, config.rows, config.square_m)
    pictures = read_pictures(config.source, config.max_pictures)
    found = calibrate_from_pictures(pictures, board, instantiate(config.settings))
    _show_report(found)
    write_camera(found.camera, config.output, _about(found, board, str(config.source)))
    show(f"camera: {config.output}")
    return found


def _about(found: Calibration, board: Board, source: str) -> dict:
    views = [
        {"name": view.name, "rms_px": round(view.rms_px, 4), "used": used}
        for used, group in ((True, found.views), (False, found.rejected))
        for view in group
    ]
    return {
        "source": Path(source).name,
        "board": asdict(board),
        "rms_px": found.rms_px,
        "focal_std_px": found.focal_std_px,
        "coverage": found.coverage,
        "pictures_examined": found.examined,
        "pictures_with_board": found.seen,
        "views": views,
    }


def _show_report(found: Calibration) -> None:
    camera = found.camera
    table = Table(
        title=f"{len(found.views)} views used, {len(found.rejected)} rejected, of {found.seen} with the board in "
        f"{found.examined} pictures",
        title_justify="left",
    )
    for column in ("view", "residual (px)", "edge blur (px)", ""):
        table.add_column(column, justify="left" if column in ("view", "") else "right")
    for view in sorted((*found.views, *found.rejected), key=lambda view: -view.rms_px)[:8]:
        table.add_row(
            view.name, f"{view.rms_px:.3f}", f"{view.blur_px:.1f}", "rejected" if view in found.rejected else ""
        )
    show(table)
    show(
        f"fx {camera.fx:.2f}  fy {camera.fy:.2f}  cx {camera.cx:.2f}  cy {camera.cy:.2f}  k1 k2 p1 p2 "
        + " ".join(f"{value:.5f}" for value in camera.distortion)
    )
    show(
        f"reprojection RMS {found.rms_px:.3f} px, focal length ± {found.focal_std_px:.2f} px, corners in "
        f"{100 * found.coverage:.0f} % of the picture"
    )
    if found.coverage < ENOUGH:
        show("[yellow]note: hold the board into the picture's corners too; distortion there is extrapolated[/]")


def main(arguments: list[str]) -> None:
    if any(argument.startswith("steps=") for argument in arguments):
        from wearcap.cli.calibrate_watches import main as watches

        watches(arguments)
    else:
        hydra_main("calibrate", run, arguments)
