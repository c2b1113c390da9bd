"""What a kind of file or folder is: how it is known, and what reads it."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from wearcap.checks.report import Check, Finding
from wearcap.io.conventions import Conventions
from wearcap.recording import Motion, Recording

PACKED = (".gz", ".xz")


class Loaded(NamedTuple):
    """A recording, and its reader's findings."""

    recording: Recording
    findings: list[Finding]


@dataclass(frozen=True)
class Kind:
    """A kind of file or folder that holds a recording."""

    name: str
    reader: Callable[..., Recording | Motion | Loaded | tuple[Recording, list[Finding]]]
    """Of a path and, where any may be stated, the conventions."""
    suffixes: tuple[str, ...] = ()
    """Of its files, without compression; none for a folder."""
    knows: Callable[[Path], Any] = Path.exists
    """Whether the content of a file with such a suffix, or of a folder, is of this kind."""
    stated: tuple[str, ...] = ()
    """Conventions that may be stated; the format fixes the others."""
    parts: Callable[[Path], list[str]] | None = None
    """Names of the recordings in a folder of several; its reader takes one of them, too."""

    def may_be(self, path: Path) -> bool:
        """Whether a path is a folder, or a file with one of the suffixes, as the kind wants it."""
        if not self.suffixes or path.is_dir():
            return not self.suffixes and path.is_dir()
        suffixes = [suffix.lower() for suffix in path.suffixes if suffix.lower() not in PACKED]
        return suffixes != [] and suffixes[-1] in self.suffixes

    def load(self, path: Path, how: Conventions, part: str | None = None) -> Loaded:
        """Read one. Raises WearcapError for a convention that has no meaning for it, and as its reader does."""
        how.only(*self.stated, where=path)
        content = self.reader(path, *([how] if self.stated else []), *([part] if part else []))
        if isinstance(content, Motion):
            content = Recording(path.name.split(".")[0], motion=content, skeleton=content.skeleton)
        if isinstance(content, Recording):
            return Loaded(content, [Check("file").ok("read", content.note)] if content.note else [])
        return Loaded(*content)


def known(path: Path, kinds: Sequence[Kind]) -> Kind | None:
    """The first kind that a path is of. Raises WearcapError for a file that cannot be opened."""
    return next((kind for kind in kinds if kind.may_be(path) and kind.knows(path)), None)


def below(path: Path, kinds: Sequence[Kind]) -> Iterator[Path]:
    """Files and folders of these kinds at or below a path, in order, none of them inside another."""
    if known(path, kinds):
        yield path
    elif path.is_dir():
        for each in sorted(path.iterdir()):
            if each.is_file() or (each.is_dir() and not each.is_symlink()):
                yield from below(each, kinds)
