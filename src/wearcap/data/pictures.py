"""Pictures of a head camera, from its video or its image files."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from wearcap.errors import WearcapError
from wearcap.io.formats.video import read_frames, read_image
from wearcap.recording.recording import CameraStream


def pictures(camera: CameraStream, folder: Path) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """A stream's images in order, from its video or its image files. Raises WearcapError as `picture_files` does."""
    files = picture_files(camera, folder)
    if camera.video is not None:
        yield from (frame for _, frame in read_frames(files[0]))
    else:
        yield from (read_image(file) for file in files)


def picture_files(camera: CameraStream, folder: Path) -> list[Path]:
    """The video, or the image files. Raises WearcapError where there is none, or one is missing."""
    files = camera.files_in(folder)
    if not files:
        what = "this camera stream has no pictures"
        fix = "Prepare the data set with its camera."
        raise WearcapError(what, where=folder, expected="a video or image files", fix=fix)
    if missing := [file for file in files if not file.is_file()]:
        what = "no such video" if camera.video is not None else f"{len(missing)} of {len(files)} pictures are missing"
        expected = "the files that the recording names, below the data set's folder"
        raise WearcapError(what, where=missing[0], expected=expected)
    return files
