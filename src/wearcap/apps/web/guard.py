"""Guard of a page in the browser: it admits requests with its token, from its own pages, under its own name.

Every page that is open in a browser can send requests to this machine. Three checks keep the others out: the token in
the address that a command prints, which its page then keeps as a cookie; `Origin`, which a page cannot choose in a
browser; and `Host`, which reveals a foreign name that was made to point here.
"""

import ipaddress
import re
import secrets
import socket
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable
from urllib.parse import parse_qs

LOOPBACK = frozenset({"127.0.0.1", "::1", "localhost"})
HEADERS = {
    "Referrer-Policy": "same-origin",  # the address contains the token
    "X-Frame-Options": "DENY",
    "Cross-Origin-Resource-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "Content-Security-Policy": "default-src 'self'; frame-src 'none'; object-src 'none'; base-uri 'none'; form-action 'none'",
}
"""Headers of every answer: they keep the token inside the page, the page out of other pages' frames, and strangers' scripts
and other sites out of the page.
"""
_HOST = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+)(?::([0-9]{1,5}))?")


@runtime_checkable
class _Headers(Protocol):
    """Headers of a request, the common interface of `http.server` and `websockets`."""

    def get_all(self, name: str, /) -> list[str] | None: ...


class Refused(Exception):
    """Raised for a request that must not be answered, with the reason; to be sent with status 403."""


@dataclass(frozen=True)
class Guard:
    """Admits requests to the page that is served on the address `host`, by a secret token."""

    host: str
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24), repr=False)
    open: bool = False
    """Whether requests need no token, only the right name and no foreign page."""

    @classmethod
    def of(cls, host: str, token: str | None) -> "Guard":
        """A guard with a given token; without one, requests need none."""
        return cls(host, open=True) if token is None else cls(host, token)

    def url(self, port: int) -> str:
        """The address to open, with the token."""
        name = _plain(self.host)
        if self._everywhere:
            name = "::1" if name == "::" else "127.0.0.1"
        return f"http://{f'[{name}]' if ':' in name else name}:{port}/?token={self.token}"

    def admit(self, target: str, headers: _Headers) -> dict[str, str]:
        """Headers to send with the answer to a request for `target`. Raises Refused where it must not be answered."""
        host = _single(headers, "Host") or ""
        match = _HOST.fullmatch(host)
        name = "" if match is None else _plain(match[1])
        ours = name in LOOPBACK or name == _plain(self.host)
        # A foreign name cannot be an IP address, so any IP address may be right.
        ours = ours or (self._everywhere and (_address(name) is not None or name == socket.gethostname().lower()))
        if match is None or not ours:
            raise Refused(f"this page has another address than {host[:80]!a}: open the one that was printed")
        origin = _single(headers, "Origin")
        if origin is not None and origin.lower() not in (f"http://{host}".lower(), f"https://{host}".lower()):
            raise Refused("only this server's own page may speak to it")
        if self.open:
            return HEADERS
        cookie = f"wearcap_token_{match[2] or 80}"  # cookies ignore ports, and several pages may be open
        if self._is_token(parse_qs(target.partition("?")[2]).get("token", [])):
            return HEADERS | {"Set-Cookie": f"{cookie}={self.token}; Path=/; HttpOnly; SameSite=Strict"}
        pairs = [pair.partition("=") for line in headers.get_all("Cookie") or [] for pair in line.split(";")]
        if self._is_token([value.strip() for key, _, value in pairs if key.strip() == cookie]):
            return HEADERS
        raise Refused("the token is missing or of an earlier start: open the whole address that was printed")

    @property
    def _everywhere(self) -> bool:
        """Whether the page is served on all of the machine's addresses."""
        address = _address(_plain(self.host))
        return self.host == "" or (address is not None and address.is_unspecified)

    def _is_token(self, given: list[str]) -> bool:
        wanted = self.token.encode()
        return any(secrets.compare_digest(each.encode(errors="replace"), wanted) for each in given)


def _single(headers: _Headers, name: str) -> str | None:
    """A header's value. Raises Refused if there are two, of which different readers may take different ones."""
    values = headers.get_all(name) or []
    if len(values) > 1:
        raise Refused(f"{len(values)} headers {name}")
    return values[0] if values else None


def _address(name: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(name)
    except ValueError:
        return None


def _plain(name: str) -> str:
    """Canonical form of a host's name or address for comparison: lower case, no brackets, shortest IPv6."""
    name = name.strip("[]").lower()
    address = _address(name)
    return name if address is None else str(address)
