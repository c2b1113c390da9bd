"""A viser server that answers only requests admitted by its guard.

viser itself answers every page of every site, and has no setting for that. Requests are decided by the
`process_request` that it passes to `websockets`; while it starts, the guard's is put in front of it.
"""

import logging
import math
import secrets
import socket
import threading
import time
from http import HTTPStatus
from pathlib import Path
from typing import Any, Literal

import rich
import viser
import websockets.asyncio.server
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from wearcap.apps.web.connections import BACKLOG, DELIVERING
from wearcap.apps.web.guard import Guard, Refused
from wearcap.apps.web.sockets import CountedConnection
from wearcap.errors import WearcapError

_starting = threading.Lock()
_PAGE = Path(viser.__file__).parent / "client" / "build" / "index.html"
"""The page that viser serves."""
_SCRIPTS = {b"<script data-p=": b'<script nonce="%b" data-p=', b'e.type="module"': b'e.type="module";e.nonce="%b"'}
"""The script in viser's page, and where it makes an element `e` of the program that it has unpacked: each with a nonce."""
_POLICY = (
    "default-src 'none'; script-src 'nonce-{nonce}' 'unsafe-eval'; worker-src blob:; connect-src 'self' data: blob:; "
    "style-src 'unsafe-inline'; img-src data: blob:; font-src data:; base-uri 'none'; form-action 'none'"
)
"""Content security policy of viser's page: no script but its own runs, nothing is framed, and only this server is asked.

What `eval` takes comes from that program alone: a part of it, which sorts splats, does not start without.
"""


def _start_server(guard: Guard, port: int, label: str) -> viser.ViserServer:
    """A server on the guard's host and the next free port.

    Raises WearcapError if the host is no address of this machine, or viser cannot be guarded.
    """
    _check_host(guard.host)
    hooked = False

    def serve(*arguments: Any, **options: Any) -> Any:
        nonlocal hooked
        answer: Any = options.get("process_request")

        def guarded(connection: Any, request: Request) -> Response | None:
            """The answer to a page request or a WebSocket handshake (None: go on), after the guard has admitted it."""
            try:
                granted = guard.admit(request.path, request.headers)
            except Refused as refused:
                return connection.respond(HTTPStatus.FORBIDDEN, f"{refused}\n")
            connection.place.rise(DELIVERING)  # with the token it is the user's
            headers = Headers(pair for pair in request.headers.raw_items() if pair[0].lower() != "accept-encoding")
            response = answer(connection, Request(request.path, headers))
            if response is not None:
                response.headers.update(granted | _restrict(response))
            return response

        # Another thread may start a server of its own meanwhile.
        if getattr(answer, "__module__", "").startswith("viser."):
            options |= {"process_request": guarded, "create_connection": CountedConnection, "backlog": BACKLOG}
            hooked = _PAGE.is_file() and all(_PAGE.read_bytes().count(script) == 1 for script in _SCRIPTS)
        return original(*arguments, **options)

    console = rich.get_console()
    with _starting:
        quiet, console.quiet = console.quiet, True  # viser prints an address without the token
        original = websockets.asyncio.server.serve
        websockets.asyncio.server.serve = serve  # pyright: ignore[reportAttributeAccessIssue]
        try:
            server = viser.ViserServer(host=guard.host, port=port, label=label, verbose=False)
        finally:
            websockets.asyncio.server.serve = original
            console.quiet = quiet
    if not hooked:  # nothing has been shown on it yet
        server.stop()
        what = f"viser {viser.__version__} does not let its pages be guarded against other sites"
        fix = "Install the version that wearcap asks for: pip install 'viser>=1.1.1,<1.1.2'."
        raise WearcapError(what, expected="a viser that serves its page as 1.1.1 does", fix=fix)
    return server


def _restrict(response: Response) -> dict[str, str]:
    """Let viser's own two scripts run in its page, and no others: they get a nonce. Returns the headers that say so."""
    if not response.headers.get("Content-Type", "").startswith("text/html"):
        return {}
    nonce = secrets.token_urlsafe(16)
    for script, marked in _SCRIPTS.items():
        response.body = response.body.replace(script, marked % nonce.encode())
    del response.headers["Content-Length"]
    return {"Content-Security-Policy": _POLICY.format(nonce=nonce), "Content-Length": str(len(response.body))}


def _check_host(host: str) -> None:
    """Raise WearcapError if nothing can be served on a host; viser would retry forever."""
    problem = ""
    try:
        places = socket.getaddrinfo(host or None, 0, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except OSError as error:
        places, problem = [], str(error)
    for family, kind, _, _, address in places:
        try:
            with socket.socket(family, kind) as probe:
                return probe.bind(address)
        except OSError as error:
            problem = str(error)
    what = f"cannot serve a page on {host!r} ({problem})"
    fix = "Leave out --host for this machine alone, or give 0.0.0.0 for all of its addresses."
    raise WearcapError(what, expected="a name or address of this machine", fix=fix)


class ServedPage:
    """A guarded page of viser with z up; `stop` ends its `run`."""

    step_s: float = 0.1
    """Time from one update to the next."""

    def __init__(self, label: str, host: str, port: int, control_width: Literal["medium", "large"]):
        self.guard = Guard(host)
        self.server = _start_server(self.guard, port, label)
        self.server.scene.set_up_direction("+z")
        self.server.gui.configure_theme(control_width=control_width, show_logo=False, show_share_button=False)
        self._stopped = False

    @property
    def url(self) -> str:
        """Address to open; it contains the token without which the page does not answer."""
        return self.guard.url(self.server.get_port())

    def run(self, seconds: float = math.inf) -> None:
        """Update the page until it is stopped, or for the given seconds."""
        begin = time.monotonic()
        while not self._stopped and (now := time.monotonic()) - begin < seconds:
            self.update(now)
            time.sleep(max(0.002, self.step_s - (time.monotonic() - now)))

    def update(self, now_s: float) -> None:
        """Do what is due at our time (s)."""
        raise NotImplementedError

    def serve(self) -> None:
        """Run until interrupted, then stop."""
        # Browsers open connections in advance and drop them; the server's log of that is of no use to a user.
        logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
        try:
            self.run()
        finally:
            self.stop()

    def stop(self) -> None:
        self._stopped = True
        self.server.stop()
