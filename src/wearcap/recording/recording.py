"""The Recording: sensor data and ground truth; parts that do not exist are None or empty."""

from dataclasses import dataclass, field
from pathlib import Path

from jaxtyping import Bool, Float, Float64
from torch import Tensor

from wearcap.body.skeleton import FOOT_PATCHES, Skeleton
from wearcap.boundary.opening import path_inside
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory
from wearcap.recording.motion import Interactions, Motion


@dataclass(frozen=True)
class HeadStream:
    """Poses of a head-mounted device, and its mount on the head joint.

    The device frame has the head's axes (x forward, y left, z up); readers convert other device axes to these.
    """

    timestamps: Float64[Tensor, "time"]
    R_world_device: Float[Tensor, "time 3 3"]
    t_world_device: Float[Tensor, "time 3"]
    R_head_device: Float[Tensor, "3 3"]
    t_head_device: Float[Tensor, "3"]

    @property
    def T_world_device(self) -> Rigid:
        return Rigid(self.R_world_device, self.t_world_device)

    @property
    def T_world_head(self) -> Rigid:
        """Pose of the head joint: T_world_device @ T_device_head."""
        return self.T_world_device @ Rigid(self.R_head_device, self.t_head_device).inverse()


@dataclass(frozen=True)
class ImuStream:
    """Data of one inertial sensor; channels that the sensor lacks are None."""

    timestamps: Float64[Tensor, "time"]
    joint: str
    """Joint that the sensor is worn on, by the skeleton's name."""
    R_world_imu: Float[Tensor, "time 3 3"] | None = None
    acc_world: Float[Tensor, "time 3"] | None = None
    """Free acceleration: gravity removed (m/s²)."""
    acc_imu: Float[Tensor, "time 3"] | None = None
    """Specific force in the sensor's axes: at rest +9.81 m/s² upwards."""
    gyro_imu: Float[Tensor, "time 3"] | None = None
    """Angular velocity in the sensor's axes (rad/s)."""
    R_joint_imu: Float[Tensor, "3 3"] | None = None
    """Mounting orientation, if known."""


@dataclass(frozen=True)
class CameraStream:
    """A camera worn on the head: calibration, and images by file name or as embeddings."""

    timestamps: Float64[Tensor, "time"]
    camera: Camera
    R_head_cam: Float[Tensor, "3 3"]
    t_head_cam: Float[Tensor, "3"]
    image_files: tuple[str, ...] | None = None
    """One per timestamp, relative to the data set's directory."""
    video: str | None = None
    """Video file, relative to the data set's directory, whose n-th frame belongs to the n-th timestamp."""
    embedding: Float[Tensor, "time feature"] | None = None
    embedding_mirrored: Float[Tensor, "time feature"] | None = None
    """Embeddings of the horizontally flipped images, for training on mirrored motions."""
    embedding_name: str | None = None
    """Name of the image encoder."""

    def files_in(self, folder: Path) -> list[Path]:
        """The video or the image files, in a data set's folder. Raises WearcapError for image files that leave it."""
        if self.video is not None:
            return [folder / self.video]
        return [path_inside(folder, name, folder) for name in self.image_files or ()]


@dataclass(frozen=True)
class Localization:
    """Camera poses localised in a map, frame by frame, with confidence (0…1; 0 where localisation failed)."""

    timestamps: Float64[Tensor, "time"]
    R_world_cam: Float[Tensor, "time 3 3"]
    t_world_cam: Float[Tensor, "time 3"]
    confidence: Float[Tensor, "time"]
    covariance: Float[Tensor, "time 6 6"] | None = None
    """Covariance of the pose error in the world: rotation vector (rad), then position (m)."""


@dataclass(frozen=True)
class PointCloud:
    """Points of the surroundings (m)."""

    points_world: Float[Tensor, "point 3"]
    confidence: Float[Tensor, "point"] | None = None
    first_seen: Float64[Tensor, "point"] | None = None
    """When each point was first observed (s); absent for scans."""


@dataclass(frozen=True)
class Cue:
    """Observed keypoints of one joint: pixels (2) or world positions (3), with confidence."""

    timestamps: Float64[Tensor, "time"]
    joint: str
    points: Float[Tensor, "time axis"]
    confidence: Float[Tensor, "time"]


@dataclass(frozen=True)
class FingerStream:
    """Joints of one tracked hand, in the order of `body.hands.HAND_JOINTS`."""

    timestamps: Float64[Tensor, "time"]
    points: Float[Tensor, "time joint 3"]
    """Places (m), NaN for joints that the device lacks. Their right-handed axes are the device's own and may turn from frame
    to frame: only how the joints of a frame lie to each other is used."""
    valid: Bool[Tensor, "time"]
    """Whether the hand was tracked."""
    confidence: Float[Tensor, "time"]
    """As the device gives it, 0…1; 1 where it gives none."""
    rotations: Float[Tensor, "time joint 3 3"] | None = None
    """Rotations of the joints in the same axes, where the device measures them: of a flat hand in the T-pose all are those
    of the wrist joint (y along the left hand's fingers and against the right one's, z out of the back), in a wrist's rest axes."""

    def frame(self, k: int) -> "FingerStream":
        """The stream's frame k alone."""
        row, rotations = slice(k, k + 1), self.rotations
        turned = None if rotations is None else rotations[row]
        return FingerStream(self.timestamps[row], self.points[row], self.valid[row], self.confidence[row], turned)


@dataclass(frozen=True)
class ContactTrack:
    """True contacts of named parts (`FOOT_PATCHES`, hands) over time."""

    timestamps: Float64[Tensor, "time"]
    parts: tuple[str, ...]
    contact: Bool[Tensor, "time part"]

    @property
    def feet(self) -> Bool[Tensor, "time patch"] | None:
        """Contact of `FOOT_PATCHES` in their order; None if the track lacks one of them."""
        if not set(FOOT_PATCHES) <= set(self.parts):
            return None
        return self.contact[:, [self.parts.index(patch) for patch in FOOT_PATCHES]]


@dataclass(frozen=True)
class FloorTrack:
    """Height (m) of the floor below the wearer over time."""

    timestamps: Float64[Tensor, "time"]
    height: Float[Tensor, "time"]


@dataclass(frozen=True)
class Intervals:
    """Named time intervals of a recording on the motion's clock, for evaluation."""

    start_s: Float64[Tensor, "interval"]
    stop_s: Float64[Tensor, "interval"]
    distance_m: Float[Tensor, "interval"]
    """Distance walked from the recording's start to the interval's start."""
    names: tuple[str, ...]
    """One per interval, such as "stand" and "move"."""


@dataclass(frozen=True)
class Recording:
    """Sensor data and ground truth of one wearer. Streams keep their own frame rates."""

    name: str
    # sensed
    head: HeadStream | None = None
    imu: dict[str, ImuStream] = field(default_factory=dict)
    suit: Motion | None = None
    camera: CameraStream | None = None
    localization: Localization | None = None
    points: PointCloud | None = None
    cues: dict[str, Cue] = field(default_factory=dict)
    tracked: dict[str, Trajectory] = field(default_factory=dict)
    """Poses of tracked joints, such as wrists by controllers, by the skeleton's joint names."""
    fingers: dict[str, FingerStream] = field(default_factory=dict)
    """Tracked hands by side, "left" and "right"."""
    scene: str | None = None
    """File of the surroundings' geometry (.ply or .glb), relative to the data set's directory."""
    environment: str | None = None
    """File of the objects that can be moved (`io.formats.environment`), relative to the data set's directory."""
    # true
    motion: Motion | None = None
    contacts: ContactTrack | None = None
    object_motion: dict[str, Trajectory] = field(default_factory=dict)
    interactions: Interactions | None = None
    floor: FloorTrack | None = None
    intervals: Intervals | None = None
    origin: Float64[Tensor, "3"] | None = None
    """What was taken off all positions (m): a map's coordinates are those here plus it; None where nothing was."""
    # about
    skeleton: Skeleton | None = None
    shape: dict[str, float] = field(default_factory=dict)
    """Body shape by named parameter: height (m), weight (kg), or a body model's own coefficients."""
    subject: str = ""
    location: str = ""
    activity: str = ""
    source: str = ""
    license: str = ""
    note: str = ""
    """What was detected or assumed when the recording was made, in a sentence."""
    session: str | None = None
    """Recordings of several wearers with the same session share clock and world."""

    @property
    def duration_s(self) -> float:
        """Time from the earliest to the latest timestamp of all streams."""
        spans = [s.timestamps for s in (self.head, self.motion, self.suit, self.camera, self.localization) if s]
        spans += [s.timestamps for s in self.imu.values()]
        spans = [s for s in spans if len(s)]
        return max((s[-1].item() for s in spans), default=0.0) - min((s[0].item() for s in spans), default=0.0)


MIN_DURATION_S = 0.25
"""Duration below which a recording is too short for a window."""
