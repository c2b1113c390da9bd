"""The annotator's web server: the page's own files, a recording's numbers once, its video in ranges, and saves.

It listens on this machine only, and answers only requests that its guard admits: its own page, opened with its token.
"""

import contextlib
import json
import os
import re
import socket
import sys
import threading
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import msgspec

from wearcap.apps.annotate.takes import Conflict, Desk
from wearcap.apps.web.connections import DELIVERING, Connection, Connections
from wearcap.apps.web.guard import Guard, Refused
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
IDLE_S = 30.0
"""Idle time (s) after which a connection is closed. A browser reopens it when needed."""
_PORTS_TRIED = 50
_GONE = (ConnectionError, TimeoutError)


class _Save(msgspec.Struct):
    """What the page sends to save: see `AnnotationFile.save`."""

    labels: Any
    base: str
    client: str
    force: bool = False


class AnnotationServer(ThreadingHTTPServer):
    """Serves a desk until stopped; `port` is the first free one from the requested one on."""

    daemon_threads = True
    request_queue_size = 128  # queued requests of a burst are served in turn, instead of being retried after a second
    allow_reuse_address = os.name == "posix"

    def __init__(self, desk: Desk, port: int = 8090):
        """Raises WearcapError when no port is free."""
        self.desk, self.guard, self.stopped = desk, Guard("127.0.0.1"), False
        self._connections, self._places = Connections(MAX_CONNECTIONS), dict[Any, Connection]()
        for candidate in range(port, min(port + _PORTS_TRIED, 65536)):
            try:
                super().__init__((self.guard.host, candidate), _Handler)
                break
            except OSError:
                continue
        else:
            raise WearcapError(f"no free port from {port} on", fix="Give another one with --port.")
        self._thread = threading.Thread(target=self.serve_forever, daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """Address to open; it contains the token without which the page does not answer."""
        return self.guard.url(self.server_port)

    def wait(self) -> None:
        """Serve until interrupted."""
        while self._thread.is_alive():
            self._thread.join(1.0)

    def stop(self) -> None:
        """Stop serving, on open connections too."""
        self.stopped = True
        self.shutdown()
        self.server_close()

    def process_request(self, request: Any, client_address) -> None:
        """Answer a connection in its own thread; if there are too many, one that has not been admitted is closed for it."""
        place = self._connections.enter(partial(request.shutdown, socket.SHUT_RDWR))
        if place is None:
            with contextlib.suppress(OSError):
                request.sendall(b"HTTP/1.1 503 Service Unavailable\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")
            return self.shutdown_request(request)
        self._places[request] = place
        try:
            return super().process_request(request, client_address)
        except BaseException:  # no thread was available
            self._places.pop(request).leave()
            raise

    def process_request_thread(self, request, client_address) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._places.pop(request).leave()

    def keep(self, request: Any) -> None:
        """A connection has been admitted: others are closed before it."""
        self._places[request].rise(DELIVERING)

    def handle_error(self, request, client_address) -> None:
        """Ignore dropped and idle connections, which are normal when browsers seek in a video."""
        if not isinstance(sys.exception(), _GONE):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: AnnotationServer  # pyright: ignore[reportIncompatibleVariableOverride]
    timeout = IDLE_S

    def log_message(self, format: str, *args) -> None:
        """Log no requests."""

    def handle_one_request(self) -> None:
        self._granted: dict[str, str] = {}
        super().handle_one_request()

    def do_GET(self) -> None:
        self._answer(self.get)

    do_HEAD = do_GET

    def do_POST(self) -> None:
        self._answer(self.post)

    def _answer(self, action) -> None:
        """Run an admitted action; errors that a user can fix become {"error": …} with a fitting status."""
        if self.server.stopped:
            self.close_connection = True
            return
        self._granted = {"Connection": "close"}
        try:
            self._granted = self.server.guard.admit(self.path, self.headers)
            self.server.keep(self.request)
            action(self.path.partition("?")[0])
        except Refused as error:
            self.close_connection = True
            self._send_error(HTTPStatus.FORBIDDEN, str(error))
        except Conflict as error:
            self._send_error(HTTPStatus.CONFLICT, str(error))
        except (WearcapError, OSError) as error:
            if isinstance(error, _GONE):
                self.close_connection = True
            else:
                self._send_error(HTTPStatus.UNPROCESSABLE_ENTITY, str(error))

    def end_headers(self) -> None:
        for name, value in self._granted.items():
            self.send_header(name, value)
        super().end_headers()

    def get(self, path: str) -> None:
        if path == "/recordings":
            desk = self.server.desk
            return self._send_json([{"name": name, "annotated": desk.path(name).is_file()} for name in desk.names])
        if match := re.fullmatch(r"/recordings/(\d{1,6})(?:/(\w+))?", path):
            return self.get_recording(int(match[1]), match[2] or "")
        file = PAGE / (path[1:] or "index.html")
        if file.parent == PAGE and file.suffix in TYPES and file.is_file():
            return self._send(file.read_bytes(), TYPES[file.suffix])
        return self._send_error(HTTPStatus.NOT_FOUND, f"nothing at {path}")

    def get_recording(self, index: int, part: str) -> None:
        desk = self.server.desk
        if index >= len(desk.names):
            return self._send_error(HTTPStatus.NOT_FOUND, f"no recording {index}")
        take = desk.take(index)
        if part == "":
            labels, revision = desk.file(index).read()
            about = take.header() | {"labels": annotation_of(labels, take.clock), "revision": revision}
            return self._send_json(about | {"file": str(desk.file(index).path)})
        if part == "numbers":
            return self._send(take.numbers(), "application/octet-stream")
        if part == "export":
            labels, _ = desk.file(index).read()
            text = hcontact_text(labels, take.clock)
            return self._send(text.encode(), "application/json", download=f"{take.clock.name}.json")
        if part == "video" and take.video is not None:
            return self.send_video(take.video.path)
        return self._send_error(HTTPStatus.NOT_FOUND, f"recording {index} has no {part}")

    def post(self, path: str) -> None:
        match = re.fullmatch(r"/recordings/(\d{1,6})/labels", path)
        length = self.headers.get("Content-Length", "")
        self.close_connection = True  # until the body has been read
        if match is None or int(match[1]) >= len(self.server.desk.names):
            return self._send_error(HTTPStatus.NOT_FOUND, f"nothing to save at {path}")
        if self.headers.get_content_type() != "application/json":
            return self._send_error(HTTPStatus.FORBIDDEN, "only this server's own page may save")
        if not re.fullmatch("[0-9]{1,9}", length) or int(length) > MAX_SAVE_BYTES:
            return self._send_error(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"a save of {length[:20] or '?'} bytes")
        body = self.rfile.read(int(length))
        self.close_connection = False
        try:
            sent = parse_json(body, "not a save", "message", schema=_Save)
        except WearcapError as error:
            return self._send_error(HTTPStatus.BAD_REQUEST, str(error))
        file = self.server.desk.file(int(match[1]))
        revision = file.save(sent.labels, sent.base, client=sent.client, force=sent.force)
        return self._send_json({"revision": revision})

    def _send_json(self, content: Any) -> None:
        self._send(json.dumps(content).encode(), "application/json")

    def _send_error(self, status: HTTPStatus, message: str) -> None:
        self._send(json.dumps({"error": message}).encode(), "application/json", status)

    def _send(self, data: bytes, kind: str, status: HTTPStatus = HTTPStatus.OK, download: str = "") -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(data)))
        self.send_header("Cache-Control", "no-store")
        if download:
            quoted = re.sub(r"[^\w.\- ]", "_", download, flags=re.ASCII)
            self.send_header("Content-Disposition", f'attachment; filename="{quoted}"')
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)

    def send_video(self, path: Path) -> None:
        """Send a whole file, or the one requested range (RFC 9110, section 14)."""
        size = path.stat().st_size
        span = _byte_range(self.headers.get("Range", ""), size)
        if span is None:
            self.send_response(HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE)
            self.send_header("Content-Range", f"bytes */{size}")
            self.send_header("Content-Length", "0")
            return self.end_headers()
        start, stop, partial = span
        self.send_response(HTTPStatus.PARTIAL_CONTENT if partial else HTTPStatus.OK)
        self.send_header("Content-Type", VIDEO_TYPES.get(path.suffix.lower(), "application/octet-stream"))
        self.send_header("Accept-Ranges", "bytes")
        self.send_header("Content-Length", str(stop - start))
        if partial:
            self.send_header("Content-Range", f"bytes {start}-{stop - 1}/{size}")
        self.end_headers()
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
