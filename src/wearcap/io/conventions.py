"""What a user states of a file's conventions; what is not stated follows from the file's content."""

from dataclasses import dataclass

from wearcap.errors import WearcapError, require_choice

UNITS_M = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "inch": 0.0254, "foot": 0.3048}
"""Metres per unit of length, by name."""
UP_AXES = ("x", "y", "z", "-x", "-y", "-z")
AXES = ("camera", "head", "openxr", "steamvr", "unity", "unreal")
ORDERS = ("xyzw", "wxyz")
HANDS = ("wrist", "grip")
AUTO = "auto"


@dataclass(frozen=True)
class Conventions:
    """Unit of length, the world's up axis, axes of devices, order of quaternions, and what poses of hands are of.

    Raises WearcapError for a value that is none of its choices.
    """

    unit: str | float | int = AUTO
    """A name of `UNITS_M`, or metres per unit."""
    up: str = AUTO
    axes: str = AUTO
    quaternion: str = AUTO
    hands: str = AUTO
    """"wrist": OpenXR's hand joint; "grip": a held controller."""

    def __post_init__(self):
        choices = {"up": UP_AXES, "axes": AXES, "quaternion": ORDERS, "hands": HANDS}
        for name, allowed in choices.items():
            require_choice(getattr(self, name), (AUTO, *allowed), f"{name}={getattr(self, name)}")
        number = isinstance(self.unit, int | float) and not isinstance(self.unit, bool)
        if not (1e-6 < self.unit < 1e6 if number else self.unit in (AUTO, *UNITS_M)):  # pyright: ignore[reportOperatorIssue]
            raise WearcapError(f"unit={self.unit}", expected=f"metres per unit, or one of {', '.join(UNITS_M)}")

    @property
    def unit_m(self) -> float | None:
        """Metres per unit of length; None where the file's content decides."""
        if self.unit == AUTO:
            return None
        return UNITS_M[self.unit] if isinstance(self.unit, str) else float(self.unit)
