"""Capture of several wearers in one place: each alone, then edited to fit the views of the others' cameras.

Their recordings share a session name, a clock and a world (MocapEvery §3.4, φ_T).
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from itertools import permutations
from pathlib import Path

import numpy as np
import torch

from wearcap.errors import WearcapError
from wearcap.files import atomic_path
from wearcap.io.formats.motion_npz import read_motion, write_motion
from wearcap.io.formats.npz import read_npz, require
from wearcap.recording import Motion, Recording
from wearcap.sensors.keypoints import camera_path, seen_wearer
from wearcap.systems.mocap_every.visual_cues import View, VisualCues

CONFIDENCE = ".confidence.npz"
"""Suffix of the file with a view's confidence, next to the motion's .npz."""


def capture_session(
    recordings: Sequence[Recording],
    capture: Callable[[Recording], Motion],
    cues: VisualCues,
    views: Mapping[str, Sequence[View]],
) -> dict[str, Motion]:
    """Motion of each recording of a session, by name; `views` holds the views of a recording's wearer by the others.

    `capture` must return motions anchored to the measured head, as the pipelines do. Raises WearcapError for recordings
    that share no session or no time, for views of an unknown recording, and for views with another skeleton.
    """
    _require_one_session(recordings)
    if unknown := set(views) - {recording.name for recording in recordings}:
        raise WearcapError(f"views of {min(unknown)!r}", expected=f"of {', '.join(r.name for r in recordings)}")
    motions = {}
    for recording in recordings:
        motion, own_views = capture(recording), views.get(recording.name, ())
        for view in own_views:
            if view.motion.skeleton.joint_names != motion.skeleton.joint_names:
                raise WearcapError(
                    f"a view with the joints of {view.motion.skeleton.name}",
                    where=recording.name,
                    expected=f"those of {motion.skeleton.name}, as captured",
                )
        motions[recording.name], _ = cues.edit(motion, recording, motion.joint("head"), own_views)
    return motions


def simulated_views(
    recordings: Sequence[Recording], rng: np.random.Generator, noise_deg: float = 5.0
) -> dict[str, list[View]]:
    """Simulated pose estimates of each wearer from the others' cameras, made from the true motions (`seen_wearer`).

    Raises WearcapError for recordings that share no session or no time, or lack a camera or a true motion.
    """
    _require_one_session(recordings)
    for recording in recordings:
        if recording.motion is None or recording.camera is None:
            raise WearcapError("no true motion or no camera", where=recording.name, expected="both, as simulated")
    views: dict[str, list[View]] = {recording.name: [] for recording in recordings}
    for seen, observer in permutations(recordings, 2):
        assert seen.motion is not None
        assert observer.motion is not None
        assert observer.camera is not None
        path = camera_path(observer.motion, observer.camera)
        start, stop = seen.motion.timestamps[0], seen.motion.timestamps[-1]
        path = path[(path.timestamps >= start) & (path.timestamps <= stop)]
        views[seen.name].append(View(*seen_wearer(seen.motion, path, observer.camera.camera, noise_deg, rng)))
    return views


def write_view(view: View, path: str | Path) -> None:
    """Write a view as a motion .npz, with its confidence in a file next to it (`CONFIDENCE`)."""
    write_motion(view.motion, path)
    with atomic_path(_confidence_path(path)) as temporary, open(temporary, "wb") as file:
        np.savez(file, confidence=view.confidence.numpy())


def read_view(path: str | Path) -> View:
    """Read a view in the format of `write_view`.

    Raises WearcapError when a file is missing or damaged, or when the confidence (0…1) does not match the motion.
    """
    motion, confidence_file = read_motion(path), _confidence_path(path)
    arrays = read_npz(confidence_file, ["confidence"])
    require(arrays, confidence_file, confidence=(len(motion), len(motion.skeleton)))
    confidence = torch.from_numpy(arrays["confidence"]).float()
    if ((confidence < 0) | (confidence > 1)).any():
        raise WearcapError("confidence beyond its range", where=confidence_file, expected="0 to 1")
    return View(motion, confidence)


def _confidence_path(path: str | Path) -> Path:
    path = Path(path)
    return path.with_name(path.name.removesuffix(".npz") + CONFIDENCE)


def _require_one_session(recordings: Sequence[Recording]) -> None:
    for recording in recordings:
        if recording.session is None or recording.session != recordings[0].session:
            raise WearcapError(
                f"session {recording.session!r}",
                where=recording.name,
                expected=f"that of {recordings[0].name}, {recordings[0].session!r}",
            )
    if repeated := [name for name, count in Counter(r.name for r in recordings).items() if count > 1]:
        raise WearcapError(f"two recordings are called {repeated[0]!r}", expected="unique names")
    spans = []
    for recording in recordings:
        stream = recording.head or recording.motion
        if stream is None or not len(stream.timestamps):
            raise WearcapError(
                "neither head poses nor a motion", where=recording.name, expected="at least one of the two"
            )
        spans.append((stream.timestamps[0].item(), stream.timestamps[-1].item()))
    if spans and max(start for start, _ in spans) > min(stop for _, stop in spans):
        raise WearcapError(
            "recordings of one session at different times", where=recordings[0].session, expected="one clock"
        )
