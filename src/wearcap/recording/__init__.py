"""The Recording (sensor data and ground truth), the Motion (a captured or true motion), and their store."""

from wearcap.recording.motion import Motion
from wearcap.recording.recording import (
    CameraStream,
    ContactTrack,
    Cue,
    FingerStream,
    FloorTrack,
    HeadStream,
    ImuStream,
    Intervals,
    Localization,
    PointCloud,
    Recording,
)
from wearcap.recording.store import RecordingStore

__all__ = [
    "CameraStream",
    "ContactTrack",
    "Cue",
    "FingerStream",
    "FloorTrack",
    "HeadStream",
    "ImuStream",
    "Intervals",
    "Localization",
    "Motion",
    "PointCloud",
    "Recording",
    "RecordingStore",
]
