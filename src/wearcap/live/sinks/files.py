"""Files that grow while they are recorded: whatever moment a capture is killed at, they open and lack at most a second.

A folder for each wearer holds `motion-000000.npz`, `motion-000001.npz`, … of half a second each, and the same as .bvh, each
written once and atomically. At the end, and by `join_sections` after a kill, they become motion.npz and motion.bvh.
"""

import math
import re
from pathlib import Path

from wearcap.body.skeleton import Skeleton
from wearcap.errors import WearcapError
from wearcap.io.formats.bvh import write_bvh
from wearcap.io.formats.motion_npz import SECTION, motion_files, read_sections, write_motion
from wearcap.live.sink import Sink
from wearcap.recording import Motion
from wearcap.recording.timing import joined

SECTION_S = 0.5
"""Length of the motion in one file; a file is written once."""


class FilesSink(Sink):
    """Records all wearers in a folder."""

    convention = "motion.npz in wearcap's axes, and BVH in centimetres with y up"

    def __init__(self, folder: Path):
        self.folder, self.name = folder, f"files {folder}"
        self._tracks: dict[str, _Track] = {}

    def open(self) -> None:
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            what = f"no folder can be made here ({error.strerror or error})"
            raise WearcapError(what, self.folder, "record=DIR") from error

    def begin(self, wearer: str, skeleton: Skeleton, fps: float) -> None:
        self.end(wearer)
        self._tracks[wearer] = _Track(_free_folder(self.folder / _plain(wearer)))

    def take(self, wearer: str, motion: Motion) -> None:
        if wearer not in self._tracks or motion.timestamps[0].item() <= self._tracks[wearer].last_s:
            self.begin(wearer, motion.skeleton, 0.0)  # also where the wearer's clock was set back
        self._tracks[wearer].take(motion)

    def end(self, wearer: str) -> None:
        if wearer in self._tracks:
            track = self._tracks.pop(wearer)
            track.flush()
            if motion_files(track.folder):
                join_sections(track.folder)

    def close(self) -> None:
        for wearer in list(self._tracks):
            self.end(wearer)


class _Track:
    """One wearer's files."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.last_s = -math.inf
        """Time (s) of the last frame."""
        self._number, self._parts = 0, []

    def take(self, motion: Motion) -> None:
        self._parts.append(motion)
        self.last_s = motion.timestamps[-1].item()
        if self.last_s - self._parts[0].timestamps[0].item() >= SECTION_S:
            self.flush()

    def flush(self) -> None:
        """Write what has come since the last section."""
        if (section := joined(self._parts)) is None:
            return
        path = self.folder / f"motion-{self._number:06d}.npz"
        write_motion(section, path)
        if len(section) > 1:
            write_bvh(section, path.with_suffix(".bvh"))
        self._number, self._parts = self._number + 1, []


def join_sections(folder: Path) -> Motion:
    """Write motion.npz and motion.bvh of a folder's sections and remove these. Raises WearcapError as `read_sections` does."""
    found = sorted(path for path in folder.glob("motion-*.npz") if SECTION.fullmatch(path.name))
    whole = read_sections(found)
    write_motion(whole, folder / "motion.npz")
    if len(whole) > 1:
        write_bvh(whole, folder / "motion.bvh")
    for path in found:
        path.unlink(missing_ok=True)
        path.with_suffix(".bvh").unlink(missing_ok=True)
    return whole


def _plain(wearer: str) -> str:
    """A folder's name: names from the network are no paths."""
    return re.sub(r"[^A-Za-z0-9_-]", "_", wearer)[:40] or "wearer"


def _free_folder(folder: Path) -> Path:
    """The folder, or one beside it with a number, that holds no recording yet."""
    number, free = 1, folder
    while free.exists() and any(free.iterdir()):
        number += 1
        free = folder.with_name(f"{folder.name}_{number}")
    free.mkdir(parents=True, exist_ok=True)
    return free
