"""What the rigidity does: a path bent to few control points with four values of λ (thesis Fig. 5.6).

python -m benchmarks.pictures.bending_picture [FILE]
"""

import sys
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont

from wearcap.apps.viewer.picture import save_png
from wearcap.systems.ireplica.trajectory import Bending, BentPath, bend
from wearcap.systems.ireplica.trajectory_banded import bend_banded

RIGIDITIES = (1000.0, 30.0, 3.0, 0.1)
PANEL = (760, 560)
ORIGINAL, RESULT, CONTROL, INK = (128, 70, 170), (30, 150, 80), (240, 140, 30), (40, 40, 45)
SCALE = 60.0
"""Pixels per metre."""
FPS = 30


def example() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """A walk of 30 s in curves (m), its timestamps, and six points (and times) of one of other headings."""
    timestamps = torch.arange(30 * FPS + 1, dtype=torch.float64) / FPS
    since = timestamps[1:]
    heading = 1.25 * torch.sin(2 * np.pi * since / 15.0)
    times = torch.tensor([5.0, 10.0, 14.0, 19.0, 25.0, 29.0], dtype=torch.float64)
    true = walk(heading + 0.5 * torch.sin(2 * np.pi * since / 11.0) + 0.02 * since)
    return walk(heading), timestamps, times, true[(times * FPS).long()]


def walk(heading: torch.Tensor) -> torch.Tensor:
    """A path of 0.55 m/s from the origin (m)."""
    step = torch.stack([heading.cos(), heading.sin()], -1) * 0.55 / FPS
    return torch.cat([torch.zeros(1, 2, dtype=torch.float64), step.cumsum(0)])


def main(arguments: list[str]) -> None:
    path, timestamps, times, points = example()
    width, height = PANEL
    sheet = Image.new("RGB", (2 * width, 2 * height), "white")
    for number, rigidity in enumerate(RIGIDITIES):
        solved = bend(path, timestamps, times, points, settings=Bending(rigidity), solver=bend_banded)
        place = (width * (number % 2), height * (number // 2))
        sheet.paste(panel(path.numpy(), points.numpy(), solved, times, rigidity), place)
    draw = ImageDraw.Draw(sheet)
    draw.line((width, 0, width, 2 * height), fill=(225, 225, 230), width=2)
    draw.line((0, height, 2 * width, height), fill=(225, 225, 230), width=2)
    save_png(Path(arguments[0] if arguments else "docs/ireplica_bending.png"), np.asarray(sheet))


def panel(
    path: Float[np.ndarray, "time 2"],
    points: Float[np.ndarray, "control 2"],
    solved: BentPath,
    times: torch.Tensor,
    rigidity: float,
) -> Image.Image:
    """One rigidity: the path before (purple) and after (green), control points (orange) and how far off they are."""
    image = Image.new("RGB", PANEL, "white")
    draw = ImageDraw.Draw(image)

    def pixels(places: np.ndarray) -> list[tuple[float, float]]:
        return [(50 + SCALE * float(x), PANEL[1] - 150 - SCALE * float(y)) for x, y in places]

    bent = solved.path.numpy()
    passed = bent[(times * FPS).long().numpy()]
    for there, wanted in zip(pixels(passed), pixels(points)):
        draw.line((*there, *wanted), fill=(170, 170, 175), width=2)
    draw.line(pixels(path), fill=ORIGINAL, width=4, joint="curve")
    draw.line(pixels(bent), fill=RESULT, width=5, joint="curve")
    for x, y in pixels(passed):
        draw.ellipse((x - 4, y - 4, x + 4, y + 4), fill=RESULT)
    for x, y in pixels(points):
        draw.ellipse((x - 7, y - 7, x + 7, y + 7), fill=CONTROL)
    off = np.linalg.norm(passed - points, axis=1).mean()
    big, small = ImageFont.load_default(size=26), ImageFont.load_default(size=18)
    draw.text((24, 16), f"rigidity {rigidity:g}", fill=INK, font=big)
    draw.text((240, 22), f"{100 * off:.1f} cm off the points on average", fill=INK, font=small)
    draw.line((24, PANEL[1] - 24, 24 + SCALE, PANEL[1] - 24), fill=INK, width=3)
    draw.text((30 + SCALE, PANEL[1] - 36), "1 m", fill=INK, font=small)
    for row, (name, color) in enumerate((("original", ORIGINAL), ("bent", RESULT), ("control points", CONTROL))):
        draw.rectangle((180 + 150 * row, PANEL[1] - 32, 204 + 150 * row, PANEL[1] - 18), fill=color)
        draw.text((212 + 150 * row, PANEL[1] - 36), name, fill=INK, font=small)
    return image


if __name__ == "__main__":
    main(sys.argv[1:])
