"""OCamCalib's fisheye calibrations in NavVis' `sensor_frame.xml` (HPS and iReplica scans).

Scaramuzza's model maps a pixel at (row, column) to the direction (u, v, f(ρ)), f(ρ) = a₀ + a₁ρ + a₂ρ² + …, where
ρ² = u² + v² and [row; column] = [c d; e 1] [u; v] + [xc; yc], counted from 0. Its axes are u down the image, v along
it and w backwards (a₀ is negative): (v, u, -w) are OpenCV's. The file's second polynomial, in the angle
atan(w / √(u² + v²)), is a fit to the inverse of the first.
"""

from dataclasses import dataclass
from itertools import product
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from defusedxml.ElementTree import fromstring

from wearcap.boundary.opening import understood
from wearcap.boundary.texts import finite_floats, plain_xml, read_text, tag_of
from wearcap.errors import WearcapError
from wearcap.geometry.camera import Camera

_POWERS = 10
"""Number of coefficients (k1…k10): NavVis' lenses are fitted within 0.002 px at 4592 px width."""
_MAX_SIDE = 1 << 20
"""Largest width and height of an image (pixels)."""
_MAX_MISFIT_PX = 0.5
_MAX_DISAGREEMENT_PX = 3.0
"""Largest disagreement of a file's two polynomials, which are fits to each other."""
_COUNTS = {"world2cam": (2, 64), "cam2world": (3, 64)}


@dataclass(frozen=True)
class OCamModel:
    """A calibration in OCamCalib's own convention."""

    pol: tuple[float, ...]
    """Coefficients a₀, a₁ … of f(ρ) (pixels)."""
    invpol: tuple[float, ...]
    """Coefficients of ρ (pixels) in atan(w / √(u² + v²)), lowest power first; empty if the file has none."""
    row: float
    column: float
    """Position of the centre along the columns; `row` is its other coordinate (pixels, from 0)."""
    affine: tuple[float, float, float]
    """Affine parameters c, d, e."""
    width: int
    height: int

    def camera(self, where: str | Path = "OCamCalib model") -> Camera:
        """The camera of model "ocam" that sees as this one does, within `_MAX_MISFIT_PX`.

        Raises WearcapError when the polynomials are none of a lens, or contradict each other.
        """
        c, d, e = self.affine
        determinant = c - d * e
        if not (0 < self.width <= _MAX_SIDE and 0 < self.height <= _MAX_SIDE and 0.1 < determinant < 10):
            what = f"an image of {self.width}x{self.height} pixels with affine parameters {self.affine}"
            raise WearcapError(what, where, f"sizes of 1 to {_MAX_SIDE}, c near 1, d and e near 0")
        if not (0 <= self.row < self.height and 0 <= self.column < self.width):
            what = (
                f"its centre, row {self.row:g} and column {self.column:g}, is outside the image of "
                f"{self.height} rows and {self.width} columns"
            )
            raise WearcapError(what, where, "row first, then column")
        focal = -self.pol[0]
        if focal <= 0:
            what = f"its direct polynomial begins with {self.pol[0]:g}"
            raise WearcapError(what, where, "a negative number (the axis points backwards)")
        # Radii ρ (pixels) up to the image's furthest corner, and their angles θ from the axis (rad)
        corners = np.array([*product((0, self.height - 1), (0, self.width - 1))], np.float64)
        offset = corners - (self.row, self.column)
        u = (offset[:, 0] - d * offset[:, 1]) / determinant
        v = (c * offset[:, 1] - e * offset[:, 0]) / determinant
        rho = np.linspace(0, np.hypot(u, v).max(), 2000)
        theta = np.arctan2(rho, -np.polynomial.polynomial.polyval(rho, self.pol))
        falling = np.diff(theta) <= 0
        last = int(falling.argmax()) if falling.any() else len(rho) - 1
        # If the polynomial turns within the image, the lens's image circle is smaller than the picture.
        if last < len(rho) // 4:
            what = f"its direct polynomial turns back {rho[last]:.0f} px from the centre"
            raise WearcapError(what, where, "angles that rise with the radius")
        rho, theta = rho[: last + 1], theta[: last + 1]
        if self.invpol:
            disagreement = np.abs(np.polynomial.polynomial.polyval(theta - np.pi / 2, self.invpol) - rho)
            central = disagreement[theta < 0.8 * theta[-1]]
            if central.max() > _MAX_DISAGREEMENT_PX:
                what = f"its two polynomials differ by up to {central.max():.3g} px"
                raise WearcapError(what, where, "two fits of one lens")
        share = theta / theta[-1]  # powers of numbers up to 1 keep the system solvable
        exponents = np.arange(2, _POWERS + 2)
        basis = np.stack([share**power for power in exponents.tolist()], 1)
        solution = np.linalg.lstsq(basis, rho / focal - theta, rcond=None)[0]
        misfit_px = float(np.abs(basis @ solution + theta - rho / focal).max()) * focal
        if misfit_px > _MAX_MISFIT_PX:
            raise WearcapError(f"its polynomial is met only within {misfit_px:.2f} px", where, "a fisheye lens")
        powers = (solution / theta[-1] ** exponents).tolist()
        return Camera("ocam", self.width, self.height, focal, focal, self.column, self.row, (c, d, e, *powers))


def read_sensor_frame(path: str | Path) -> dict[str, OCamModel]:
    """Cameras of a NavVis `sensor_frame.xml` by name (cam0, cam1, …); `cx` there is the row, `cy` the column.

    Raises WearcapError for damaged XML, document types and entities, no cameras, and naming the camera for missing
    or wrong numbers.
    """
    text = read_text(path, "lens")
    with (
        understood("cannot be understood", path, "a sensor_frame.xml", errors=ValueError),
        plain_xml(path, "sensor_frame.xml"),
    ):
        root = fromstring(text, forbid_dtd=True)
    found: dict[str, OCamModel] = {}
    for element in (item for item in root.iter() if tag_of(item) == "CameraModel"):
        name = _text(element, "SensorName", path)
        where = f"{path}, camera {name!r}"
        lens, size = _child(element, "OCamModel"), _child(element, "ImageSize")
        if lens is None:
            continue  # other lens models are listed beside OCamCalib's
        if name in found:
            raise WearcapError("the camera is there twice", where)
        if size is None:
            raise WearcapError("no ImageSize", where, "ImageSize with Width and Height")
        polynomials = {}
        for part, (least, most) in _COUNTS.items():
            holder = _child(lens, part)
            coefficients = [] if holder is None else [item.text or "" for item in holder if tag_of(item) == "coeff"]
            if not least <= len(coefficients) <= most and (part == "cam2world" or coefficients):
                raise WearcapError(f"{part} with {len(coefficients)} coefficients", where, f"at least {least}")
            polynomials[part] = tuple(_number(item, part, where) for item in coefficients)
        c, d, e, cx, cy = (_number(_text(lens, part, where), part, where) for part in ("c", "d", "e", "cx", "cy"))
        width, height = (_number(_text(size, part, where), part, where) for part in ("Width", "Height"))
        found[name] = OCamModel(
            polynomials["cam2world"], polynomials["world2cam"], cx, cy, (c, d, e), int(width), int(height)
        )
    if not found:
        raise WearcapError("no cameras", path, "CameraModel elements with an OCamModel (NavVis)")
    return found


def _child(element: Element, name: str) -> Element | None:
    return next((item for item in element if tag_of(item) == name), None)


def _text(element: Element, name: str, where: str | Path) -> str:
    child = _child(element, name)
    if child is None or not (child.text or "").strip():
        raise WearcapError(f"no {name}", where, "NavVis' layout of sensor_frame.xml")
    return (child.text or "").strip()


def _number(text: str, name: str, where: str) -> float:
    with understood(name, where, "a number", errors=ValueError):
        return float(finite_floats([text])[0])
