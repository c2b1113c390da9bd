"""Body shape from height, weight, sex and build."""

from wearcap.body.skeleton import Skeleton, xsens23
from wearcap.errors import WearcapError

DENSITY = 1000.0
"""Density of a human body with half-full lungs (kg/m³)."""


def stature(skeleton: Skeleton) -> float:
    """Height (m) of a person with this skeleton, from soles to crown."""
    points = skeleton.rest_sites.values()
    top = max([skeleton.rest_joints[:, 2].max().item(), *(point[2].item() for point in points)])
    return top + skeleton.root_height


def skeleton_of_height(height_m: float, skeleton: Skeleton | None = None) -> Skeleton:
    """A skeleton (xsens23 by default) scaled to a person's height. Raises WearcapError outside 0.5…2.6 m."""
    if not 0.5 <= height_m <= 2.6:
        raise WearcapError(f"a height of {height_m} m", expected="0.5 to 2.6 m")
    skeleton = skeleton or xsens23()
    return skeleton.scaled(height_m / stature(skeleton))


def phenotype_of(shape: dict[str, float]) -> dict[str, float]:
    """Anny's phenotypes in a recording's shape, each 0…1 (gender: 0 male, 1 female).

    Other models' coefficients are ignored.
    """
    return {name: float(shape[name]) for name in ("gender", "muscle", "proportions") if name in shape}


def weight_kg_of(shape: dict[str, float]) -> float | None:
    """Stated weight (kg), if any. Raises WearcapError when it is not a person's."""
    weight = shape.get("weight")
    if weight is not None and not 10 <= weight <= 400:
        raise WearcapError(f"a weight of {weight}", expected="kilograms, 10 to 400")
    return weight
