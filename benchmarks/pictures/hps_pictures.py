"""Pictures beside HPS' tables: paths from above over the scan, error over distance, feet on the scanned floor."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from benchmarks.rivals.hps_scores import HpsTruth, nearest_frames
from benchmarks.tables.hps_sessions import Session
from benchmarks.tables.simulated_depth_rig import look_at
from wearcap.body.anny_body import anny_body
from wearcap.body.model import FOOT_REGIONS
from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.geometry.camera import Camera
from wearcap.geometry.mesh import Mesh
from wearcap.geometry.render import Light, Splats, render
from wearcap.geometry.rigid import Rigid
from wearcap.recording import Motion
from wearcap.viewer.picture import captioned, save_png

COLORS = {
    "IMU": (200, 60, 50), "IMU + Cam": (235, 160, 60), "IMU + Cam (filtered)": (150, 110, 190),
    "HPS w/o scene": (90, 160, 200), "HPS": (30, 90, 190), "ours": (20, 140, 70), "truth": (20, 20, 20),
}  # fmt: skip
CELL_M = 0.05
FRAME_M = 2.0
"""Of the picture around the true path."""
FEET = ("truth", "IMU + Cam (filtered)", "HPS w/o scene", "HPS", "ours")
TILE = (300, 190)
SPLAT_M = 0.01


def _font(size: int) -> Any:
    return ImageFont.load_default(size=size)


def draw_paths(path: Path, session: Session, truth: HpsTruth, motions: dict[str, Motion], width: int = 1800) -> None:
    """Roots from above over the scan: where the wearer went, and where each row believes that; the camera as dots."""
    ways = {"truth": truth.motion, **motions}
    true = truth.motion.t_world_root[:, :2].double().numpy()
    low, high = true.min(0) - FRAME_M, true.max(0) + FRAME_M
    scale = width / (high - low)[0]
    picture = Image.fromarray(_plan(session.scan.points, low, high)).resize(
        (width, round((high - low)[1] * scale)), Image.Resampling.BILINEAR
    )
    draw = ImageDraw.Draw(picture)

    def pixels(motion: Motion) -> list[tuple[float, float]]:
        place = (motion.t_world_root[:, :2].double().numpy() - low) * scale
        return [(float(x), float(picture.height - y)) for x, y in place]

    for x, y in pixels(motions["IMU + Cam"])[::3]:
        draw.ellipse((x - 1.5, y - 1.5, x + 1.5, y + 1.5), fill=COLORS["IMU + Cam"])
    shown = ("IMU", "IMU + Cam (filtered)", "truth", "ours")
    for name in shown:
        draw.line(pixels(ways[name]), fill=COLORS[name], width=5 if name == "truth" else 2, joint="curve")
    for row, name in enumerate((*shown, "IMU + Cam")):
        draw.rectangle((12, 12 + 24 * row, 40, 26 + 24 * row), fill=COLORS[name])
        draw.text(
            (48, 9 + 24 * row),
            f"{name}{' (every third frame)' * (name == 'IMU + Cam')}",
            fill=(20, 20, 25),
            font=_font(18),
        )
    draw.line((12, picture.height - 20, 12 + 5 * scale, picture.height - 20), fill=(20, 20, 25), width=4)
    draw.text((14, picture.height - 46), "5 m", fill=(20, 20, 25), font=_font(18))
    save_png(path, np.asarray(picture))


def _plan(
    points: Float[np.ndarray, "point 3"], low: Float[np.ndarray, "2"], high: Float[np.ndarray, "2"]
) -> UInt8[np.ndarray, "row column 3"]:
    """The scan from above: the more points above each other, the darker."""
    cells = np.ceil((high - low) / CELL_M).astype(int)
    place = np.floor((points[:, :2] - low) / CELL_M).astype(int)
    inside = ((place >= 0) & (place < cells)).all(1)
    count = np.bincount(place[inside] @ [cells[1], 1], minlength=cells.prod()).reshape(cells).T[::-1]
    dark = np.log1p(count) / np.log1p(np.quantile(count, 0.99))
    grey = 255 - 130 * np.clip(dark, 0, 1) ** 2.5
    return np.repeat(grey.astype(np.uint8)[..., None], 3, axis=2)


def draw_drift(path: Path, drifts: dict[str, Sequence[dict[str, Any]]], size: tuple[int, int] = (1200, 700)) -> None:
    """Mean root error of every row over the way, on a logarithmic axis; bands: least and largest over seeds."""
    width, height = size
    left, right, top, bottom = 80, width - 240, 30, height - 70
    longest = max(drift["distance_m"][-1] for row in drifts.values() for drift in row) + 10
    decades = (-1.0, 3.0)
    picture = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(picture, "RGBA")

    def place(distance: float, error_cm: float) -> tuple[float, float]:
        share = (np.log10(max(error_cm, 0.1)) - decades[0]) / (decades[1] - decades[0])
        return left + (right - left) * distance / longest, bottom - (bottom - top) * float(share)

    for decade in range(int(decades[0]), int(decades[1]) + 1):
        y = place(0, 10.0**decade)[1]
        draw.line((left, y, right, y), fill=(215, 215, 220), width=1)
        draw.text((left - 62, y - 11), f"{10.0**decade:g}", fill=(40, 40, 45), font=_font(18))
    for distance in range(0, int(longest), 50):
        x = place(distance, 0.1)[0]
        draw.line((x, top, x, bottom), fill=(235, 235, 240), width=1)
        draw.text((x - 14, bottom + 8), str(distance), fill=(40, 40, 45), font=_font(18))
    draw.text((left, 4), "root error (cm)", fill=(40, 40, 45), font=_font(18))
    draw.text(((left + right) / 2 - 60, bottom + 36), "way travelled (m)", fill=(40, 40, 45), font=_font(18))
    for number, (row, seeds) in enumerate(drifts.items()):
        shared = min(len(seed["distance_m"]) for seed in seeds)
        error = np.array([seed["error_cm"][:shared] for seed in seeds])
        distance = seeds[0]["distance_m"][:shared]
        band = [place(*p) for p in zip(distance, error.min(0))]
        band += [place(*p) for p in zip(distance, error.max(0))][::-1]
        if len(seeds) > 1:
            draw.polygon(band, fill=(*COLORS[row], 40))
        draw.line([place(*p) for p in zip(distance, error.mean(0))], fill=COLORS[row], width=3)
        draw.rectangle((right + 20, top + 30 * number, right + 44, top + 16 + 30 * number), fill=COLORS[row])
        draw.text((right + 52, top - 3 + 30 * number), row, fill=(20, 20, 25), font=_font(18))
    save_png(path, np.asarray(picture))


def draw_feet(path: Path, session: Session, truth: HpsTruth, motions: dict[str, Motion], count: int = 4) -> None:
    """Left feet that stand, seen level with the floor, over the scan's points: a column per row of the tables."""
    shown = {"truth": truth.motion, **motions}
    touching = truth.true_contact[:, [FOOT_PATCHES.index(p) for p in ("left_heel", "left_toe_tip")]].all(1)
    standing = torch.nonzero(touching)[:, 0]
    chosen = standing[((torch.arange(count) + 0.5) / count * len(standing)).long()].tolist()
    width, height = TILE
    sheet = Image.new("RGB", (width * len(FEET), height * count), "white")
    for row, frame in enumerate(chosen):
        foot = truth.body.vertices(truth.motion.T_world_joint[frame], FOOT_REGIONS["left_heel"]).mean(0)
        toes = truth.body.vertices(truth.motion.T_world_joint[frame], FOOT_REGIONS["left_toe_tip"]).mean(0)
        views = _beside((foot + toes).double().numpy() / 2, (toes - foot).double().numpy())
        for column, name in enumerate(FEET):
            same = int(nearest_frames(shown[name].timestamps, truth.motion.timestamps[frame : frame + 1]))
            image = _foot(session, truth, shown[name], same, *views)
            seconds = truth.motion.timestamps[frame]
            text = f"{name}  {seconds:.1f} s" if row == 0 else f"{seconds:.1f} s"
            sheet.paste(captioned(image, text), (width * column, height * row))
    save_png(path, np.asarray(sheet))


def _beside(middle: Float[np.ndarray, "3"], along: Float[np.ndarray, "3"]) -> tuple[Rigid, Float[np.ndarray, "3"]]:
    """A camera beside a foot, a hand's breadth above the floor, and the foot's middle."""
    side = np.array([-along[1], along[0], 0.0])
    position = middle + 0.75 * side / np.linalg.norm(side) + [0.0, 0.0, 0.07]
    return look_at(position[None], middle + np.array([0.0, 0.0, 0.04]))[0], middle


def _foot(
    session: Session, truth: HpsTruth, motion: Motion, frame: int, T_world_cam: Rigid, middle: np.ndarray
) -> UInt8[np.ndarray, "height width 3"]:
    captured = anny_body(motion.skeleton, truth.shape)
    vertices = captured.vertices(motion.T_world_joint[frame]).numpy().astype(np.float32)
    body = Mesh(
        vertices, truth.body.faces.numpy().astype(np.int32), np.array([0.55, 0.65, 0.8], np.float32), smooth=True
    )
    near = (np.abs(session.scan.points - middle) < 0.45).all(1)
    colors = session.scan.colors
    color = np.full(3, 0.6, np.float32) if colors is None else (colors[near] / 255).astype(np.float32)
    floor = Splats(session.scan.points[near], color, SPLAT_M, metric=True)
    camera = Camera.pinhole(*TILE, 30.0)
    towards = T_world_cam.t.numpy() - middle
    light = Light(to_light=(float(towards[0]), float(towards[1]), 0.7))
    return render(camera, T_world_cam, [body], [floor], light=light, supersample=2).color
