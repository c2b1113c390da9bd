"""Data sets on disk: a `manifest.json`, and one memory-mapped `.safetensors` file per recording."""

import json
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from safetensors import SafetensorError
from torch import Tensor

from wearcap.boundary.opening import explained, file_size, path_inside, read_bytes, understood
from wearcap.boundary.tensors import open_described, write_tensors
from wearcap.boundary.texts import parse_json, require_layout
from wearcap.errors import WearcapError, require_choice
from wearcap.files import remembered_sha256, sha256_of, write_text
from wearcap.recording.recording import Recording
from wearcap.recording.serialize import dumps, flatten, require_part, unflatten

SCHEMA_VERSION = 1
SPLITS = ("train", "val", "test")
MANIFEST, FOLDER = "manifest.json", "recordings"
_DAMAGE = (
    WearcapError,
    SafetensorError,
    RuntimeError,
    LookupError,
    TypeError,
    ValueError,
    AttributeError,
    OverflowError,
)
"""Exceptions of restoring a recording from a description of another layout."""


@dataclass(frozen=True)
class Context:
    """Who a recording is of, where, doing what, and under which licence."""

    subject: str
    location: str
    activity: str
    license: str


@dataclass(frozen=True)
class Entry:
    """Manifest entry of one recording; in the file its context stands among the other keys."""

    file: str
    sha256: str
    bytes: Annotated[int, msgspec.Meta(ge=0, le=1 << 50)]
    frames: Annotated[int, msgspec.Meta(ge=0, le=10**9)]  # a week at 1.6 kHz
    fps: Annotated[float, msgspec.Meta(ge=0, le=1e5)]
    duration_s: Annotated[float, msgspec.Meta(ge=0, le=1e11)]
    context: Context
    split: Literal["train", "val", "test"]
    config_hash: str
    """Hash of source bytes and preparation settings: prepare skips a recording whose hash is current."""

    @classmethod
    def of(cls, recording: Recording, root: Path, split: Any, config_hash: str) -> "Entry":
        """The manifest entry of a recording whose file has been written."""
        require_choice(split, SPLITS, f"no split {split!r}")
        path = recording_path(root, recording.name)
        stream = recording.motion or recording.suit or recording.head
        frames = len(stream.timestamps) if stream else 0
        fps = round(1 / stream.timestamps.diff().median().item(), 4) if stream and frames > 1 else 0.0
        return cls(
            file=path.relative_to(root).as_posix(),
            sha256=sha256_of(path),
            bytes=path.stat().st_size,
            frames=frames,
            fps=fps,
            duration_s=round(recording.duration_s, 4),
            context=Context(recording.subject, recording.location, recording.activity, recording.license),
            split=split,
            config_hash=config_hash,
        )


class _Description(msgspec.Struct):
    """What is described in a recording file beside its tensors."""

    schema_version: int
    recording: dict[str, Any]


class RecordingFile:
    """One recording on disk, opened without reading its tensors; slices read only their own rows.

    A file in a data set is verified against the manifest's checksum when it is opened, once while it is unchanged
    (`wearcap.files.remembered_sha256`).
    """

    def __init__(self, path: str | Path, *, verify: bool = True):
        """Open a file. Raises WearcapError when it is missing, damaged, no recording, or differs from its data set's
        manifest; files outside a data set are not compared."""
        self.path, manifest = Path(path), Path(path).parent.parent / MANIFEST
        size = file_size(path, "recording")
        if verify and self.path.parent.name == FOLDER and manifest.is_file():
            with explained(path):
                found = manifest.stat()
                entry = _entries(manifest, found.st_size, found.st_mtime_ns, found.st_ino).get(self.path.name)
                if entry is not None and size != entry.bytes:
                    expected = f"{entry.bytes} bytes, as the manifest says"
                    fix = "It was cut short or replaced: prepare it again."
                    raise WearcapError(f"{size} bytes long", self.path, expected, fix)
                if entry is not None and remembered_sha256(self.path) != entry.sha256:
                    raise _differs(self.path)
        fix = "Prepare this recording again."
        self._file, content = open_described(path, "wearcap", "recording", "`wearcap prepare`", fix)
        description = require_layout(content, _Description, path)
        if (version := description.schema_version) != SCHEMA_VERSION:
            raise WearcapError(f"schema version {version}", path, f"version {SCHEMA_VERSION}", "Prepare it again.")
        self._tree = description.recording

    @cached_property
    def keys(self) -> frozenset[str]:
        return frozenset(self._file.keys())

    def length(self, key: str) -> int:
        """Size of a tensor's first axis."""
        self._require(key)
        return self._file.get_slice(key).get_shape()[0]

    def tensor(self, key: str) -> Tensor:
        """A whole tensor."""
        self._require(key)
        return self._file.get_tensor(key)

    def window(self, key: str, start: int, stop: int) -> Tensor:
        """Rows start…stop-1 of a tensor such as "motion.R_parent_joint", read from the memory map alone."""
        self._require(key)
        return self._file.get_slice(key)[start:stop]

    def part(self, name: str):
        """One top-level part ("skeleton", "head", "motion" …), or None if the recording lacks it."""
        with self._described():
            part = unflatten(self._tree.get(name), cache(self.tensor))
            require_part(Recording, name, part)
        self._require_inside(part if name in ("scene", "environment") else getattr(part, "video", None))
        return part

    def load(self) -> Recording:
        """The whole recording. Raises WearcapError for a description that cannot be understood."""
        with self._described():
            recording = unflatten(self._tree, cache(self.tensor))
            if not isinstance(recording, Recording):
                raise TypeError("not a Recording")
            recording_path(Path(), recording.name)
        self._require_inside(recording.scene, recording.environment, recording.camera and recording.camera.video)
        return recording

    def _described(self) -> AbstractContextManager[None]:
        """Turn what taking the description apart raises into a WearcapError."""
        fix = "Prepare this recording again."
        return understood("its description is unreadable", self.path, fix=fix, errors=_DAMAGE)

    def _require_inside(self, *names: str | None) -> None:
        """Raise WearcapError for a name of a file that leaves the data set's folder, or leads to no regular file."""
        for name in filter(None, names):
            path_inside(dataset_folder(self.path), name, self.path)

    def _require(self, key: str) -> None:
        if key not in self.keys:
            raise WearcapError(f"this recording has no {key!r}", self.path, f"one of {', '.join(sorted(self.keys))}")


def _differs(path: Path) -> WearcapError:
    what = "its checksum differs from the manifest's"
    return WearcapError(what, path, fix="It was damaged or replaced: prepare it again.")


@lru_cache(maxsize=16)
def _entries(manifest: Path, *stamp: int) -> Mapping[str, Entry]:
    """Entries of a manifest by file name; a new `stamp` (size, time, inode) causes it to be read again."""
    entries = RecordingStore(manifest.parent).entries
    return {recording_path(Path(), name).name: entry for name, entry in entries.items()}


def save_recording(recording: Recording, path: str | Path) -> None:
    """Write one recording atomically; equal recordings give equal bytes."""
    tree, tensors = flatten(recording)
    write_tensors(path, tensors, {"wearcap": dumps({"schema_version": SCHEMA_VERSION, "recording": tree})})


class RecordingStore:
    """A data set on disk. One process may write; any number may read."""

    def __init__(self, root: str | Path):
        """Read the manifest, if there is one. Raises WearcapError when it is not readable."""
        self.root, path = Path(root), Path(root) / MANIFEST
        self.entries: dict[str, Entry] = {}
        if not path.exists():
            return
        manifest = parse_json(read_bytes(path, "json"), path)
        version = manifest.get("schema_version") if isinstance(manifest, dict) else None
        if version != SCHEMA_VERSION:
            what = f"schema version {str(version)[:40]}"
            raise WearcapError(what, path, f"version {SCHEMA_VERSION}", "Prepare the data set again.")
        with understood("not a readable manifest", path, fix="Delete it and prepare the data set again."):
            rows = {name: row | {"context": row} for name, row in manifest["recordings"].items()}
            self.entries = msgspec.convert(rows, dict[str, Entry])
            for name, entry in self.entries.items():
                if self.root / entry.file != recording_path(self.root, name):
                    raise ValueError(f"{name!r} is at {entry.file!r}, outside this data set")
                if entry.frames * entry.fps and entry.bytes < entry.frames:
                    raise ValueError(f"{name!r} has {entry.frames} frames in {entry.bytes} bytes")

    @classmethod
    def open(cls, root: str | Path) -> "RecordingStore":
        """Open an existing data set. Raises WearcapError if there is none."""
        if not (Path(root) / MANIFEST).is_file():
            what = "no data set here"
            raise WearcapError(what, root, "a folder with a manifest.json", "Make one with `wearcap prepare`.")
        return cls(root)

    @property
    def manifest_path(self) -> Path:
        return self.root / MANIFEST

    def names(self, split: str | None = None) -> list[str]:
        """Sorted names of the recordings of one split ("train", "val", "test"), or of all."""
        if split is not None and split not in SPLITS:
            raise WearcapError(f"no split {split!r}", expected=f"one of {', '.join(SPLITS)}")
        return sorted(name for name, entry in self.entries.items() if split in (None, entry.split))

    def add(self, recording: Recording, *, split: str, config_hash: str) -> None:
        """Write a recording and its manifest entry."""
        save_recording(recording, self.path_of(recording.name))
        self.register({recording.name: Entry.of(recording, self.root, split, config_hash)})

    def register(self, entries: dict[str, Entry]) -> None:
        """Add manifest entries of recordings whose files already exist (written by workers)."""
        self.entries |= entries
        recordings = {key: vars(value) | vars(value.context) for key, value in sorted(self.entries.items())}
        for row in recordings.values():
            del row["context"]
        text = json.dumps({"schema_version": SCHEMA_VERSION, "recordings": recordings}, indent=1)
        write_text(self.manifest_path, text + "\n")

    def path_of(self, name: str) -> Path:
        """File of a recording. Raises WearcapError for a name that is no plain file name."""
        return recording_path(self.root, name)

    def require(self, name: str) -> None:
        """Raise WearcapError when the data set has no recording of this name."""
        if name not in self.entries:
            expected = f"one of {len(self.entries)} recordings, as {self.names()[:3]}"
            raise WearcapError(f"no recording {name!r}", self.manifest_path, expected)

    def open_file(self, name: str) -> RecordingFile:
        """Open one recording for slicing. Raises WearcapError when it is missing, damaged or foreign."""
        self.require(name)
        return RecordingFile(self.root / self.entries[name].file)

    def load(self, name: str) -> Recording:
        """One recording. Raises WearcapError as `open_file` does, and for one of another name."""
        file = self.open_file(name)
        if (recording := file.load()).name != name:
            raise WearcapError(f"a recording named {recording.name[:80]!r}", file.path, repr(name), "Prepare it again.")
        return recording

    def verify(self) -> Iterator[tuple[str, WearcapError | None]]:
        """Check every file against its checksum, ignoring cached results; yields (name, error or None)."""
        for name in self.names():
            try:
                self.verify_one(name)
                yield name, None
            except WearcapError as error:
                yield name, error

    def verify_one(self, name: str) -> None:
        """Hash one file and open it. Raises WearcapError when it is missing, damaged, or not the manifest's."""
        file = self.open_file(name)
        if sha256_of(file.path) != self.entries[name].sha256:
            raise _differs(file.path)


def recording_path(root: Path, name: str) -> Path:
    """Path of a recording in a data set. Raises WearcapError when the name is no plain file name."""
    if Path(name).name != name or name.startswith(".") or not name.isprintable() or not 0 < len(name.encode()) < 200:
        raise WearcapError(f"{name[:80]!r} cannot name a recording", expected="a plain file name")
    return Path(root) / FOLDER / f"{name}.safetensors"


def load_recording(where: str | Path) -> Recording:
    """Load "DATASET/NAME", a recording's .safetensors file, or a data set that holds just one recording.

    Raises WearcapError that names the choices when there is no such recording.
    """
    path = Path(where)
    if path.is_file():
        return RecordingFile(path).load()
    if (path / MANIFEST).is_file():
        names = RecordingStore.open(path).names()
        if len(names) == 1:
            return RecordingStore.open(path).load(names[0])
        what = f"a data set of {len(names)} recordings"
        raise WearcapError(what, path, f"one of them, such as {path / names[0] if names else path / 'NAME'}")
    if (path.parent / MANIFEST).is_file():
        return RecordingStore.open(path.parent).load(path.name)
    what = "no recording here" + ("" if path.exists() else ": there is no such file or folder")
    raise WearcapError(what, path, "DATASET/NAME, or any file or folder that holds a recording")


def dataset_folder(where: str | Path) -> Path:
    """Folder of the data set of a recording given by the user; file names in the recording are relative to it."""
    path = Path(where)
    return next((folder for folder in (path, *path.parents) if (folder / MANIFEST).is_file()), path.parent)
