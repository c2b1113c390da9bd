"""The first two steps of HPS: synchronisation of head camera and suit (thesis §4.3.4), camera localisation (§4.2.3)."""

import sys
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from wearcap.body.skeleton import WRISTS
from wearcap.errors import WearcapError, require_choice
from wearcap.io.formats.scene_folder import MAP_NAME
from wearcap.io.formats.video import read_frames, read_image
from wearcap.localization.features import Extractor, Matcher, RootSift
from wearcap.localization.landmark_tracking import TrackingSettings, track_video
from wearcap.localization.localizer import Localizer, LocalizerSettings, localize_video
from wearcap.localization.visual_map import VisualMap
from wearcap.recording import CameraStream, Recording
from wearcap.recording.recording import Localization
from wearcap.runtime.stages import Stage
from wearcap.runtime.system import CaptureInput
from wearcap.sensors.claps import camera_claps, detect_claps
from wearcap.sensors.clock import Clock, fit_clock, retime
from wearcap.sensors.imu import synthesize_imu

CLOCKS = ("shared", "claps", "auto")
USUAL_HZ, TRACKED_HZ = 6.0, 10.0
"""Default number of frames per second if each is localised anew, and if they are tracked; the suit's motion bridges the
frames between."""


@runtime_checkable
class Localize(Protocol):
    """Estimates the head camera's poses, on the camera's clock; `folder` is the recording's data set folder."""

    def __call__(self, recording: Recording, folder: Path) -> Localization: ...

    def reads(self, recording: Recording, folder: Path) -> list[Any]:
        """Inputs that determine the result, for its cache key. Raises WearcapError when they do not suffice for one."""
        ...


@dataclass(frozen=True)
class Synchronization:
    """Synchronisation of camera and suit."""

    clock: str = "auto"
    """"shared": one clock. "claps": by claps in both. "auto": by claps where a wrist wears a sensor, else shared."""
    camera_claps_s: list[float] | None = None
    """Times of the claps (s from the video's first image); None: detected in the video's sound."""
    max_offset_s: float | int = 600.0
    """Largest offset (s) between the clocks that is searched."""

    def __post_init__(self):
        require_choice(self.clock, CLOCKS, f"clock={self.clock!r}")

    def by_claps(self, recording: Recording) -> bool:
        """Whether this recording is synchronised by claps."""
        return self.clock == "claps" or (self.clock == "auto" and any(name in recording.imu for name in WRISTS))

    def reads(self, recording: Recording, folder: Path) -> list[Any]:
        """Inputs that determine the result, for its cache key."""
        camera = recording.camera
        if not self.by_claps(recording) or camera is None:
            return []
        heard = self.camera_claps_s is None and camera.video is not None
        worn = [recording.imu[name] for name in WRISTS if name in recording.imu] or recording.suit
        return [self, worn, camera.timestamps[:1], folder / (camera.video or "") if heard else None]

    def __call__(self, recording: Recording, folder: Path) -> Clock | None:
        """Map from the camera's clock to the suit's; None where they share one clock.

        Without wrist sensors the claps are detected in accelerations synthesised from the suit's motion. Raises
        WearcapError when either side has no clap, and when the match is ambiguous.
        """
        if not self.by_claps(recording):
            return None
        camera, suit = recording.camera, recording.suit
        assert camera is not None
        wrists = [recording.imu[name] for name in WRISTS if name in recording.imu]
        if not wrists and suit is not None:
            wrists = [synthesize_imu(suit, name, n=1) for name in WRISTS]
        try:
            heard = camera_claps(camera, folder, self.camera_claps_s)
            return fit_clock(heard, detect_claps(*wrists), self.max_offset_s)
        except WearcapError as error:
            fix = (
                "Give pipeline.synchronization.max_offset_s=SECONDS if both started within so much, or "
                "….camera_claps_s=[…], or ….clock=shared where camera and suit are on one clock already."
            )
            where = error.where or recording.name
            raise WearcapError(error.what, where=where, expected=error.expected, fix=fix) from error


@dataclass(frozen=True, eq=False)
class MapLocalization:
    """Localises a recording's images in a visual map."""

    extractor: Extractor = field(default_factory=RootSift)
    matcher: Matcher | None = None
    settings: LocalizerSettings = field(default_factory=LocalizerSettings)
    map: str | None = None
    """A map's file, or a scene's folder that contains map.safetensors; None: the recording's own poses are used, or,
    where it has none, the map in the folder of its scan."""
    every: int | None = None
    """Step between localised frames; None: chosen for `USUAL_HZ`, or `TRACKED_HZ`."""
    tracking: TrackingSettings | None = None
    """How frames between key frames are tracked; None: each frame is localised anew (thesis)."""
    use_prior: bool = True
    """Whether the pose of the previous frame guides the search in the next one."""

    def __post_init__(self):
        if self.every is not None and self.every < 1:
            raise WearcapError(f"every={self.every}", expected="1 (each frame) or more")

    def map_file(self, recording: Recording, folder: Path) -> Path | None:
        """Path of the map; None: the recording's own localisation is used. Raises WearcapError without either."""
        if self.map is not None:
            given = Path(self.map)
            given = given / MAP_NAME if given.is_dir() else given
            if not given.is_file():
                raise WearcapError("no such map", where=given, fix="Build it: wearcap scene.")
            return given
        if recording.localization is not None:
            return None
        own = (folder / recording.scene).parent / MAP_NAME if recording.scene else None
        if own is None or not own.is_file():
            what = "no localisation in this recording, and no map"
            expected = "camera poses, or a visual map of the scene"
            fix = "Build one (wearcap scene) and give pipeline.localization.map=FILE."
            raise WearcapError(what, where=recording.name, expected=expected, fix=fix)
        return own

    def reads(self, recording: Recording, folder: Path) -> list[Any]:
        """What decides the result, for its cache key. Raises WearcapError without localisation and map, or images."""
        file, stream = self.map_file(recording, folder), recording.camera
        if file is None or stream is None:
            return [recording.localization]
        features = [self.extractor, self.matcher, self.settings, self.use_prior, self.tracking]
        frames = [self._step(stream), stream.timestamps, stream.camera]
        return [*features, *frames, file, *_pictures(recording, folder)]

    def __call__(self, recording: Recording, folder: Path) -> Localization:
        """Localise every `every`-th frame; times are on the camera's clock. Raises WearcapError as `reads`, and for a
        map or video that cannot be read."""
        file = self.map_file(recording, folder)
        if file is None:
            assert recording.localization is not None
            return recording.localization
        _pictures(recording, folder)
        stream = recording.camera
        assert stream is not None
        localizer = Localizer(VisualMap.load(file), self.extractor, self.matcher, self.settings)
        every = self._step(stream)
        video = (_frames(stream, folder, every), stream.timestamps[::every], stream.camera, localizer)
        progress = sys.stderr.isatty()
        if self.tracking is not None:
            return track_video(*video, self.tracking, progress=progress)
        return localize_video(*video, use_prior=self.use_prior, progress=progress)

    def _step(self, stream: CameraStream) -> int:
        """Step between localised frames."""
        if self.every is not None or len(stream.timestamps) < 2:
            return self.every or 1
        rate = USUAL_HZ if self.tracking is None else TRACKED_HZ
        return max(1, round(1 / (rate * stream.timestamps.diff().median().item())))


def camera_stages(source: CaptureInput, synchronization: Synchronization, localize: Localize) -> list[Stage]:
    """Stages `synchronize` and `localize`. Raises WearcapError when localisation is impossible."""
    recording, folder = source.recording, source.folder or Path()
    localize.reads(recording, folder)
    return [
        Stage(
            "synchronize",
            lambda results: synchronization(recording, folder),
            lambda: synchronization.reads(recording, folder),
            kinds=(Clock,),
        ),
        Stage("localize", lambda results: localize(recording, folder), lambda: localize.reads(recording, folder)),
    ]


def on_one_clock(recording: Recording, results: dict[str, Any]) -> Recording:
    """The recording with both stages' results: camera and localisation on the suit's clock."""
    sensed = replace(recording, localization=results["localize"])
    return sensed if results["synchronize"] is None else retime(sensed, results["synchronize"])


def camera_report(results: dict[str, Any]) -> dict[str, Any]:
    """Report of the first stages: clock (None: shared), number of frames and share of them that were localised."""
    clock: Clock | None = results["synchronize"]
    about: dict[str, Any] = {"clock": None}
    if clock is not None:
        about["clock"] = {
            "offset_s": clock.offset_s,
            "drift_ms_per_hour": 1000 * clock.drift_s_per_hour,
            "residual_ms": 1000 * clock.residual_s,
            "claps": clock.claps,
        }
    if "localize" in results:
        confidence = results["localize"].confidence
        about["localized"] = {
            "frames": len(confidence),
            "share": (confidence > 0).double().mean().item() if len(confidence) else 0.0,
        }
    return about


def _pictures(recording: Recording, folder: Path) -> list[Path]:
    stream = recording.camera
    if stream is None or (stream.video is None and stream.image_files is None):
        expected = "a video or picture files, to be localised in the map"
        raise WearcapError("no pictures of the head camera", where=recording.name, expected=expected)
    return stream.files_in(folder)


def _frames(stream: CameraStream, folder: Path, every: int) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """Every `every`-th image that has a timestamp."""
    files = stream.files_in(folder)
    if stream.video is None:
        yield from map(read_image, files[::every])
    else:
        yield from (picture for _, picture in read_frames(files[0], stop=len(stream.timestamps), step=every))
