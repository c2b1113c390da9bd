"""Who the pages answer: only those who know the token, from the page itself, under its own name."""

import contextlib
import http.client
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from email.message import Message
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import urlsplit

import msgspec
import numpy as np
import pytest
import torch
import viser
import viser.infra._infra
import websockets.asyncio.server
from annotated_flat import ask, labels
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from silent_sockets import silent
from wearcap.apps.annotate import server as annotate_server
from wearcap.apps.annotate.server import MAX_CONNECTIONS, AnnotationServer
from wearcap.apps.annotate.takes import Desk, Video
from wearcap.apps.scene_editor.editor import ObjectEditor
from wearcap.apps.viewer.page import Page
from wearcap.apps.web.connections import CONNECTIONS
from wearcap.apps.web.guard import Guard, Refused
from wearcap.apps.web.page_server import _start_server
from wearcap.errors import WearcapError
from wearcap.io.formats.environment import FILE_NAME
from wearcap.recording import PointCloud, Recording, RecordingStore
from wearcap.scene.scan import Box, Scan
from wearcap_browser import chromium
from wearcap_testing import recording_of, swaying_motion

FOREIGN = "http://elsewhere.net"
BAD_HOSTS = (
    "elsewhere.net",
    "elsewhere.net:{port}",
    "[::",
    "[::]:{port}",
    "user@127.0.0.1:{port}",
    "127.0.0.1:{port}:1",
    "127.0.0.1:port",
    "127.0.0.1.elsewhere.net:{port}",
    "0.0.0.0:{port}",
    "10.0.0.7:{port}",
    "",
    "localhost:{port}/",
    "127.0.0.1, elsewhere.net",
)


def a_scan() -> Scan:
    """A floor with a crate on it."""
    x, y = np.meshgrid(np.linspace(0, 2, 60), np.linspace(0, 2, 60))
    floor = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], -1)
    crate = np.random.default_rng(0).uniform([0.8, 0.8, 0.05], [1.2, 1.2, 0.5], (800, 3))
    return Scan(np.concatenate([floor, crate]).astype(np.float32))


def a_view(folder: Path) -> Page:
    return Page(Recording("cloud", points=PointCloud(torch.rand(50, 3))), port=18700)


def an_editor(folder: Path) -> ObjectEditor:
    return ObjectEditor(a_scan(), folder / FILE_NAME, "crate", port=18720)


def an_annotator(folder: Path) -> AnnotationServer:
    store = RecordingStore(folder / "flat")
    store.add(recording_of(swaying_motion(600, 0, 60.0), "r0"), split="test", config_hash="x")
    return AnnotationServer(Desk(folder / "flat", folder), port=18740)


def a_film_to_annotate(folder: Path, film: bytes) -> AnnotationServer:
    """An annotator whose recording has a video of these bytes."""
    server, file = an_annotator(folder), folder / "film.mp4"
    file.write_bytes(film)
    desk = server.desk
    take = replace(desk.take(0), video=Video(file, np.zeros((2, 2))))
    desk.take = lambda _: take  # pyright: ignore[reportAttributeAccessIssue]
    return server


@pytest.fixture(params=[a_view, an_editor, an_annotator])
def page(request, tmp_path) -> Iterator[Page | ObjectEditor | AnnotationServer]:
    page = request.param(tmp_path)
    yield page
    page.stop()


@pytest.fixture(params=[a_view, an_editor])
def live_page(request, tmp_path) -> Iterator[Page | ObjectEditor]:
    page = request.param(tmp_path)
    yield page
    page.stop()


def port_of(page) -> int:
    port = urlsplit(page.url).port
    assert port is not None
    return port


def with_token(page) -> str:
    return f"/?token={page.guard.token}"


def status(page, target: str, *headers: str, method: str = "GET") -> int:
    """Status of the answer to a request, written by hand; `Host` is the page's unless there is one."""
    host = () if any(header.startswith("Host:") for header in headers) else (f"Host: 127.0.0.1:{port_of(page)}",)
    with socket.create_connection(("127.0.0.1", port_of(page)), timeout=20) as client:
        client.sendall("\r\n".join([f"{method} {target} HTTP/1.1", *host, *headers, "", ""]).encode("latin-1"))
        line = client.makefile("rb").readline()
    return int(line.split()[1])


UPGRADE = (
    "Upgrade: websocket",
    "Connection: Upgrade",
    "Sec-WebSocket-Version: 13",
    "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
    f"Sec-WebSocket-Protocol: viser-v{viser.__version__}",
)


def check_refusals(page, right: int, *headers: str) -> None:
    """Every request that must be refused is; the same one from the page itself is answered with a status."""
    port, target = port_of(page), with_token(page)
    own = (f"Origin: http://127.0.0.1:{port}", *headers)
    assert status(page, target, *own) == right
    cookie = f"Cookie: other=1; wearcap_token_{port}={page.guard.token}"
    assert status(page, "/", *own, cookie) == right
    for wrong in (
        "/",
        "/?token=",
        "/?token=wrong",
        f"/?token={page.guard.token[:-1]}",
        f"/?token={page.guard.token}x",
        "/?token=%C3%A9",
        f"/?other={page.guard.token}",
        f"/{page.guard.token}",
    ):
        assert status(page, wrong, *own) == 403, wrong
    for wrong in (
        f"wearcap_token_{port}=wrong",
        f"wearcap_token_{port + 1}={page.guard.token}",
        f"wearcap_token_{port}=\xe9",
        "wearcap_token",
    ):
        assert status(page, "/", *own, f"Cookie: {wrong}") == 403, wrong
    for origin in (
        FOREIGN,
        f"{FOREIGN}:{port}",
        f"http://127.0.0.1:{port + 1}",
        f"http://localhost:{port}",
        "null",
        "",
        f"http://127.0.0.1:{port}.elsewhere.net",
    ):
        assert status(page, target, f"Origin: {origin}", *headers) == 403, origin
        assert status(page, "/", f"Origin: {origin}", cookie, *headers) == 403, origin
    for host in BAD_HOSTS:
        host = host.format(port=port)
        assert status(page, target, f"Host: {host}", *headers) == 403, host
        assert status(page, target, f"Host: {host}", f"Origin: http://{host}", *headers) == 403, host
    assert status(page, target, f"Host: 127.0.0.1:{port}", "Host: elsewhere.net", *headers) == 403
    assert status(page, target, *own, f"Origin: {FOREIGN}") == 403
    for name in ("localhost:9000", "LOCALHOST", "[::1]:7", "[0:0:0:0:0:0:0:1]:7"):
        # Another port is one that SSH forwards.
        there = (f"Host: {name}", f"Origin: http://{name.lower()}")
        assert status(page, target, *there, *headers) == right, name


def test_a_page_answers_only_its_own_address(page):
    check_refusals(page, 200)


def test_a_websocket_is_opened_only_by_the_page_itself(live_page):
    check_refusals(live_page, 101, *UPGRADE)
    mixed = [header.replace("websocket", "WebSocket") for header in UPGRADE]
    assert status(live_page, "/", *mixed) == 403


def test_saves_are_only_taken_from_the_page_itself(tmp_path):
    page = an_annotator(tmp_path)
    body = msgspec.json.encode({"labels": labels([(1.0, 2.0)]), "base": "", "client": "a"}).decode()
    kind = ("Content-Type: application/json", f"Content-Length: {len(body)}")
    path, token = "/recordings/0/labels", f"?token={page.guard.token}"
    try:
        for target, *headers in (
            (path,),
            (f"{path}?token=wrong",),
            (path + token, f"Origin: {FOREIGN}"),
            (path + token, "Origin: null"),
            (path + token, "Host: elsewhere.net"),
            (path + token, "Host: [::"),
        ):
            assert status(page, target, *headers, *kind, "", body, method="POST") == 403
        assert not list(tmp_path.glob("*.json"))
        own = f"Origin: http://127.0.0.1:{page.server_port}"
        assert status(page, path + token, own, *kind, "", body, method="POST") == 200
        assert (tmp_path / "r0.contacts.json").is_file()
        assert status(page, f"http://[::{token}") == 404, "a target that is no address is no traceback"
    finally:
        page.stop()


def test_the_token_becomes_a_cookie_that_no_script_and_no_other_site_has(page):
    connection = http.client.HTTPConnection("127.0.0.1", port_of(page), timeout=20)
    connection.request("GET", with_token(page))
    reply = connection.getresponse()
    assert b"<!doctype html>" in reply.read()[:100].lower()
    cookie, *settings = (reply.headers["Set-Cookie"] or "").split("; ")
    assert set(settings) == {"Path=/", "HttpOnly", "SameSite=Strict"}
    assert reply.headers["X-Frame-Options"] == "DENY"
    assert reply.headers["Referrer-Policy"] == "same-origin"
    connection.close()
    assert status(page, "/", f"Cookie: {cookie}") == 200
    connection.request("GET", "/", headers={"Cookie": cookie})
    assert connection.getresponse().headers["Set-Cookie"] is None
    connection.close()
    connection.request("GET", "/")
    reply = connection.getresponse()
    assert page.guard.token not in str(reply.headers) + reply.read().decode()
    connection.close()


def send(client, kind: str, **values) -> None:
    client.send(msgspec.msgpack.encode({"type": kind} | values))


def press(url: str, button: str, **options) -> None:
    """Open the page's WebSocket as a browser would, and press a button of it."""
    with connect(url, subprotocols=[f"viser-v{viser.__version__}"], max_size=2**26, **options) as client:  # pyright: ignore[reportArgumentType]
        client.recv(timeout=20)
        send(client, "ViewerCameraMessage", wxyz=(1.0, 0.0, 0.0, 0.0), position=(0.0, 0.0, 1.0), fov=1.0, near=0.1, far=9.0,
             image_height=9, image_width=9, look_at=(0.0, 0.0, 0.0), up_direction=(0.0, 0.0, 1.0))  # fmt: skip
        send(client, "GuiUpdateMessage", uuid=button, updates={"value": True})
        with contextlib.suppress(TimeoutError):  # until nothing more comes
            while True:
                client.recv(timeout=1.5)


def test_another_sites_websocket_presses_no_button_of_the_scene_editor(tmp_path):
    page = an_editor(tmp_path)
    try:
        page.editing.select_box(Box((1.0, 1.0, 0.3), (0.6, 0.6, 0.6)))
        page.cut()
        page.refresh()
        page.save()
        file, delete = tmp_path / FILE_NAME, page.objects.delete._impl.uuid
        before = file.read_bytes()
        port, token = port_of(page), f"wearcap_token_{port_of(page)}={page.guard.token}"
        place = f"ws://127.0.0.1:{port}"
        for options in (
            {"origin": FOREIGN},
            {"origin": FOREIGN, "additional_headers": {"Cookie": token}},
            {"origin": f"http://127.0.0.1:{port}"},
            {},
        ):
            with pytest.raises(InvalidStatus, match="403"):
                press(place, delete, **options)
        page.run(1.0)
        assert len(page.editing.environment) == 1
        assert file.read_bytes() == before
        press(place, delete, origin=f"http://127.0.0.1:{port}", additional_headers={"Cookie": token})
        assert len(page.editing.environment) == 0, "the same from the page itself does it"
        page.run(1.0)
        assert file.read_bytes() != before
    finally:
        page.stop()


def test_hosts_that_a_page_is_served_on():
    def answers(host: str, name: str) -> bool:
        guard, headers = Guard(host), Message()
        headers["Host"] = name
        try:
            return bool(guard.admit(f"/x?token={guard.token}", headers))
        except Refused:
            return False

    for host in ("127.0.0.1", "::1", "localhost", "192.168.1.5", "Desk.lan", "fe80::2"):
        assert all(answers(host, name) for name in ("127.0.0.1:1", "localhost", "[::1]:80"))
        assert not any(
            answers(host, name) for name in ("10.1.1.1:80", "elsewhere.net", "[fe80::1]", socket.gethostname() + "x")
        )
    assert answers("192.168.1.5", "192.168.1.5:8080")
    assert answers("Desk.lan", "desk.lan:8080")
    assert answers("fe80::2", "[FE80:0::2]:8080")
    for host in ("0.0.0.0", "::", ""):
        own = ("10.1.1.1:80", "[fe80::1]", f"{socket.gethostname()}:8080", "localhost")
        assert all(answers(host, name) for name in own)
        assert not any(answers(host, name) for name in ("elsewhere.net", "10.1.1.1.nip.io", "127.1", "[::", "fe80::1"))
    addresses = (
        ("127.0.0.1", "127.0.0.1"),
        ("::1", "[::1]"),
        ("0.0.0.0", "127.0.0.1"),
        ("::", "[::1]"),
        ("desk.lan", "desk.lan"),
    )
    for host, name in addresses:
        guard = Guard(host)
        assert guard.url(8080) == f"http://{name}:8080/?token={guard.token}"
    assert Guard("localhost").token != Guard("localhost").token
    assert guard.token not in repr(guard)


def test_a_viser_that_cannot_be_guarded_is_not_served(monkeypatch, capsys):
    """One that no longer starts its server where the guard is hooked in."""
    real = websockets.asyncio.server.serve
    bypass = SimpleNamespace(asyncio=SimpleNamespace(server=SimpleNamespace(serve=real)))
    monkeypatch.setattr(viser.infra._infra, "websockets", bypass)
    with pytest.raises(WearcapError, match=r"viser.*guarded.*Install the version"):
        _start_server(Guard("127.0.0.1"), 18760, "page")
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", 18760), timeout=5)
    assert websockets.asyncio.server.serve is real
    assert "18760" not in capsys.readouterr().out, "no address without its token is printed"


def test_a_host_that_is_not_this_machines_is_reported():
    for host in ("192.0.2.1", "nowhere.invalid"):
        with pytest.raises(WearcapError, match=f"cannot serve a page on '{host}'"):
            Page(Recording("cloud", points=PointCloud(torch.rand(50, 3))), host=host, port=18765)


def test_all_pages_start_their_server_guarded():
    source = Path(annotate_server.__file__).parents[1]
    starts = [file.name for file in source.rglob("*.py") if "ViserServer(" in file.read_text(encoding="utf-8")]
    assert starts == ["page_server.py"]


@contextlib.contextmanager
def idle(port: int, count: int) -> Iterator[list[socket.socket]]:
    """Connections that say nothing."""
    clients = [socket.create_connection(("127.0.0.1", port), timeout=20) for _ in range(count)]
    try:
        yield clients
    finally:
        for client in clients:
            client.close()


def closed(client: socket.socket) -> bool:
    """Whether the server has closed a connection that sent nothing."""
    client.setblocking(False)
    try:
        return client.recv(1) == b""
    except BlockingIOError:
        return False
    except ConnectionError:
        return True


def until(done: Callable[[], bool], seconds: float = 20.0) -> None:
    end = time.monotonic() + seconds
    while not done():
        assert time.monotonic() < end, "it never came to be"
        time.sleep(0.05)


def test_idle_connections_hold_few_threads_and_keep_nobody_out(tmp_path):
    film = b"0123456789" * 100_000
    page = a_film_to_annotate(tmp_path, film)
    before = threading.active_count()
    body = {"labels": labels([(1.0, 2.0)]), "base": "", "client": "a"}
    try:
        with idle(page.server_port, 200) as clients:
            until(lambda: sum(closed(client) for client in clients) >= 200 - MAX_CONNECTIONS)
            assert threading.active_count() <= before + MAX_CONNECTIONS
            assert status(page, with_token(page)) == 200
            code, headers, data = ask(page, "GET", "/recordings/0/video", Range="bytes=500000-500009")
            assert (code, data) == (206, film[500_000:500_010])
            assert headers["Content-Range"] == f"bytes 500000-500009/{len(film)}"
            assert ask(page, "POST", "/recordings/0/labels", body)[0] == 200
            assert threading.active_count() <= before + MAX_CONNECTIONS
        assert (tmp_path / "r0.contacts.json").is_file()
        until(lambda: threading.active_count() <= before)
    finally:
        page.stop()


def test_a_video_on_its_way_is_not_closed_for_idle_connections(tmp_path):
    film = bytes(20_000_000)
    page = a_film_to_annotate(tmp_path, film)
    connection = http.client.HTTPConnection("127.0.0.1", page.server_port, timeout=20)
    try:
        connection.request("GET", f"/recordings/0/video?token={page.guard.token}")
        reply = connection.getresponse()
        with idle(page.server_port, 100) as clients:
            until(lambda: sum(closed(client) for client in clients) >= 100 - MAX_CONNECTIONS)
            assert reply.read() == film
    finally:
        connection.close()
        page.stop()


def test_idle_connections_are_closed(tmp_path, monkeypatch):
    monkeypatch.setattr(annotate_server._Handler, "timeout", 1.0)
    page = an_annotator(tmp_path)
    connection = http.client.HTTPConnection("127.0.0.1", page.server_port, timeout=20)
    try:
        with idle(page.server_port, 1) as clients:
            assert clients[0].recv(1) == b""
        connection.request("GET", with_token(page))
        connection.getresponse().read()
        assert connection.sock is not None
        assert connection.sock.recv(1) == b"", "one that was kept alive is closed too"
    finally:
        connection.close()
        page.stop()


def test_too_many_connections_at_work_are_answered_so(tmp_path, monkeypatch):
    monkeypatch.setattr(annotate_server, "MAX_CONNECTIONS", 2)
    page = an_annotator(tmp_path)
    going, done = threading.Barrier(3), threading.Event()
    monkeypatch.setattr(
        annotate_server._Handler, "get", lambda self, path: (going.wait(20), done.wait(20), self._send_json([]))
    )
    target = f"/recordings?token={page.guard.token}"
    threads = [threading.Thread(target=status, args=(page, target)) for _ in range(2)]
    try:
        for thread in threads:
            thread.start()
        going.wait(20)
        assert status(page, target) == 503
    finally:
        done.set()
        for thread in threads:
            thread.join(20)
        page.stop()


@pytest.mark.browser
@pytest.mark.slow
@pytest.mark.parametrize(
    ("opened", "word"), [(a_view, "Surroundings"), (an_editor, "Cut out"), (an_annotator, "frame")]
)
def test_chromium_opens_the_address_with_the_token_alone(opened, word, tmp_path):
    page = opened(tmp_path)
    bare = page.url.partition("?")[0]
    try:
        with chromium(tmp_path / "profile", bare, webgl=opened is not an_annotator) as browser:
            browser.poll(lambda: "token" in browser.text())
            assert word not in browser.text()
            browser.go(page.url)
            browser.poll(lambda: word in browser.text())
            assert browser.evaluate("document.cookie") == "", "no script reads it"
            browser.go("about:blank")
            browser.go(bare)  # the cookie is enough
            browser.poll(lambda: word in browser.text())
            assert not browser.exceptions
    finally:
        page.stop()


@pytest.mark.parametrize("opened", [a_view, an_editor, an_annotator])
def test_silent_connections_keep_no_page_from_the_user(opened, tmp_path, monkeypatch):
    monkeypatch.setattr(CONNECTIONS, "most", 16)
    page = opened(tmp_path)
    try:
        with silent(port_of(page), 150):
            answered = 0
            for _ in range(20):
                with contextlib.suppress(OSError, IndexError):  # its place went to another before it had spoken
                    answered += status(page, f"/?token={page.guard.token}") == 200
            assert answered >= 15
    finally:
        page.stop()
