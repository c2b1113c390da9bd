"""Data sets on disk: a `manifest.json`, and one memory-mapped `.safetensors` file per recording."""

import dataclasses
import json
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import safetensors
from safetensors.torch import save
from torch import Tensor

from wearcap.boundary.texts import parse_json
from wearcap.errors import WearcapError, require_choice
from wearcap.files import atomic_path, remembered_sha256, sha256_of, write_text
from wearcap.recording.recording import Recording
from wearcap.recording.serialize import dumps, flatten, require_part, unflatten

SCHEMA_VERSION = 1
SPLITS = ("train", "val", "test")
MANIFEST, FOLDER = "manifest.json", "recordings"
MAX_FRAMES, MAX_FPS = 10**9, 1e5
"""Largest values accepted from a manifest: a week at 1.6 kHz."""


@dataclass(frozen=True)
class Entry:
    """Manifest entry of one recording."""

    file: str
    sha256: str
    bytes: int
    frames: int
    fps: float
    duration_s: float
    subject: str
    location: str
    activity: str
    split: str
    license: str
    config_hash: str
    """Hash of source bytes and preparation settings: prepare skips a recording whose hash is current."""

    @classmethod
    def of(cls, recording: Recording, root: Path, split: str, config_hash: str) -> "Entry":
        """The manifest entry of a recording whose file has been written."""
        require_choice(split, SPLITS, f"no split {split!r}")
        path = recording_path(root, recording.name)
        stream = recording.motion or recording.suit or recording.head
        frames = len(stream.timestamps) if stream else 0
        fps = round(1 / stream.timestamps.diff().median().item(), 4) if stream and frames > 1 else 0.0
        about = {name: getattr(recording, name) for name in ("subject", "location", "activity", "license")}
        return cls(
            file=path.relative_to(root).as_posix(),
            sha256=sha256_of(path),
            bytes=path.stat().st_size,
            frames=frames,
            fps=fps,
            duration_s=round(recording.duration_s, 4),
            split=split,
            config_hash=config_hash,
            **about,
        )


_MOST = {"frames": MAX_FRAMES, "fps": MAX_FPS, "duration_s": 1e11, "bytes": 1 << 50}


class RecordingFile:
    """One recording on disk, opened without reading its tensors; slices read only their own rows.

    A file in a data set is verified against the manifest's checksum when it is opened, once while it is unchanged
    (`wearcap.files.remembered_sha256`).
    """

    def __init__(self, path: str | Path, *, verify: bool = True):
        """Open a file. Raises WearcapError when it is missing, damaged, no recording, or differs from its data set's
        manifest; files outside a data set are not compared."""
        self.path, manifest = Path(path), Path(path).parent.parent / MANIFEST
        try:
            if verify and self.path.parent.name == FOLDER and manifest.is_file() and self.path.is_file():
                found = manifest.stat()
                entry = _entries(manifest, found.st_size, found.st_mtime_ns, found.st_ino).get(self.path.name)
                if entry is not None and (size := self.path.stat().st_size) != entry.bytes:
                    expected = f"{entry.bytes} bytes, as the manifest says"
                    fix = "It was cut short or replaced: prepare it again."
                    raise WearcapError(f"{size} bytes long", self.path, expected, fix)
                if entry is not None and remembered_sha256(self.path) != entry.sha256:
                    raise _differs(self.path)
        except OSError as error:
            raise WearcapError(f"cannot be read ({error.strerror or error})", self.path) from error
        try:
            self._file = safetensors.safe_open(str(self.path), framework="pt")
        except FileNotFoundError as error:
            if self.path.exists():  # safetensors reports unreadable files as missing
                raise WearcapError(f"cannot be read ({error.strerror or 'no permission'})", self.path) from error
            raise WearcapError("no such recording", self.path) from error
        except (safetensors.SafetensorError, OSError, RuntimeError) as error:
            what = "not a readable recording"
            raise WearcapError(what, path, "a complete .safetensors file", "Prepare this recording again.") from error
        metadata = self._file.metadata() or {}
        if "wearcap" not in metadata:
            raise WearcapError("a .safetensors file, but not a recording", path, "one that `wearcap prepare` wrote")
        content = parse_json(metadata["wearcap"], path)
        with self._described():
            version, self._tree = content["schema_version"], dict(content["recording"])
        if version != SCHEMA_VERSION:
            raise WearcapError(f"schema version {version}", path, f"version {SCHEMA_VERSION}", "Prepare it again.")

    @cached_property
    def keys(self) -> frozenset[str]:
        return frozenset(self._file.keys())

    def length(self, key: str) -> int:
        """Size of a tensor's first axis."""
        self._require(key)
        return self._file.get_slice(key).get_shape()[0]

    def tensor(self, key: str) -> Tensor:
        self._require(key)
        return self._file.get_tensor(key)

    def window(self, key: str, start: int, stop: int) -> Tensor:
        """Rows start…stop-1 of a tensor such as "motion.R_parent_joint", read from the memory map alone."""
        self._require(key)
        return self._file.get_slice(key)[start:stop]

    def part(self, name: str):
        """One top-level part ("skeleton", "head", "motion" …), or None if the recording lacks it."""
        with self._described():
            part = unflatten(self._tree.get(name), self.tensor)
            require_part(Recording, name, part)
            return part

    def load(self) -> Recording:
        with self._described():
            recording = unflatten(self._tree, self.tensor)
            if not isinstance(recording, Recording):
                raise TypeError("not a Recording")
            return recording

    @contextmanager
    def _described(self) -> Iterator[None]:
        """Turn what taking the description apart raises into a WearcapError."""
        try:
            yield
        except (WearcapError, TypeError, ValueError, KeyError, AttributeError) as error:
            what = f"its description is unreadable ({error})"
            raise WearcapError(what, self.path, fix="Prepare this recording again.") from error

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
    # One entry only: safetensors writes several in an order that changes from process to process.
    metadata = {"wearcap": dumps({"schema_version": SCHEMA_VERSION, "recording": tree})}
    with atomic_path(path) as temporary:
        temporary.write_bytes(save(dict(sorted(tensors.items())), metadata))


class RecordingStore:
    """A data set on disk. One process may write; any number may read."""

    def __init__(self, root: str | Path):
        """Read the manifest, if there is one. Raises WearcapError when it is not readable."""
        self.root, path = Path(root), Path(root) / MANIFEST
        self.entries: dict[str, Entry] = {}
        if not path.exists():
            return
        try:
            manifest = parse_json(path.read_bytes(), path)
        except OSError as error:
            raise WearcapError(f"cannot be read ({error.strerror or error})", path) from error
        version = manifest.get("schema_version") if isinstance(manifest, dict) else None
        if version != SCHEMA_VERSION:
            what = f"schema version {str(version)[:40]}"
            raise WearcapError(what, path, f"version {SCHEMA_VERSION}", "Prepare the data set again.")
        try:
            for name, row in manifest["recordings"].items():
                for field in dataclasses.fields(Entry):
                    value = row[field.name]
                    if type(value) is not field.type and not (field.type is float and type(value) is int):
                        raise ValueError(f"{field.name} of {name!r} is {str(value)[:40]!r}")
                    if field.type in (int, float) and not 0 <= value <= _MOST.get(field.name, math.inf):
                        raise ValueError(f"{field.name} of {name!r} is {value}")
                entry = Entry(**row)
                if self.root / entry.file != recording_path(self.root, name):
                    raise ValueError(f"{name!r} is at {entry.file!r}, outside this data set")
                if entry.split not in SPLITS:
                    raise ValueError(f"{name!r} is in split {entry.split[:40]!r}")
                if entry.frames * entry.fps and entry.bytes < entry.frames:
                    raise ValueError(f"{name!r} has {entry.frames} frames in {entry.bytes} bytes")
                self.entries[name] = entry
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            what = f"not a readable manifest ({str(error)[:200]})"
            raise WearcapError(what, path, fix="Delete it and prepare the data set again.") from error

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
        recordings = {key: dataclasses.asdict(value) for key, value in sorted(self.entries.items())}
        text = json.dumps({"schema_version": SCHEMA_VERSION, "recordings": recordings}, indent=1)
        write_text(self.manifest_path, text + "\n")

    def path_of(self, name: str) -> Path:
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
        return self.open_file(name).load()

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
    if not name or Path(name).name != name or name.startswith("."):
        raise WearcapError(f"{name!r} cannot name a recording", expected="a plain file name")
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
    raise WearcapError("no recording here", path, "DATASET/NAME or a .safetensors file that `wearcap prepare` wrote")


def dataset_folder(where: str | Path) -> Path:
    """Folder of the data set of a recording given by the user; file names in the recording are relative to it."""
    path = Path(where)
    return next((folder for folder in (path, *path.parents) if (folder / MANIFEST).is_file()), path.parent)
