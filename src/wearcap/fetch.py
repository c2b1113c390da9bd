"""Files from the network: verified, resumed where a download broke off, and found again.

A file lies in a folder that is named after its digest, and is hashed whenever it is asked for, so that one that was damaged is
fetched again. WEARCAP_WEIGHTS=DIR names a folder that is looked into first; where it is set, the network is not used.
"""

import base64
import hashlib
import os
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import HTTPRedirectHandler, Request, build_opener

from filelock import FileLock
from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TransferSpeedColumn

from wearcap.errors import WearcapError
from wearcap.files import cache_folder, explaining_writes
from wearcap.version import __version__

VARIABLE = "WEARCAP_WEIGHTS"
"""Environment variable with the folder of a machine without a network."""
TRIES, TIMEOUT_S, CHUNK = 5, 30.0, 1 << 18
"""Requests to a mirror while each brings something, patience (s) with a silent one, and bytes of a read."""
_LOOPBACK = ("localhost", "127.0.0.1", "::1")


@dataclass(frozen=True)
class Remote:
    """A file that lies somewhere else."""

    name: str
    """Name of the file, without folders."""
    urls: tuple[str, ...]
    """Addresses of the same bytes (https; http on this machine alone), in the order in which they are tried."""
    digest: str
    """Digest of the bytes: "sha256:HEX", or "sha512-BASE64" as in npm's lock files."""
    bytes: int
    """Size of the file, or the most bytes that are accepted; a longer answer is refused before it is read to its end."""

    def fits(self, path: Path) -> bool:
        """Whether a path holds this file, by its digest."""
        if not path.is_file():
            return False
        with open(path, "rb") as file:
            return hashlib.file_digest(file, self.digest[:6]).hexdigest() == self.hex

    @property
    def hex(self) -> str:
        """The digest's hexadecimal digits."""
        text = self.digest[7:]
        return text if self.digest[6] == ":" else base64.b64decode(text).hex()


def fetch(remote: Remote, folder: Path | None = None) -> Path:
    """The file of a remote: of $WEARCAP_WEIGHTS, of `folder` (default: the user's cache), or fetched into it from the first
    mirror that has it.

    Processes that want the same file wait for the one that fetches it. Raises WearcapError when no mirror has it, when it has
    another digest or is too long, when there is no network, and when the folder cannot be written.
    """
    own = os.environ.get(VARIABLE)
    if own and os.path.exists(path := Path(own, remote.name)):
        if remote.fits(path):
            return path
        raise WearcapError(f"another file than {remote.digest}", path, fix=f"Download {remote.urls[0]} again.")
    path = (folder or cache_folder() / "fetched") / remote.hex[:16] / remote.name
    if remote.fits(path):
        return path
    if own:
        raise WearcapError(f"no {remote.name} in {VARIABLE}", own, fix=f"Download {remote.urls[0]} into it.")
    part = path.with_name(f"{path.name}.part")
    with explaining_writes(path, only_about=(path.parent, path.with_name(f"{path.name}.lock"), part)):
        path.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(path.with_name(f"{path.name}.lock")):
            if not remote.fits(path):
                _download(remote, part)
                os.replace(part, path)
    return path


def _download(remote: Remote, part: Path) -> None:
    """Bring the whole file, verified, to `part`. Raises WearcapError when no mirror has it."""
    failures = []
    for url in remote.urls:
        for _ in range(TRIES):
            before = _size(part)
            try:
                _receive(url, part, remote)
                if remote.fits(part):
                    return
                reason: Exception | str = f"another file than {remote.digest[:24]}…"
                part.unlink()
                if not before:
                    break  # otherwise it may be what lay here that was wrong
            except (OSError, HTTPException, ValueError) as error:
                reason = error
                if _size(part) <= before:
                    break  # otherwise the next request goes on from where this one broke off
        failures.append(f"{urlsplit(url).netloc}: {reason}")
    what = f"{remote.name} cannot be fetched ({'; '.join(failures)})"
    fix = f"Run again with a network, or download {remote.urls[0]} into a folder DIR and set {VARIABLE}=DIR."
    raise WearcapError(" ".join(what.split()), fix=fix)


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


class _SafeRedirects(HTTPRedirectHandler):
    """Redirects to addresses that `_require_safe` accepts."""

    def redirect_request(self, req, fp, code, msg, headers, newurl):
        _require_safe(newurl)
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def _require_safe(url: str) -> None:
    """Raise ValueError for an address that is not https, but for http on this machine."""
    parts = urlsplit(url)
    if parts.scheme != "https" and not (parts.scheme == "http" and parts.hostname in _LOOPBACK):
        raise ValueError(f"{url[:200]} is no https address")


def _receive(url: str, part: Path, remote: Remote) -> None:
    """Append to `part` what it lacks of a file, or write it anew where the server sends all of it.

    Raises OSError or HTTPException when the answer is an error or breaks off, ValueError when it is too long or its address not
    https, WearcapError when `part` cannot be written.
    """
    _require_safe(url)
    have = _size(part)
    headers = {"User-Agent": f"wearcap/{__version__}"} | ({"Range": f"bytes={have}-"} if have else {})
    try:
        answer = build_opener(_SafeRedirects).open(Request(url, headers=headers), timeout=TIMEOUT_S)
    except HTTPError as error:
        if error.code == 416 and have:
            return  # there is no more of it
        raise
    with answer:
        if not (answer.status == 206 and answer.headers.get("Content-Range", "").startswith(f"bytes {have}-")):
            have = 0
        length = answer.headers.get("Content-Length", "")
        total = have + int(length) if length.isdecimal() else None
        columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TransferSpeedColumn())
        with (
            explaining_writes(part, only_about=(part,)),
            open(part, "ab" if have else "wb") as file,
            Progress(*columns, console=Console(stderr=True)) as bar,
        ):
            line = bar.add_task(remote.name, total=total or remote.bytes, completed=have)
            while chunk := answer.read(CHUNK):
                have += len(chunk)
                if max(have, total or 0) > remote.bytes:
                    file.truncate(0)
                    raise ValueError(f"more than the {remote.bytes} bytes that are expected")
                file.write(chunk)
                bar.update(line, completed=have)
            file.flush()
            os.fsync(file.fileno())
        if total is not None and have < total:
            raise ConnectionError(f"it broke off after {have} of {total} bytes")
