"""What devices send to a streaming capture, one sample each. Times are in seconds, on the wearer's own clock."""

from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from wearcap.geometry.rigid import Rigid
from wearcap.recording import Motion
from wearcap.recording.recording import FingerStream, Localization


class HeadSample(NamedTuple):
    """One time step of a head device; a field is None where the device measured nothing."""

    timestamp: float
    T_world_device: Rigid | None = None
    """Pose of the device, R "3 3", t "3" (m); None while tracking is lost."""
    points_world: Float[Tensor, "point 3"] | None = None
    """New points of the surroundings (m), in the world of the poses; zero rows: there is a map, but nothing new."""
    embedding: Float[Tensor, "feature"] | None = None
    """Embedding of the head camera's image at this timestamp."""
    floor_height: float | None = None
    """Floor height (m) from another source; without it, it is estimated from the points or the head's path."""


class WatchSample(NamedTuple):
    """One sample of a watch, on the head camera's clock."""

    timestamp: float
    R_world_imu: Float[Tensor, "3 3"]
    acc_world: Float[Tensor, "3"]
    """Free acceleration (m/s²)."""
    joint: str = ""
    """Wrist that wears the watch ("left_wrist" or "right_wrist")."""


class WristSample(NamedTuple):
    """Tracked pose of a wrist joint ("left_wrist" or "right_wrist")."""

    joint: str
    timestamp: float
    T_world_joint: Rigid


class HandSample(NamedTuple):
    """A tracked hand at one time."""

    side: str
    timestamp: float
    joints: FingerStream
    """One frame."""


class ActiveObject(NamedTuple):
    """From this time on an object is the active one; None: no object is."""

    name: str | None
    timestamp: float


class ObjectSample(NamedTuple):
    """Observed pose of an object."""

    name: str
    timestamp: float
    T_world_object: Rigid


class SuitPiece(NamedTuple):
    """Consecutive frames of a suit, and where the head camera was localised during them."""

    suit: Motion
    localization: Localization | None = None


class LocalizationSample(NamedTuple):
    """Pose of the head camera in the scanned scene, as a localiser found it."""

    timestamp: float
    T_world_cam: Rigid
    confidence: float = 1.0
