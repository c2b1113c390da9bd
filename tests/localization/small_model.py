"""A COLMAP model as text: a camera that walks past points, which it sees where they really are."""

from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

WIDTH, HEIGHT, FOCAL = 160, 120, 150.0


def camera_path(count: int) -> tuple[np.ndarray, Rotation]:
    """Positions and orientations of an OpenCV camera in the model's world."""
    t = np.stack([0.2 * np.arange(count), 0.1 * np.sin(np.arange(count)), np.zeros(count)], 1)
    return t, Rotation.from_rotvec(0.02 * np.arange(count)[:, None] * [[0, 1, 0]])


def write_model(folder: Path, names: list[str], *, missing: tuple[int, ...] = (), error_px: float = 0.0) -> np.ndarray:
    """Write cameras, images and points3D of pictures, but for those of `missing` numbers; returns the points."""
    folder.mkdir(parents=True, exist_ok=True)
    points = np.random.default_rng(0).uniform([-1, -1, 4], [4, 1, 6], (60, 3))
    t, R = camera_path(len(names))
    (folder / "cameras.txt").write_text(f"1 PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} {WIDTH / 2} {HEIGHT / 2}\n")
    lines = []
    for k, name in enumerate(names):
        if k in missing:
            continue
        T = R[k].inv()
        seen = T.apply(points - t[k])
        pixels = seen[:, :2] / seen[:, 2:] * FOCAL + [WIDTH / 2, HEIGHT / 2]
        inside = ((pixels > 5) & (pixels < [WIDTH - 5, HEIGHT - 5])).all(1)
        pose = [*T.as_quat()[[3, 0, 1, 2]], *(-T.apply(t[k]))]
        lines.append(" ".join(map(str, [k + 1, *pose, 1, name])))
        lines.append(" ".join(f"{x + error_px} {y} {n + 1}" for n, (x, y) in enumerate(pixels) if inside[n]))
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    rows = [f"{n + 1} {x} {y} {z} 10 20 30 0.5" for n, (x, y, z) in enumerate(points)]
    (folder / "points3D.txt").write_text("\n".join(rows) + "\n")
    return points


def write_pictures(folder: Path, count: int) -> list[str]:
    """Grey pictures of the model's size."""
    folder.mkdir(parents=True, exist_ok=True)
    names = [f"p{k:03d}.jpg" for k in range(count)]
    for name in names:
        Image.new("RGB", (WIDTH, HEIGHT), "grey").save(folder / name)
    return names
