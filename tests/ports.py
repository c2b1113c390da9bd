"""Ports of this machine: a free one, and whether somebody listens at one."""

import socket


def free_port(kind: socket.SocketKind = socket.SOCK_STREAM) -> int:
    """A port that nobody uses now."""
    with socket.socket(type=kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def listens(port: int, kind: socket.SocketKind = socket.SOCK_STREAM) -> bool:
    """Whether a port is taken; what serves TCP must also answer."""
    with socket.socket(type=kind) as probe:
        if kind == socket.SOCK_STREAM:
            return probe.connect_ex(("127.0.0.1", port)) == 0
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return True
    return False
