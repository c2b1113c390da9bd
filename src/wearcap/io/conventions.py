"""What a user states of a file's conventions; what is not stated follows from the file's content."""

from dataclasses import dataclass, fields

from wearcap.errors import WearcapError, require_choice

UNITS_M = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "inch": 0.0254, "foot": 0.3048}
"""Metres per unit of length, by name."""
AUTO = "auto"
CHOICES = {
    "up": ("x", "y", "z", "-x", "-y", "-z"),
    "axes": ("camera", "head", "openxr", "steamvr", "unity", "unreal"),
    "quaternion": ("xyzw", "wxyz"),
    "hands": ("grip", "aim", "touch", "index", "vive", "wrist", "palm"),
    "time_unit": ("s", "ms", "us", "ns"),
}
"""What may be stated, beside numbers."""


@dataclass(frozen=True)
class Conventions:
    """Unit of length, the world's up axis, axes of devices, order of quaternions, what poses of hands are of, and times.

    Raises WearcapError for a value that is none of its choices.
    """

    unit: str | float | int = AUTO
    """A name of `UNITS_M`, or metres per unit."""
    up: str = AUTO
    axes: str = AUTO
    quaternion: str = AUTO
    hands: str = AUTO
    time_unit: str = AUTO
    fps: str | float | int = AUTO
    """Rate of the pictures, for files with frame numbers or without times."""

    def __post_init__(self):
        for name, allowed in CHOICES.items():
            require_choice(getattr(self, name), (AUTO, *allowed), f"{name}={getattr(self, name)}")
        if self.unit not in (AUTO, *UNITS_M) and not _is_within(self.unit, 1e-6, 1e6):
            raise WearcapError(f"unit={self.unit}", expected=f"metres per unit, or one of {', '.join(UNITS_M)}")
        if self.fps != AUTO and not _is_within(self.fps, 0.0, 2000.0):
            raise WearcapError(f"fps={self.fps}", expected="frames per second, above 0")

    @property
    def unit_m(self) -> float | None:
        """Metres per unit of length; None where the file's content decides."""
        return None if self.unit == AUTO else UNITS_M.get(str(self.unit)) or float(self.unit)

    def only(self, *names: str, where: object) -> None:
        """Raise WearcapError when something else than `names` is stated: the format fixes it, or has no such part."""
        for name in (field.name for field in fields(self)):
            if (value := getattr(self, name)) != AUTO and name not in names:
                expected = f"at most {', '.join(f'{each}=…' for each in names)}" if names else "none of these settings"
                raise WearcapError(f"{name}={value} has no meaning for it", str(where), expected, "Leave it out.")


DETECTED = Conventions()
"""Nothing is stated: a file's content decides."""


def _is_within(value: object, low: float, high: float) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and low < value < high
