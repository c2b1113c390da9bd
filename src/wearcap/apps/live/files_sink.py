"""Files that grow while they are recorded: whatever moment a capture is killed at, they open and lack at most a second.

A folder for each wearer holds `motion-000000.npz`, `motion-000001.npz`, … of half a second each, and the same as .bvh, each
written once and atomically. At the end, and by `join_sections` after a kill, they become motion.npz and motion.bvh. A piece
that cannot be written is lost with its half second, and nothing else.
"""

from contextlib import ExitStack, suppress
from itertools import count
from pathlib import Path

from wearcap.apps.live.setup import plain_name
from wearcap.apps.live.sink import Sink
from wearcap.body.skeleton import Skeleton
from wearcap.errors import WearcapError
from wearcap.io.formats.bvh import write_bvh
from wearcap.io.formats.motion_npz import SECTION, motion_files, read_motion, read_sections, write_motion
from wearcap.recording import Motion
from wearcap.recording.timing import joined

SECTION_S = 0.5
"""Length of the motion in one file; a file is written once."""
MAX_GAP_S = 60.0
"""Longest time without frames inside a motion; after a longer one, as of a clock that was set, another motion begins."""


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
        if wearer in self._tracks and self._tracks[wearer].last_s is None:
            return  # nothing came of the motion before: its folder is still empty
        self.end(wearer)
        self._tracks[wearer] = _Track(_own_folder(self.folder / plain_name(wearer)))

    def take(self, wearer: str, motion: Motion) -> None:
        if wearer not in self._tracks or not self._tracks[wearer].continues(motion):
            self.begin(wearer, motion.skeleton, 0.0)
        self.sent += self._tracks[wearer].take(motion)

    def end(self, wearer: str) -> None:
        if wearer in self._tracks:
            track = self._tracks.pop(wearer)
            try:
                self.sent += track.flush()
            finally:
                if motion_files(track.folder):
                    join_sections(track.folder)

    def close(self) -> None:
        with ExitStack() as ends:  # of all wearers, also where the files of one cannot be written
            for wearer in list(self._tracks):
                ends.callback(self.end, wearer)


class _Track:
    """One wearer's files."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.last_s: float | None = None
        """Time (s) of the last frame."""
        self._number, self._parts = 0, []

    def continues(self, motion: Motion) -> bool:
        """Whether a piece goes on from the last one: later, and by no more than `MAX_GAP_S`."""
        return self.last_s is None or 0.0 < motion.timestamps[0].item() - self.last_s <= MAX_GAP_S

    def take(self, motion: Motion) -> int:
        """Take in the next frames; returns how many frames were written now."""
        self._parts.append(motion)
        self.last_s = motion.timestamps[-1].item()
        return self.flush() if self.last_s - self._parts[0].timestamps[0].item() >= SECTION_S else 0

    def flush(self) -> int:
        """Write what has come since the last section, and return its number of frames; it is tried once. Raises what the
        writers raise."""
        parts, self._parts = self._parts, []
        if (section := joined(parts)) is None:
            return 0
        path, self._number = self.folder / f"motion-{self._number:06d}.npz", self._number + 1
        write_motion(section, path)
        if len(section) > 1:
            write_bvh(section, path.with_suffix(".bvh"))
        return len(section)


def join_sections(folder: Path) -> Motion:
    """Write motion.npz and motion.bvh of a folder's sections and remove these; goes on where it was stopped.

    Raises WearcapError as `read_sections` does.
    """
    found = sorted(path for path in folder.glob("motion-*.npz") if SECTION.fullmatch(path.name))
    whole = folder / "motion.npz"
    motion = read_motion(whole) if whole.is_file() else read_sections(found)
    if not whole.is_file():
        write_motion(motion, whole)
    if len(motion) > 1 and not whole.with_suffix(".bvh").is_file():
        write_bvh(motion, whole.with_suffix(".bvh"))
    for path in found:
        path.unlink(missing_ok=True)
        path.with_suffix(".bvh").unlink(missing_ok=True)
    return motion


def _own_folder(folder: Path) -> Path:
    """A new folder of this name, or beside it with a number: two wearers' names may look alike."""
    for number in count(1):
        own = folder if number == 1 else folder.with_name(f"{folder.name}_{number}")
        with suppress(FileExistsError):
            own.mkdir(parents=True)
            return own
    raise AssertionError
