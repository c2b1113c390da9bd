"""Motions inside a notebook: a video that is the value of a cell."""

import base64
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

from wearcap.apps.viewer.picture import write_video
from wearcap.apps.viewer.shown import surface_or_sticks
from wearcap.recording.motion import Motion


@dataclass(frozen=True)
class Video:
    """A video that notebooks show in place; in other programs `mp4` is what a file of it holds."""

    mp4: bytes = field(repr=False)

    @classmethod
    def of(cls, motions: dict[str, Motion], fps: float, size: tuple[int, int], max_seconds: float) -> "Video":
        """Motions by their labels side by side, as `write_video` draws them, on human surfaces. Raises WearcapError as it does."""
        first = next(iter(motions.values()), None)
        body = None if first is None else surface_or_sticks(first.skeleton, {})
        with TemporaryDirectory() as folder:
            path = Path(folder) / "motion.mp4"
            write_video(path, motions, fps=fps, size=size, body=body, max_seconds=max_seconds)
            return cls(path.read_bytes())

    def _repr_html_(self) -> str:
        source = f"data:video/mp4;base64,{base64.b64encode(self.mp4).decode()}"
        return f'<video controls autoplay loop muted playsinline src="{source}"></video>'
