"""A live recording: a folder of consecutive pieces, each a recording of some seconds.

`piece-000000.safetensors`, `piece-000001.safetensors`, … appear complete (written under another name and renamed); the
file `end` marks the end. The first piece describes the wearer and the camera.
"""

import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from wearcap.errors import WearcapError
from wearcap.files import write_text
from wearcap.recording.recording import Recording
from wearcap.recording.store import RecordingFile, save_recording

END = "end"


def _piece_path(folder: str | Path, number: int) -> Path:
    return Path(folder) / f"piece-{number:06d}.safetensors"


def write_piece(recording: Recording, folder: str | Path, number: int) -> None:
    """Write a piece to the folder."""
    save_recording(recording, _piece_path(folder, number))


def close_pieces(folder: str | Path) -> None:
    """Mark the recording as ended."""
    write_text(Path(folder) / END, "")


def follow_pieces(
    folder: str | Path,
    patience_s: float = 60.0,
    poll_s: float = 0.1,
    refused: Counter[str] | None = None,
    stop: threading.Event | None = None,
) -> Iterator[Recording]:
    """Yield pieces as they appear, until `end` or `stop`. A damaged file is counted in `refused` and skipped.

    Raises WearcapError when no piece appears for `patience_s`, and without `refused` for a damaged file.
    """
    folder, number, since, stop = Path(folder), 0, time.monotonic(), stop or threading.Event()
    while True:
        ended = (folder / END).exists()  # checked first, so that pieces written before the end are not missed
        if _piece_path(folder, number).exists():
            try:
                piece = RecordingFile(_piece_path(folder, number)).load()
            except WearcapError:
                if refused is None:
                    raise
                refused["piece: damaged file"] += 1
            else:
                yield piece
            number, since = number + 1, time.monotonic()
        elif ended:
            return
        elif time.monotonic() - since > patience_s:
            what = f"no piece {number} after {patience_s:.0f} s"
            expected = f"{_piece_path(folder, number).name}, or a file named {END!r}"
            raise WearcapError(what, folder, expected, "Is the recorder still running?")
        elif stop.wait(poll_s):
            return
