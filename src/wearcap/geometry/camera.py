"""Camera models: projection of points in camera axes (OpenCV: x right, y down, z forward) to pixels, and its inverse.

Every model projects a point to `focal * lens(m) + centre`. The plane coordinates m are (x/z, y/z) for "pinhole" and
"opencv", and the direction's angle θ from the optical axis along (x, y) for the fisheyes.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.errors import WearcapError, require_choice

_COEFFICIENTS = {"pinhole": (0,), "opencv": (4, 5), "fisheye": (4,), "fisheye624": (12,), "ocam": (13,)}


class _LensTerms(NamedTuple):
    """Distortion coefficients of a camera by their role."""

    radial: tuple[float, ...]
    tangential: tuple[float, float]
    """OpenCV's (p2, p1); Project Aria's in the file's order."""
    prism: tuple[float, ...]
    affine: tuple[float, float, float]
    """OCamCalib's (e, d, c)."""
    fold: float
    """Square of the largest undistorted radius (or angle) up to which the radial polynomial is increasing."""


@dataclass(frozen=True)
class Camera:
    """Intrinsics of a camera; lengths in pixels, pixel centres at integers."""

    model: str
    """"pinhole" (no distortion), "opencv" (k1 k2 p1 p2 [k3]), "fisheye" (equidistant, k1…k4), "fisheye624"
    (Project Aria: k0…k5, p0 p1, s0…s3) or "ocam" (Scaramuzza's fisheye: affine c d e, then k1…k10 of
    θ + k1 θ² + … + k10 θ¹¹; io/formats/ocamcalib.py makes them from OCamCalib's polynomials)."""
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()

    def __post_init__(self):
        require_choice(self.model, _COEFFICIENTS, f"no camera model {self.model!r}")
        if len(self.distortion) not in _COEFFICIENTS[self.model]:
            counts = " or ".join(map(str, _COEFFICIENTS[self.model]))
            raise WearcapError(f"camera model {self.model!r} with {len(self.distortion)} coefficients", expected=counts)
        if not (self.width > 0 and self.height > 0 and self.fx > 0 and self.fy > 0):
            what = f"camera of {self.width}x{self.height} pixels with focal lengths {self.fx}, {self.fy}"
            raise WearcapError(what, expected="positive numbers")

    @classmethod
    def pinhole(cls, width: int, height: int, vertical_fov_deg: float) -> "Camera":
        """A centred pinhole camera with square pixels."""
        focal = height / 2 / math.tan(math.radians(vertical_fov_deg) / 2)
        return cls("pinhole", width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)

    @property
    def is_fisheye(self) -> bool:
        """Whether the model projects angles, so that points beside and behind the lens may be visible."""
        return self.model == "ocam" or self.model.startswith("fisheye")

    def scaled(self, width: int, height: int) -> "Camera":
        """The camera for images resized to width x height pixels."""
        x, y = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * x,
            fy=self.fy * y,
            cx=(self.cx + 0.5) * x - 0.5,
            cy=(self.cy + 0.5) * y - 0.5,
        )

    def project(
        self, points_cam: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        """Pixels (x, y) of points, and a mask of valid ones: in front of the lens, in its monotone range, in the image.

        Differentiable in the points. Invalid pixels are finite but meaningless.
        """
        xy, z = points_cam[..., :2], points_cam[..., 2]
        if self.is_fisheye:
            square = (xy**2).sum(-1)
            on_axis = square < 1e-18
            radius = torch.where(on_axis, 1.0, square).sqrt()
            theta = torch.atan2(radius, z)
            scale = torch.where(on_axis, 1 / torch.where(z.abs() < 1e-9, 1.0, z), theta / radius)
            plane, behind = xy * scale[..., None], on_axis & (z <= 0)
            seen = ~behind & (torch.where(on_axis, 0.0, theta) ** 2 < self.lens_terms.fold)
        else:
            ahead = z > 1e-6
            plane = xy / torch.where(ahead, z, 1.0)[..., None]
            seen = ahead & ((plane**2).sum(-1) < self.lens_terms.fold)
        distorted, _ = self._lens(plane)
        pixels = distorted * plane.new_tensor([self.fx, self.fy]) + plane.new_tensor([self.cx, self.cy])
        x, y = pixels.unbind(-1)
        inside = (x >= -0.5) & (x < self.width - 0.5) & (y >= -0.5) & (y < self.height - 0.5)
        return pixels, seen & inside

    def unproject(self, pixels: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 3"]:
        """Unit rays of pixels in camera axes; NaN where the lens maps no direction to a pixel.

        Newton's method on the lens; differentiable in the pixels (with the exact derivative of the inverse).
        """
        target = (pixels - pixels.new_tensor([self.cx, self.cy])) / pixels.new_tensor([self.fx, self.fy])
        plane = target
        if self.model != "pinhole":
            with torch.no_grad():
                limit, root = min(0.999 * math.sqrt(self.lens_terms.fold), 1e3), target.detach()
                for _ in range(25):
                    root = root * (limit / root.norm(dim=-1, keepdim=True).clamp(min=limit))
                    value, jacobian = self._lens(root)
                    root = root - torch.linalg.solve_ex(jacobian, value - target)[0]
                close = ((self._lens(root)[0] - target).abs() < 1e4 * torch.finfo(target.dtype).eps).all(-1)
                found = close & ((root**2).sum(-1) < self.lens_terms.fold)
                root = torch.where(found[..., None], root, torch.zeros_like(root))
                step = torch.linalg.inv(self._lens(root)[1])
                rest = self._lens(root)[0]
            plane = root + (step @ (target - rest)[..., None])[..., 0]
            plane = torch.where(found[..., None], plane, torch.nan)
        if not self.is_fisheye:
            ray = torch.cat([plane, torch.ones_like(plane[..., :1])], -1)
            return torch.nn.functional.normalize(ray, dim=-1)
        square = (plane**2).sum(-1, keepdim=True)
        small = square < 1e-12
        theta = torch.where(small, 1.0, square).sqrt()
        sinc = torch.where(small, 1 - square / 6, theta.sin() / theta)
        return torch.cat([plane * sinc, torch.where(small, 1 - square / 2, theta.cos())], -1)

    def _lens(self, plane: Float[Tensor, "*batch 2"]) -> tuple[Tensor, Tensor]:
        """Distorted plane coordinates "*batch 2" and their Jacobian "*batch 2 2"."""
        terms, of_square = self.lens_terms, self.model != "ocam"
        # bent = plane (1 + k1 s + k2 s² + …), s = |plane|² or, not `of_square`, |plane|
        s = (plane**2).sum(-1, keepdim=True) if of_square else plane.norm(dim=-1, keepdim=True)
        gain, slope = torch.zeros_like(s), torch.zeros_like(s)
        for k in reversed((1.0, *terms.radial)):
            slope = slope * s + gain
            gain = gain * s + k
        identity = torch.eye(2, dtype=plane.dtype, device=plane.device)
        along = 2 * slope if of_square else slope / s.clamp(min=torch.finfo(plane.dtype).tiny)
        d_bent = gain[..., None] * identity + along[..., None] * plane[..., :, None] * plane[..., None, :]
        bent = plane * gain
        if self.model == "ocam":
            e, d, c = terms.affine
            affine = plane.new_tensor([[1.0, e], [d, c]])  # OCamCalib counts rows first, we count columns first
            return bent @ affine.T, affine @ d_bent
        if self.model == "opencv":  # the tangential term sees the undistorted point
            shift, d_shift = _tangential(plane, terms.tangential)
            return bent + shift, d_bent + d_shift
        shift, d_shift = _tangential(bent, terms.tangential)
        # Thin prism: (s0 s + s1 s², s2 s + s3 s²), s = |bent|².
        s = (bent**2).sum(-1, keepdim=True)
        first, second = bent.new_tensor(terms.prism[0::2]), bent.new_tensor(terms.prism[1::2])
        tilt = first * s + second * s**2
        d_tilt = (2 * first + 4 * second * s)[..., :, None] * bent[..., None, :]
        return bent + shift + tilt, (identity + d_shift + d_tilt) @ d_bent

    @cached_property
    def lens_terms(self) -> "_LensTerms":
        """The coefficients by their role, those that the model lacks as zeros."""
        d = self.distortion
        radial, tangential, prism, affine = d, (0.0, 0.0), (0.0,) * 4, (0.0, 0.0, 1.0)
        if self.model == "opencv":
            radial, tangential = (*d[:2], *d[4:]), (d[3], d[2])
        elif self.model == "fisheye624":
            radial, tangential, prism = d[:6], (d[6], d[7]), d[8:]
        elif self.model == "ocam":
            radial, affine = d[3:], (d[2], d[1], d[0])
        step = 1 if self.model == "ocam" else 2  # a polynomial of the radius, else of its square
        slope = [1.0, *((step * (i + 1) + 1) * k for i, k in enumerate(radial))]
        rising = [r.real ** (2 / step) for r in np.roots(slope[::-1]) if abs(r.imag) < 1e-9 and r.real > 0]
        return _LensTerms(
            radial, tangential, prism, affine, min([math.pi**2 if self.is_fisheye else math.inf, *rising])
        )


def _tangential(m: Tensor, coefficients: tuple[float, float]) -> tuple[Tensor, Tensor]:
    """2 (q·m) m + |m|² q, and its Jacobian; OpenCV's q is (p2, p1)."""
    q = m.new_tensor(coefficients)
    along = (m * q).sum(-1, keepdim=True)
    identity = torch.eye(2, dtype=m.dtype, device=m.device)
    outer = m[..., :, None] * q + q[:, None] * m[..., None, :]
    return 2 * along * m + (m**2).sum(-1, keepdim=True) * q, 2 * (outer + along[..., None] * identity)
