"""Camera calibration from images of a checkerboard: OpenCV's model with two radial and two tangential coefficients.

The thesis uses this model (§4.3.3) without details; the selection and rejection of views is ours.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, UInt8

from wearcap.errors import WearcapError
from wearcap.extras import at_first_use
from wearcap.geometry.camera import Camera

cv2 = at_first_use("cv2", "calibration")

_SEARCH_WIDTH = 960
"""Width (pixels) to which images are reduced for the board search; corners are refined in the full image."""
_CELLS = (8, 6)
"""Columns and rows of the picture's cells in which corners are counted for the coverage."""
_HINT_FRAMES = 12


@dataclass(frozen=True)
class _View:
    """Detection of the board in one image."""

    name: str
    corners: Float32[np.ndarray, "point 2"]
    """Pixels, row by row (from either end: a checkerboard may be turned by half a turn)."""
    blur_px: float
    """Mean length over which the squares' edges rise."""
    rms_px: float = np.nan
    """Residual after calibration; NaN before."""


@dataclass(frozen=True)
class Board:
    """A checkerboard by its inner corners, where four squares meet: one fewer than squares each way."""

    columns: int
    rows: int
    square_m: float | int

    def __post_init__(self):
        if min(self.columns, self.rows) < 3 or not self.square_m > 0:
            what = f"a board of {self.columns}x{self.rows} inner corners and squares of {self.square_m} m"
            raise WearcapError(what, expected="at least 3x3 inner corners, and a positive size in metres")

    @property
    def points(self) -> Float32[np.ndarray, "point 3"]:
        """Corners on the board (m, z = 0), row by row."""
        y, x = np.mgrid[: self.rows, : self.columns]
        return (np.stack([x, y, 0 * x], -1).reshape(-1, 3) * self.square_m).astype(np.float32)

    def __str__(self) -> str:
        return f"{self.columns}x{self.rows}"

    def find(self, gray: UInt8[np.ndarray, "height width"], name: str = "") -> _View | None:
        """Corners of the whole board in a grey picture, refined to a fraction of a pixel; None where it is not seen."""
        shrink = max(1.0, gray.shape[1] / _SEARCH_WIDTH)
        small = (
            gray if shrink == 1 else cv2.resize(gray, None, fx=1 / shrink, fy=1 / shrink, interpolation=cv2.INTER_AREA)
        )
        pattern = (self.columns, self.rows)
        found, corners = cv2.findChessboardCornersSB(small, pattern, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
        if not found:
            return None
        corners = (corners.reshape(-1, 2) + 0.5) * shrink - 0.5
        grid = corners.reshape(self.rows, self.columns, 2)
        step = min(np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min() for axis in (0, 1))
        reach = int(np.clip(step / 3, 2, 11))  # the window must not reach into the next corner
        stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-3)
        corners = cv2.cornerSubPix(gray, corners.astype(np.float32).reshape(-1, 1, 2), (reach, reach), (-1, -1), stop)
        blur = cv2.estimateChessboardSharpness(gray, pattern, corners)[0][0]
        return _View(name, corners.reshape(-1, 2), float(blur))


@dataclass(frozen=True)
class CalibrationSettings:
    """Number of views, and limits of their quality."""

    max_views: int = 40
    """Largest number of views: the most varied of the sharp ones are used."""
    min_views: int = 8
    max_blur_px: float | int = 4.0
    """Edges of squares that rise over more pixels than this are blurred, unless hardly any are sharper."""
    outlier_ratio: float | int = 2.5
    """Multiple of the median residual above which a view is rejected, if it also exceeds `outlier_px`."""
    outlier_px: float | int = 0.3
    """Smallest residual (RMS, pixels) of a rejected view."""
    max_focal_spread: float | int = 0.02
    """Largest standard deviation of a focal length, as a share of it."""
    min_tilt_deg: float | int = 8.0
    """Smallest tilt of the boards from their mean direction; with less the focal length is not observable."""


@dataclass(frozen=True)
class Calibration:
    """A calibrated camera with quality measures."""

    camera: Camera
    rms_px: float
    """Root mean square residual over all corners of the used views."""
    focal_std_px: float
    """The larger standard deviation of the two focal lengths."""
    coverage: float
    """Share of the picture's 8 x 6 cells in which corners were seen; distortion is extrapolated in the others."""
    views: tuple[_View, ...]
    rejected: tuple[_View, ...] = ()
    """Views whose residual was too large."""
    seen: int = 0
    """Number of images in which the board was found, before the selection."""
    examined: int = 0


def calibrate_from_pictures(
    pictures: Iterable[tuple[str, UInt8[np.ndarray, "height width 3"]]],
    board: Board,
    settings: CalibrationSettings = CalibrationSettings(),
) -> Calibration:
    """Calibrate from named RGB pictures (all of one size), of which some show the board.

    Raises WearcapError when no picture shows it (saying what was tried), for pictures of several sizes, for too few
    views, and for views that leave the focal length open (all of them frontal, say).
    """
    views, missed = [], []
    size, examined = None, 0
    for name, picture in pictures:
        examined += 1
        size = size or (picture.shape[1], picture.shape[0])
        if (picture.shape[1], picture.shape[0]) != size:
            what = f"{picture.shape[1]}x{picture.shape[0]} pixels"
            expected = f"{size[0]}x{size[1]}, as the pictures before"
            raise WearcapError(what, where=name, expected=expected, fix="Calibrate each resolution by itself.")
        gray = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
        view = board.find(gray, name)
        if view is not None:
            views.append(view)
        elif not views and len(missed) < _HINT_FRAMES:
            missed.append(gray)
    if size is None:
        raise WearcapError("no pictures to calibrate from", expected="a video, or a folder of pictures")
    if not views:
        # The fix suggests another count of corners if that one is found.
        fix = "Count inner corners, not squares; show the whole board with a white margin, evenly lit and in focus."
        for wider, higher in ((-1, -1), (1, 1), (-1, 0), (0, -1)):
            columns, rows = board.columns + wider, board.rows + higher
            if min(columns, rows) < 3:
                continue
            other = replace(board, columns=columns, rows=rows)
            if any(other.find(gray) for gray in missed):
                fix = f"A board of {columns}x{rows} inner corners was found: give columns={columns} rows={rows}."
                break
        what = f"no board of {board} inner corners in {examined} pictures of {size[0]}x{size[1]} pixels"
        raise WearcapError(what, expected="a checkerboard, seen as a whole", fix=fix)
    sharp = [view for view in views if view.blur_px <= settings.max_blur_px]
    chosen = varied(sharp if len(sharp) >= settings.min_views else views, size, settings.max_views)
    return replace(_calibrated(chosen, board, size, settings), seen=len(views), examined=examined)


def varied(views: Sequence[_View], size: tuple[int, int], count: int) -> list[_View]:
    """Up to `count` views that differ most in position, size and tilt, by farthest-point sampling from the sharpest."""
    appearances = []
    for view in views:
        # Place (shares of the picture), size (log of its share), and the projective part of the view: how it is tilted
        side = float(max(size))
        centred = (view.corners.astype(np.float64) - view.corners.mean(0)) / side
        spread = np.sqrt((centred**2).sum(1).mean())
        skew = (centred**3).mean(0) / spread**3  # perspective makes the near half of the board larger
        shape = np.linalg.svd(centred, compute_uv=False)
        appearances.append([*(view.corners.mean(0) / size), np.log(spread), shape[1] / shape[0], *(3 * skew)])
    appearance = np.array(appearances)
    chosen = [int(np.argmin([view.blur_px for view in views]))]
    distance = np.linalg.norm(appearance - appearance[chosen[0]], axis=1)
    while len(chosen) < min(count, len(views)):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(appearance - appearance[chosen[-1]], axis=1))
    return [views[k] for k in sorted(chosen)]


def _calibrated(views: list[_View], board: Board, size: tuple[int, int], settings: CalibrationSettings) -> Calibration:
    """Calibrate, reject views with large residuals, calibrate again, until all agree."""
    rejected: list[_View] = []
    while True:
        if len(views) < settings.min_views:
            what = f"{len(views)} good views of the {board} board ({len(rejected)} rejected for their residuals)"
            fix = "Film it slowly, from near and far, tilted to all sides, into the picture's corners."
            raise WearcapError(what, expected=f"at least {settings.min_views}", fix=fix)
        points = [view.corners.reshape(-1, 1, 2) for view in views]
        rms, K, bent, turns, _, spread, _, residuals = cv2.calibrateCameraExtended(
            [board.points] * len(views), points, size, None, None, flags=cv2.CALIB_FIX_K3
        )
        views = [replace(view, rms_px=float(r)) for view, r in zip(views, residuals[:, 0])]
        limit = max(settings.outlier_px, settings.outlier_ratio * float(np.median(residuals)))
        bad = [view for view in views if view.rms_px > limit]
        if not bad:
            break
        rejected += bad
        views = [view for view in views if view.rms_px <= limit]
    # How far the boards' normals lie from their mean: the 90th percentile of the angles.
    normals = np.stack([cv2.Rodrigues(turn)[0][:, 2] for turn in turns])
    normals *= np.sign(normals[:, 2:])  # a board has no up
    mean = normals.mean(0) / np.linalg.norm(normals.mean(0))
    tilt_deg = float(np.degrees(np.quantile(np.arccos((normals @ mean).clip(-1, 1)), 0.9)))
    focal_std = float(max(spread[0, 0], spread[1, 0]))
    open_focal = focal_std > settings.max_focal_spread * K[0, 0] or tilt_deg < settings.min_tilt_deg
    if not np.isfinite(K).all() or open_focal:
        raise WearcapError(
            f"the views leave the focal length open ({K[0, 0]:.0f} ± {focal_std:.1f} px, boards tilted by {tilt_deg:.1f}°)",
            expected=f"a deviation below {100 * settings.max_focal_spread:g} %, tilts of {settings.min_tilt_deg:g}°",
            fix="Tilt the board: views from straight ahead do not tell focal length from distance.",
        )
    lens = map(float, (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    camera = Camera("opencv", *size, *lens, tuple(map(float, bent.ravel()[:4])))
    corners = np.concatenate([view.corners for view in views])
    cells = np.floor(corners / size * _CELLS).astype(int).clip(0, np.array(_CELLS) - 1)
    coverage = len(np.unique(cells, axis=0)) / (_CELLS[0] * _CELLS[1])
    return Calibration(camera, float(rms), focal_std, coverage, tuple(views), tuple(rejected))
