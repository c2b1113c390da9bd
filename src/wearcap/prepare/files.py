"""Files that recordings name: those from elsewhere become files of the data set, which is whole by itself."""

import hashlib
import os
import shutil
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from wearcap.boundary.opening import explained, file_size, path_inside
from wearcap.files import atomic_path, remembered_sha256
from wearcap.io.formats.scene_folder import used_files
from wearcap.recording.recording import Recording

FOLDER = "files"


def with_own_files(recording: Recording, root: Path, origin: Path) -> Recording:
    """A recording whose names of files are relative to the data set in `root`, into which those from elsewhere are linked.

    Relative names are of files below `origin`, and stay as they are where these are missing. Raises WearcapError for
    other files that cannot be read.
    """

    def own(name: str | None) -> str | None:
        return None if name is None else _own(name, root, origin)

    camera = recording.camera
    if camera is not None:
        pictures = camera.image_files and tuple(_own(name, root, origin) for name in camera.image_files)
        camera = replace(camera, video=own(camera.video), image_files=pictures)
    return replace(recording, camera=camera, scene=own(recording.scene), environment=own(recording.environment))


def _own(name: str, root: Path, origin: Path) -> str:
    file, inside = Path(os.path.realpath(origin / name)), Path(os.path.realpath(root))
    if not Path(name).is_absolute() and (inside == Path(os.path.realpath(origin)) or not file.is_file()):
        return name
    if file.is_relative_to(inside):
        return file.relative_to(inside).as_posix()
    file_size(file)
    parts = used_files(file)
    with explained(file):
        contents = [remembered_sha256(part) for part in parts]
    folder = f"{FOLDER}/{hashlib.sha256(''.join(contents).encode()).hexdigest()[:16]}"
    for part, content in zip(parts, contents):
        _put(part, content, path_inside(root, f"{folder}/{part.relative_to(file.parent).as_posix()}", file))
    return f"{folder}/{file.name}"


def _put(source: Path, content: str, target: Path) -> None:
    """Link or else copy a file whose SHA-256 is `content`, unless it is there already."""
    with suppress(OSError):  # another file system, or a file that is there
        target.parent.mkdir(parents=True, exist_ok=True)
        os.link(source, target)
    if not target.is_file() or not (target.samefile(source) or remembered_sha256(target) == content):
        with atomic_path(target) as temporary:
            shutil.copyfile(source, temporary)
