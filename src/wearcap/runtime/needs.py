"""Inputs that systems need of a recording, each with whether it is there: what a preflight asks before anything slow runs."""

from collections.abc import Callable
from dataclasses import dataclass

from wearcap.body.skeleton import WRISTS
from wearcap.runtime.system import CaptureInput


@dataclass(frozen=True, eq=False)
class Need:
    """One input of a system."""

    what: str
    """A stream or file, in two or three words."""
    has: Callable[[CaptureInput], bool]
    fix: str
    required: bool = True
    """Whether nothing is captured without it; otherwise the capture is worse."""
    stream: str | None = None
    """Stream (by its field's name) whose clock and span must fit the others'; None for files and parameters."""


def _watches(source: CaptureInput) -> bool:
    imu = source.recording.imu
    worn = [imu[joint] for joint in WRISTS if joint in imu]
    whole = len(worn) == 2 and all(one.R_world_imu is not None and one.acc_world is not None for one in worn)
    return whole or (not imu and source.recording.motion is not None)


def _tracked(source: CaptureInput) -> bool:
    recording = source.recording
    return set(WRISTS) <= set(recording.tracked) or (not recording.tracked and recording.motion is not None)


def _contacts(source: CaptureInput) -> bool:
    suit = source.recording.suit
    return suit is not None and suit.contact_prob is not None


def _file(source: CaptureInput, name: str | None) -> bool:
    return name is not None and source.folder is not None and (source.folder / name).exists()


HEAD = Need(
    "head path",
    lambda source: source.recording.head is not None,
    "wearcap prepare trajectory source=FILE, prepare headset, or prepare aria.",
    stream="head",
)
POINTS = Need(
    "points of the surroundings",
    lambda source: source.recording.points is not None,
    "points=CLOUD.ply with prepare trajectory; without them the floor is guessed from the head's height.",
    required=False,
)
WATCHES = Need(
    "two watches with attitude and acceleration",
    _watches,
    "wearcap prepare watches left=CSV right=CSV camera=TRAJECTORY; with the head alone: for=hmd2.",
    stream="imu",
)
TRACKED_WRISTS = Need(
    "both wrists tracked",
    _tracked,
    "wearcap prepare headset source=LOG.csv with the poses of both controllers or hands.",
    stream="tracked",
)
SUIT = Need(
    "a suit's motion",
    lambda source: source.recording.suit is not None,
    "Record the suit's motion (MVNX), and prepare both together.",
    stream="suit",
)
CONTACTS = Need(
    "foot contacts of the suit",
    _contacts,
    "Export MVNX with contacts; without them they follow from the feet's speed.",
    required=False,
)
MOTION = Need(
    "a motion",
    lambda source: source.recording.suit is not None or source.recording.motion is not None,
    "Choose a pipeline that makes motion of these sensors.",
)
CAMERA = Need(
    "a head camera",
    lambda source: source.recording.camera is not None,
    "Give the video and its intrinsics (wearcap calibrate source=VIDEO).",
    stream="camera",
)
LOCALIZATION = Need(
    "camera poses in the scene, or video and map",
    lambda source: (
        source.recording.localization is not None
        or (source.recording.camera is not None and source.recording.camera.video is not None)
    ),
    "wearcap track, or a map of wearcap scene with pipeline.localization.map=FILE.",
    stream="localization",
)
SCAN = Need(
    "the scene's scan",
    lambda source: source.scan is not None and _found(source),
    "A recording that names its scan, or scene=FOLDER; without one: pipeline=paper/hps_without_scene.",
)
OBJECTS = Need(
    "the objects that can be moved",
    lambda source: _file(source, source.recording.environment),
    "Make them with wearcap scene, and give pipeline.environment=FILE.",
)
HEIGHT = Need(
    "the wearer's height",
    lambda source: source.recording.skeleton is not None or source.recording.motion is not None,
    "Give height=METRES; without it, it follows from how high the head is carried over a known floor.",
    required=False,
)


def _found(source: CaptureInput) -> bool:
    return not hasattr(source.scan, "is_file") or source.scan.is_file()  # pyright: ignore[reportOptionalMemberAccess, reportAttributeAccessIssue]
