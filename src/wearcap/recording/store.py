"""A directory of recordings: one `manifest.json`, one memory-mapped `.safetensors` file per recording."""

import dataclasses
import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import safetensors
from safetensors.torch import save
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.files import atomic_path, sha256_of, write_text
from wearcap.recording.recording import Recording
from wearcap.recording.serialize import dumps, flatten, unflatten

SCHEMA_VERSION = 1
SPLITS = ("train", "val", "test")


@dataclass(frozen=True)
class Entry:
    """What the manifest knows about one recording."""

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


class RecordingFile:
    """One recording on disk, opened without reading its tensors; slices read nothing but themselves."""

    def __init__(self, path: str | Path):
        self.path = Path(path)
        try:
            self._file = safetensors.safe_open(str(self.path), framework="pt")
        except FileNotFoundError as error:
            raise WearcapError("no such recording", where=path) from error
        except (safetensors.SafetensorError, OSError, RuntimeError) as error:
            raise WearcapError(
                "not a readable recording", where=path, expected="a complete .safetensors file",
                fix="Prepare this recording again.",
            ) from error  # fmt: skip
        metadata = self._file.metadata() or {}
        if "wearcap" not in metadata:
            raise WearcapError("a .safetensors file, but not a recording", where=path,
                               expected="one that `wearcap prepare` wrote")  # fmt: skip
        try:
            content = json.loads(metadata["wearcap"])
            version, self._tree = content["schema_version"], content["recording"]
        except (json.JSONDecodeError, KeyError, TypeError) as error:
            raise self._unreadable(error) from error
        if version != SCHEMA_VERSION:
            raise WearcapError(f"schema version {version}", where=path,
                               expected=f"version {SCHEMA_VERSION}", fix="Prepare it again.")  # fmt: skip

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
        """One top-level part ("skeleton", "head", "motion" …), or None where the recording lacks it."""
        return self._built(self._tree.get(name))

    def load(self) -> Recording:
        recording = self._built(self._tree)
        if not isinstance(recording, Recording):
            raise self._unreadable(TypeError("not a Recording"))
        return recording

    def _built(self, tree):
        try:
            return unflatten(tree, self.tensor)
        except (WearcapError, TypeError, ValueError, KeyError, AttributeError) as error:
            raise self._unreadable(error) from error

    def _unreadable(self, error: Exception) -> WearcapError:
        return WearcapError(f"its description is unreadable ({error})", where=self.path,
                            fix="Prepare this recording again.")  # fmt: skip

    def _require(self, key: str) -> None:
        if key not in self.keys:
            raise WearcapError(f"this recording has no {key!r}", where=self.path,
                               expected=f"one of {', '.join(sorted(self.keys))}")  # fmt: skip


def save_recording(recording: Recording, path: str | Path) -> None:
    """Write one recording atomically; equal recordings give equal bytes."""
    tree, tensors = flatten(recording)
    # One entry only: safetensors writes several in an order that changes from process to process.
    metadata = {"wearcap": dumps({"schema_version": SCHEMA_VERSION, "recording": tree})}
    with atomic_path(path) as temporary:
        temporary.write_bytes(save(dict(sorted(tensors.items())), metadata))


class RecordingStore:
    """A data set on disk. Writing is for one process; any number may read."""

    def __init__(self, root: str | Path):
        self.root = Path(root)
        self.entries: dict[str, Entry] = self._read_manifest() if self.manifest_path.exists() else {}

    @classmethod
    def open(cls, root: str | Path) -> "RecordingStore":
        """A store that must exist already."""
        if not (Path(root) / "manifest.json").is_file():
            raise WearcapError("no data set here", where=root, expected="a folder with a manifest.json",
                               fix="Make one with `wearcap prepare`.")  # fmt: skip
        return cls(root)

    @property
    def manifest_path(self) -> Path:
        return self.root / "manifest.json"

    def _read_manifest(self) -> dict[str, Entry]:
        try:
            manifest = json.loads(self.manifest_path.read_text(encoding="utf-8"))
            version = manifest["schema_version"]
            if version == SCHEMA_VERSION:
                entries = {name: Entry(**entry) for name, entry in manifest["recordings"].items()}
                for name, entry in entries.items():
                    if self.root / entry.file != recording_path(self.root, name):
                        raise ValueError(f"{name!r} lies at {entry.file!r}, outside this data set")
                return entries
        except (
            ValueError,
            KeyError,
            TypeError,
            AttributeError,
        ) as error:  # JSON's and UTF-8's errors are ValueErrors
            raise WearcapError(f"not a readable manifest ({error})", where=self.manifest_path,
                               fix="Delete it and prepare the data set again.") from error  # fmt: skip
        raise WearcapError(f"schema version {version}", where=self.manifest_path,
                           expected=f"version {SCHEMA_VERSION}", fix="Prepare the data set again.")  # fmt: skip

    def names(self, split: str | None = None) -> list[str]:
        """Recordings of one split ("train", "val", "test"), or all, in order."""
        if split is not None and split not in SPLITS:
            raise WearcapError(f"no split {split!r}", expected=f"one of {', '.join(SPLITS)}")
        return sorted(name for name, entry in self.entries.items() if split in (None, entry.split))

    def add(self, recording: Recording, *, split: str, config_hash: str) -> None:
        """Write a recording and its manifest entry."""
        save_recording(recording, self.path_of(recording.name))
        self.register({recording.name: entry_for(recording, self.root, split, config_hash)})

    def register(self, entries: dict[str, Entry]) -> None:
        """Enter recordings by name whose files are already in place (written by workers)."""
        self.entries |= entries
        recordings = {key: dataclasses.asdict(value) for key, value in sorted(self.entries.items())}
        text = json.dumps({"schema_version": SCHEMA_VERSION, "recordings": recordings}, indent=1)
        write_text(self.manifest_path, text + "\n")

    def path_of(self, name: str) -> Path:
        return recording_path(self.root, name)

    def open_file(self, name: str) -> RecordingFile:
        """Open one recording for slicing. Raises WearcapError when it is missing, truncated or foreign."""
        if name not in self.entries:
            raise WearcapError(f"no recording {name!r}", where=self.manifest_path,
                               expected=f"one of {len(self.entries)} recordings, as {self.names()[:3]}")  # fmt: skip
        path = self.root / self.entries[name].file
        if path.exists() and path.stat().st_size != self.entries[name].bytes:
            raise WearcapError(f"{path.stat().st_size} bytes long", where=path,
                               expected=f"{self.entries[name].bytes} bytes, as the manifest says",
                               fix="It was cut short or replaced: prepare it again.")  # fmt: skip
        return RecordingFile(path)

    def load(self, name: str) -> Recording:
        return self.open_file(name).load()

    def verify(self) -> Iterator[tuple[str, WearcapError | None]]:
        """Check every file against its checksum; yields (name, what is wrong or None)."""
        for name, entry in sorted(self.entries.items()):
            try:
                self.open_file(name)
                wrong = sha256_of(self.root / entry.file) != entry.sha256
                yield name, WearcapError("its checksum differs from the manifest's", where=entry.file,
                                         fix="Prepare it again.") if wrong else None  # fmt: skip
            except WearcapError as error:
                yield name, error


def recording_path(root: Path, name: str) -> Path:
    """Where a data set keeps a recording. Raises WearcapError when the name is no plain file name."""
    if not name or Path(name).name != name or name.startswith("."):
        raise WearcapError(f"{name!r} cannot name a recording", expected="a plain file name")
    return Path(root) / "recordings" / f"{name}.safetensors"


def entry_for(recording: Recording, root: Path, split: str, config_hash: str) -> Entry:
    """The manifest entry of a recording whose file has been written."""
    if split not in SPLITS:
        raise WearcapError(f"no split {split!r}", expected=f"one of {', '.join(SPLITS)}")
    path = recording_path(root, recording.name)
    stream = recording.motion or recording.head
    frames = len(stream.timestamps) if stream else 0
    fps = round(1 / stream.timestamps.diff().median().item(), 4) if stream and frames > 1 else 0.0
    return Entry(
        file=path.relative_to(root).as_posix(), sha256=sha256_of(path), bytes=path.stat().st_size, frames=frames,
        fps=fps, duration_s=round(recording.duration_s, 4), subject=recording.subject,
        location=recording.location, activity=recording.activity, split=split, license=recording.license,
        config_hash=config_hash,
    )  # fmt: skip
