"""Files that grow while they are recorded: whatever moment a capture is killed at, they open and lack at most a second.

A folder for each wearer holds `motion-000000.npz`, `motion-000001.npz`, …, four seconds each, and the same as .bvh; the newest
are written anew four times a second, atomically. At the end, and by `join_sections` after a kill, they become motion.npz and
motion.bvh.
"""

import re
import time
from pathlib import Path

from wearcap.body.skeleton import Skeleton
from wearcap.errors import WearcapError
from wearcap.io.formats.bvh import write_bvh
from wearcap.io.formats.motion_npz import SECTION, read_sections, write_motion
from wearcap.live.sink import Sink
from wearcap.recording import Motion
from wearcap.recording.timing import joined

SYNC_S = 0.25
"""Time between writes of what has come."""
SECTION_S = 4.0
"""Length of the motion in one file."""


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
        if wearer in self._tracks:
            self._tracks[wearer].flush()
        self._tracks[wearer] = _Track(_free_folder(self.folder / _plain(wearer)))

    def take(self, wearer: str, motion: Motion) -> None:
        if wearer not in self._tracks:
            self.begin(wearer, motion.skeleton, motion.fps)
        self._tracks[wearer].take(motion)

    def end(self, wearer: str) -> None:
        if wearer in self._tracks:
            track = self._tracks.pop(wearer)
            track.flush()
            join_sections(track.folder)

    def close(self) -> None:
        for wearer in list(self._tracks):
            self.end(wearer)


class _Track:
    """One wearer's files."""

    def __init__(self, folder: Path):
        self.folder = folder
        self._section, self._parts, self._synced_s = 0, [], -1e9
        self._begin_s: float | None = None

    def take(self, motion: Motion) -> None:
        first_s = motion.timestamps[0].item()
        if self._begin_s is not None and not 0 <= first_s - self._begin_s < SECTION_S:
            self.flush()
            self._section, self._parts, self._begin_s = self._section + 1, [], None
        self._begin_s = first_s if self._begin_s is None else self._begin_s
        self._parts.append(motion)
        if time.monotonic() - self._synced_s > SYNC_S:
            self.flush()

    def flush(self) -> None:
        """Write what has come of this section."""
        whole = joined(self._parts)
        if whole is None:
            return
        self._parts, self._synced_s = [whole], time.monotonic()
        write_motion(whole, self.folder / f"motion-{self._section:06d}.npz")
        if len(whole) > 1:
            write_bvh(whole, self.folder / f"motion-{self._section:06d}.bvh")


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
