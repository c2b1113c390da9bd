"""Motion as an MP4, rendered without a screen."""

from pathlib import Path

import av
import numpy as np
from rich.console import Console
from rich.progress import track

from wearcap.body.model import BodyModel
from wearcap.errors import WearcapError
from wearcap.files import atomic_path
from wearcap.recording.motion import Motion
from wearcap.scene.environment import Environment
from wearcap.viewer.picture import actors, captioned, focus, panel, shared_time


def write_video(
    path: str | Path,
    motions: dict[str, Motion],
    *,
    fps: float = 30.0,
    size: tuple[int, int] = (480, 400),
    body: BodyModel | None = None,
    environment: Environment | None = None,
    max_seconds: float | None = None,
    progress: bool = True,
) -> None:
    """Write panels of `size` (width, height) side by side, one per motion, on their shared clock.

    The camera follows the first motion. Raises WearcapError when the motions share no time, or for odd sizes.
    """
    if size[0] % 2 or size[1] % 2 or fps <= 0:
        raise WearcapError(f"a video of {size[0]}x{size[1]} at {fps} fps", expected="even sizes, a positive rate")
    shown = actors(motions, body, environment)
    start, stop = shared_time(motions.values())
    if max_seconds is not None:
        stop = min(stop, start + max_seconds)
    times = start + np.arange(int((stop - start) * fps) + 1) / fps
    clocks = [actor.motion.timestamps.numpy() for actor in shown]
    with atomic_path(path) as temporary, av.open(str(temporary), "w", format="mp4") as container:
        codec = "libx264" if "libx264" in av.codecs_available else "mpeg4"  # H.264 where PyAV was built with it
        stream = container.add_stream(codec, rate=round(fps))
        assert isinstance(stream, av.VideoStream)
        stream.width, stream.height, stream.pix_fmt = size[0] * len(shown), size[1], "yuv420p"
        for time in track(times, f"video {Path(path).name}", console=Console(stderr=True), disable=not progress):
            frames = [int(np.abs(clock - time).argmin()) for clock in clocks]
            target = focus(shown[0].motion, frames[0])
            panels = [
                np.asarray(captioned(panel(actor, frame, target, size, supersample=1), actor.label))
                for actor, frame in zip(shown, frames)
            ]
            picture = av.VideoFrame.from_ndarray(np.concatenate(panels, 1), format="rgb24")
            container.mux(stream.encode(picture))
        container.mux(stream.encode(None))
