"""A watch's log read, checked and resampled: what it felt in its own axes and in the world, and how it was turned.

    python -m benchmarks.pictures.watch_pictures LOG.csv [FILE]

LOG is SensorLog's CSV or WristMotion.csv. Above, the specific force as felt; below it the same turned into the world at
30 Hz, where 1 g has to be z's while the watch is still; at the bottom the watch's own axes with the force that holds it
up. What lies in a gap of the log is left out.
"""

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from wearcap.apps.viewer.picture import save_png
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import Trajectory, find_gaps, resample
from wearcap.io.devices.watch_log import read_watch_log
from wearcap.sensors.watches import MAX_GAP_S

WIDTH, BAND, MARGIN = 1300, 250, 56
AXES = {"x": (200, 60, 50), "y": (40, 140, 60), "z": (50, 90, 200)}
UP, INK, RULE = (30, 30, 30), (40, 40, 45), (225, 225, 230)
FPS, MOST_S, WATCHES = 30.0, 40.0, 9
G_M_S2, LOW, HIGH = 9.81, -1.6, 2.2
GAP = (238, 238, 242)


def main(arguments: list[str]) -> None:
    if not arguments:
        sys.exit(__doc__)
    stream = read_watch_log(arguments[0], "left_wrist")
    assert stream.R_world_imu is not None
    assert stream.acc_imu is not None
    start = stream.timestamps[0].item()
    stop = min(stream.timestamps[-1].item(), start + MOST_S)
    clock = torch.arange(start, stop, 1 / FPS, dtype=torch.float64)
    R = resample(Trajectory(stream.timestamps, stream.R_world_imu, stream.acc_imu), clock)
    felt = R.t_world_body / G_M_S2
    for gap in find_gaps(stream.timestamps, MAX_GAP_S).tolist():
        felt[(clock > stream.timestamps[gap]) & (clock < stream.timestamps[gap + 1])] = torch.nan
    world = (R.R_world_body @ felt[..., None])[..., 0]
    sheet = Image.new("RGB", (WIDTH, 3 * BAND + 40), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(15)
    time = (clock - start).numpy()
    _curves(draw, font, 0, "specific force in the watch's axes (g)", time, felt.numpy())
    _curves(draw, font, BAND, "the same in the world (g): at rest 1 along z", time, world.numpy())
    _watches(draw, font, 2 * BAND, time, R.R_world_body, world)
    save_png(Path(arguments[1] if len(arguments) > 1 else "docs/mocap_every_watch.png"), np.asarray(sheet))


def _curves(draw: ImageDraw.ImageDraw, font, top: int, title: str, time: np.ndarray, values: np.ndarray) -> None:
    row = lambda v: top + 34 + (HIGH - np.clip(v, LOW, HIGH)) / (HIGH - LOW) * (BAND - 50)  # noqa: E731
    column = MARGIN + (WIDTH - MARGIN - 20) * time / time[-1]
    lost = np.isnan(values[:, 0])
    for x in column[lost].tolist():
        draw.line((x, top + 34, x, top + BAND - 16), fill=GAP, width=2)
    for level in (-1.0, 0.0, 1.0, 2.0):
        draw.line((MARGIN, row(level), WIDTH - 20, row(level)), fill=RULE, width=1)
        draw.text((18, row(level) - 9), f"{level:.0f}", fill=INK, font=font)
    for k, (name, colour) in enumerate(AXES.items()):
        for first, last in pairwise(range(len(column))):
            if not lost[first] and not lost[last]:
                ends = [(column[n], row(values[n, k])) for n in (first, last)]
                draw.line(ends, fill=colour, width=2)
        draw.text((WIDTH - 110 + 30 * k, top + 8), name, fill=colour, font=font)
    draw.text((MARGIN, top + 8), title, fill=INK, font=font)


def _watches(draw: ImageDraw.ImageDraw, font, top: int, time: np.ndarray, R: torch.Tensor, world: torch.Tensor) -> None:
    """The watch's axes at some moments, seen from aside and above, and the smoothed force (black)."""
    draw.text(
        (MARGIN, top + 8),
        "the watch's axes, z up in the picture; black: the force that holds it (1 g as long as an axis)",
        fill=INK,
        font=font,
    )
    view = rotation.about_axis("x", torch.tensor(-0.4)) @ rotation.about_axis("z", torch.tensor(0.6))
    there = np.flatnonzero(world.isfinite().all(-1).numpy())
    for number, frame in enumerate(there[np.linspace(0, len(there) - 1, WATCHES).astype(int)].tolist()):
        middle = np.array([MARGIN + 70 + number * (WIDTH - 2 * MARGIN) / WATCHES, top + 165])
        around = world[max(frame - 7, 0) : frame + 8].nanmean(0)
        arrows = [(R[frame, :, k], colour) for k, colour in enumerate(AXES.values())] + [(around, UP)]
        for vector, colour in arrows:
            seen = (view @ vector).numpy()
            tip = middle + 62 * np.array([seen[0], -seen[2]])
            draw.line((*middle, *tip), fill=colour, width=4)
        draw.text((middle[0] - 16, top + BAND + 8), f"{time[frame]:.1f} s", fill=INK, font=font)


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except WearcapError as error:
        sys.exit(f"error: {error}")
