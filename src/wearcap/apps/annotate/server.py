"""The annotator's web server: the page's own files, a recording's numbers once, its video in ranges, and saves.

It listens on this machine only, and answers only requests that its guard admits: its own page, opened with its token.
"""

import json
import re
from collections.abc import Callable
from http import HTTPStatus
from pathlib import Path
from typing import Any

import msgspec

from wearcap.apps.annotate.takes import Conflict, Desk
from wearcap.apps.web.connections import DELIVERING, Connections
from wearcap.apps.web.guard import Guard
from wearcap.apps.web.http_server import Answer, Handler, HttpServer
from wearcap.boundary.texts import parse_json
from wearcap.errors import WearcapError
from wearcap.io.formats.contact_labels import annotation_of, hcontact_text

PAGE = Path(__file__).parent / "page"
_TEXTS = {".html": "text/html", ".js": "text/javascript", ".css": "text/css"}
TYPES = {suffix: f"{kind}; charset=utf-8" for suffix, kind in _TEXTS.items()} | {".svg": "image/svg+xml"}
_CONTAINERS = {".webm": "video/webm", ".mkv": "video/x-matroska", ".avi": "video/x-msvideo", ".ogv": "video/ogg"}
VIDEO_TYPES = dict.fromkeys((".mp4", ".m4v", ".mov"), "video/mp4") | _CONTAINERS
MAX_SAVE_BYTES = 16 << 20
PIECE_BYTES = 1 << 18
MAX_CONNECTIONS = 32
"""Most simultaneous connections, each with its own thread; a browser opens six of them to a page.
"""
_PORTS_TRIED = 50


class _Save(msgspec.Struct):
    """What the page sends to save: see `AnnotationFile.save`."""

    labels: Any
    base: str
    client: str
    force: bool = False


class AnnotationServer(HttpServer):
    """Serves a desk until stopped; `port` is the first free one from the requested one on."""

    def __init__(self, desk: Desk, port: int = 8090):
        """Raises WearcapError when no port is free."""
        self.desk, guard = desk, Guard("127.0.0.1")
        for candidate in range(port, min(port + _PORTS_TRIED, 65536)):
            try:
                return super().__init__(guard.host, candidate, _Handler, guard, Connections(MAX_CONNECTIONS))
            except OSError:
                continue
        raise WearcapError(f"no free port from {port} on", fix="Give another one with --port.")

    @property
    def url(self) -> str:
        """Address to open; it contains the token without which the page does not answer."""
        return self.guard.url(self.server_port)

    def wait(self) -> None:
        """Serve until interrupted."""
        while self.thread.is_alive():
            self.thread.join(1.0)


class _Handler(Handler):
    server: AnnotationServer  # pyright: ignore[reportIncompatibleVariableOverride]

    def do_GET(self) -> None:
        self.answer(lambda: self._kept(self.get))

    do_HEAD = do_GET

    def do_POST(self) -> None:
        self.answer(lambda: self._kept(self.post))

    def _kept(self, action: Callable[[str], None]) -> None:
        """Run an admitted action, and keep its connection; errors that a user can fix get a fitting status."""
        self.place.rise(DELIVERING)
        try:
            action(self.path.partition("?")[0])
        except Conflict as error:
            raise Answer(HTTPStatus.CONFLICT, str(error)) from error
        except (ConnectionError, TimeoutError):
            raise
        except (WearcapError, OSError) as error:
            raise Answer(HTTPStatus.UNPROCESSABLE_ENTITY, str(error)) from error

    def error(self, message: str) -> tuple[bytes, str]:
        return json.dumps({"error": message}).encode(), "application/json"

    def get(self, path: str) -> None:
        if path == "/recordings":
            desk = self.server.desk
            return self._send_json([{"name": name, "annotated": desk.path(name).is_file()} for name in desk.names])
        if match := re.fullmatch(r"/recordings/(\d{1,6})(?:/(\w+))?", path):
            return self.get_recording(int(match[1]), match[2] or "")
        file = PAGE / (path[1:] or "index.html")
        if file.parent == PAGE and file.suffix in TYPES and file.is_file():
            return self.send(file.read_bytes(), TYPES[file.suffix])
        raise Answer(HTTPStatus.NOT_FOUND, f"nothing at {path}")

    def get_recording(self, index: int, part: str) -> None:
        desk = self.server.desk
        if index >= len(desk.names):
            raise Answer(HTTPStatus.NOT_FOUND, f"no recording {index}")
        take = desk.take(index)
        if part == "":
            labels, revision = desk.file(index).read()
            about = take.header() | {"labels": annotation_of(labels, take.clock), "revision": revision}
            return self._send_json(about | {"file": str(desk.file(index).path)})
        if part == "numbers":
            return self.send(take.numbers(), "application/octet-stream")
        if part == "export":
            labels, _ = desk.file(index).read()
            name = re.sub(r"[^\w.\- ]", "_", f"{take.clock.name}.json", flags=re.ASCII)
            text, download = hcontact_text(labels, take.clock), f'attachment; filename="{name}"'
            return self.send(text.encode(), "application/json", Content_Disposition=download)
        if part == "video" and take.video is not None:
            return self.send_video(take.video.path)
        raise Answer(HTTPStatus.NOT_FOUND, f"recording {index} has no {part}")

    def post(self, path: str) -> None:
        match = re.fullmatch(r"/recordings/(\d{1,6})/labels", path)
        if match is None or int(match[1]) >= len(self.server.desk.names):
            raise Answer(HTTPStatus.NOT_FOUND, f"nothing to save at {path}")
        if self.headers.get_content_type() != "application/json":
            raise Answer(HTTPStatus.FORBIDDEN, "only this server's own page may save")
        body = self.body(MAX_SAVE_BYTES)
        try:
            sent = parse_json(body, "not a save", "message", schema=_Save)
        except WearcapError as error:
            raise Answer(HTTPStatus.BAD_REQUEST, str(error)) from error
        file = self.server.desk.file(int(match[1]))
        revision = file.save(sent.labels, sent.base, client=sent.client, force=sent.force)
        self._send_json({"revision": revision})

    def _send_json(self, content: Any) -> None:
        self.send(json.dumps(content).encode(), "application/json")

    def send_video(self, path: Path) -> None:
        """Send a whole file, or the one requested range (RFC 9110, section 14)."""
        size = path.stat().st_size
        span = _byte_range(self.headers.get("Range", ""), size)
        if span is None:
            status, about = HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE, {"Content-Range": f"bytes */{size}"}
            return self.begin(status, about | {"Content-Length": "0"})
        start, stop, partial = span
        about = {
            "Content-Type": VIDEO_TYPES.get(path.suffix.lower(), "application/octet-stream"),
            "Accept-Ranges": "bytes",
            "Content-Length": str(stop - start),
        }
        if partial:
            about["Content-Range"] = f"bytes {start}-{stop - 1}/{size}"
        self.begin(HTTPStatus.PARTIAL_CONTENT if partial else HTTPStatus.OK, about)
        if self.command == "HEAD":
            return None
        with open(path, "rb") as file:
            file.seek(start)
            while start < stop and (piece := file.read(min(PIECE_BYTES, stop - start))):
                self.wfile.write(piece)
                start += len(piece)
        if start < stop:  # the file was cut short meanwhile
            self.close_connection = True
        return None


def _byte_range(header: str, size: int) -> tuple[int, int, bool] | None:
    """Start, stop and whether it is partial, of a Range header; None if the range is outside the file."""
    match = re.fullmatch(r"bytes=(\d{0,18})-(\d{0,18})", header.strip())
    if match is None or not (match[1] or match[2]):
        return 0, size, False
    if not match[1]:
        start, stop = max(0, size - int(match[2])), size
    else:
        start, stop = int(match[1]), min(size, int(match[2]) + 1 if match[2] else size)
        if match[2] and int(match[2]) < start:
            return 0, size, False
    return (start, stop, True) if start < stop else None
