"""What strangers wrote is text on every page: nothing of it runs, loads or links, and it reads as it was written."""

import contextlib
import html
import threading
import time
from collections.abc import Iterator
from html.parser import HTMLParser
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
import viser
from annotated_flat import ask, served, write_flat

import wearcap
from ports import free_port
from wearcap.apps.live.page_devices import Device
from wearcap.apps.live.page_panel import Panel
from wearcap.apps.live.status import DeviceStatus, LiveControls, LiveStatus, SinkStatus, WearerStatus
from wearcap.apps.scene_editor.editor import ObjectEditor
from wearcap.apps.viewer.page import Page
from wearcap.apps.web import page_server
from wearcap.apps.web.page_text import MAX_NAME, MAX_TEXT
from wearcap.errors import WearcapError
from wearcap.geometry.mesh import Mesh
from wearcap.io.formats.environment import FILE_NAME, write_environment
from wearcap.recording import PointCloud, Recording
from wearcap.scene.objects import Environment, Freedom, SceneObject
from wearcap.scene.scan import Scan
from wearcap_browser import chromium

HOSTILE = {
    "frame": "<iframe srcdoc=\"<script>parent.document.title='broken'</script>\"></iframe>",
    "script": "</div><script>document.title='broken'</script>",
    "image": "<img src=x onerror=\"document.title='broken'\">",
    "style": "<style>*{display:none}</style><svg onload=alert(1)>",
    "link": "[look](javascript:alert(1)) <https://elsewhere.net> www.elsewhere.net a@elsewhere.net",
    "picture": "![look](http://elsewhere.net/x.png) ![](/etc/passwd)",
    "entities": "&lt;b&gt; &#60;b&#62; &amp;amp; &nbsp",
    "template": "${alert(1)} {{1+1}} {alert(1)}",
    "markdown": "# `code` **bold** _it_ ~~out~~ | a | \\* > quote ```js",
    "long": "<b>" * 100_000,
    "controls": "a\x00\x1b[31m\u202eb\ud800\nc",
}


OURS = {"div", "b", "i", "br", "table", "tr", "td", "details", "summary", "ul", "li"}
"""Elements that the pages make."""


class Shown(HTMLParser):
    """What a browser makes of HTML: its elements with their attributes, and its text."""

    def __init__(self, content: str):
        super().__init__()
        self.elements: list[tuple[str, frozenset[str]]] = []
        self.text = ""
        self.feed(content)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, frozenset(name for name, _ in attrs)))

    def handle_data(self, data: str) -> None:
        self.text += data


def shown_of(gui: viser.GuiApi) -> list[Shown]:
    """All blocks of a page that viser renders; none is markdown, in which HTML would run too."""
    handles = [one for holder in gui._container_handle_from_uuid.values() for one in holder._children.values()]
    assert not [one for one in handles if isinstance(one, viser.GuiMarkdownHandle)]
    return [Shown(one.content) for one in handles if isinstance(one, viser.GuiHtmlHandle)]


def check_blocks(gui: viser.GuiApi, hostile: str, most: int = MAX_TEXT) -> None:
    """Only our own elements, without anything that runs or loads, and the text as it was written."""
    blocks = shown_of(gui)
    assert {tag for block in blocks for tag, _ in block.elements} <= OURS
    assert {name for block in blocks for _, names in block.elements for name in names} <= {"style", "colspan"}
    check_text("".join(block.text for block in blocks), hostile, most)


def check_text(text: str, hostile: str, most: int) -> None:
    written = "".join(one for one in hostile.replace("\n", " ") if one.isprintable())
    assert (written if len(written) <= most else written[: most - 1] + "…") in text
    text.encode()


def view(hostile: str, folder: Path, **fields: str) -> Page:
    about = {"name": "cloud", "activity": "walking"} | fields
    recording = Recording(points=PointCloud(torch.rand(50, 3)), subject=hostile, location=hostile, **about)
    return Page(recording, port=free_port())


class Controls(LiveControls):
    """Of a capture that nobody steers."""

    def status(self) -> LiveStatus:
        return LiveStatus()


def crate(name: str, category: str = "box") -> SceneObject:
    points = np.random.default_rng(0).uniform([0.8, 0.8, 0.05], [1.2, 1.2, 0.5], (300, 3)).astype(np.float32)
    mesh = Mesh(points, np.zeros((0, 3), np.int32), np.full(3, 0.5, np.float32))
    return SceneObject(name, category, mesh, torch.eye(3), torch.zeros(3), Freedom("free"))


@pytest.fixture(params=HOSTILE)
def hostile(request) -> str:
    return HOSTILE[request.param]


@pytest.mark.parametrize("field", ["name", "activity", "source"])
def test_a_recordings_texts_are_text(hostile, field, tmp_path):
    page = view(hostile, tmp_path, **({"activity": ""} | {field: hostile}))
    try:
        check_blocks(page.server.gui, hostile)
    finally:
        page.stop()


def test_a_scenes_texts_are_text(hostile, tmp_path):
    hostile = hostile.replace("\ud800", "")  # no file that the editor reads has it
    write_environment(Environment((crate(hostile, hostile),)), tmp_path / FILE_NAME)
    floor = np.random.default_rng(0).uniform([0, 0, 0], [2, 2, 0.01], (3000, 3)).astype(np.float32)
    page = ObjectEditor(Scan(floor), tmp_path / FILE_NAME, hostile, port=free_port())
    try:
        check_blocks(page.server.gui, hostile)
        page._problem, page._saved = f"not saved: {hostile}", object()
        page._show_status()
        check_blocks(page.server.gui, page._problem)
        nodes = page.server.scene._handle_from_node_name
        (label,) = [one for name, one in nodes.items() if name.startswith("/objects/") and name.endswith("/name")]
        check_text(cast(Any, label).text, hostile, MAX_NAME)
    finally:
        page.stop()


def test_texts_from_the_network_are_text(hostile):
    server = viser.ViserServer(port=free_port(), verbose=False)
    try:
        panel = Panel(server, Controls())
        device = DeviceStatus(hostile, 50.0)
        wearer = WearerStatus(hostile, "live", devices=(device,), notes=(hostile,), step=hostile)
        sink = SinkStatus(hostile, last_error=hostile, failed=1)
        panel.update(LiveStatus((wearer,), (sink,), f"/tmp/{hostile.replace('/', '')}", 1.0), lambda _: (0, 0, 0), {})
        check_blocks(server.gui, hostile)
        (folder,) = panel.wearers.values()
        check_text(folder.folder.label, hostile, MAX_NAME)
        check_text(Device(server, "/0", device).label.text, hostile.replace("_", " "), MAX_NAME)
    finally:
        server.stop()


def test_no_page_uses_markdown():
    """It renders HTML, and makes links of addresses however they are escaped."""
    source = Path(wearcap.__file__).parent
    assert not [file for file in source.rglob("*.py") if "add_markdown" in file.read_text(encoding="utf-8")]


def test_an_object_replaces_no_other_node(tmp_path):
    objects = [crate(name) for name in ("points", "a", "a/b", "..", "<i>")]
    page = Page(
        Recording("room", points=PointCloud(torch.rand(50, 3))),
        environment=Environment(tuple(objects)),
        port=free_port(),
    )
    try:
        nodes = page.server.scene._handle_from_node_name
        assert isinstance(nodes["/surroundings/points"], viser.PointCloudHandle)
        below = [name for name in nodes if name.startswith("/surroundings/objects/")]
        assert len(below) == len(objects)
        assert {name.count("/") for name in below} == {3}
    finally:
        page.stop()


# --- what a browser may do with a page ------------------------------------------------------------------------------


def test_only_the_pages_own_script_may_run(tmp_path):
    page = view("", tmp_path)
    try:
        seen = set()
        for headers in ({"Accept_Encoding": "gzip"}, {}):
            server = cast(Any, SimpleNamespace(server_port=page.server.get_port(), guard=page.guard))
            status, given, body = ask(server, "GET", "/", **headers)
            (policy,) = given.get_all("Content-Security-Policy") or []
            rules = {name: set(rest) for name, *rest in (rule.split() for rule in policy.split(";"))}
            (nonce,) = rules["script-src"] - {"'unsafe-eval'"}
            seen.add(nonce)
            value = nonce.removeprefix("'nonce-").removesuffix("'")
            assert status == 200
            assert body.count(value.encode()) == 2
            assert given["Content-Length"] == str(len(body))
            assert rules["default-src"] == rules["base-uri"] == rules["form-action"] == {"'none'"}
            assert not {"frame-src", "object-src"} & rules.keys(), "default-src is what holds for them"
            assert not {"*", "http:", "https:", "ws:"} & set().union(*rules.values())
        assert len(seen) == 2, "each answer has its own"
    finally:
        page.stop()


def test_every_answer_of_the_annotator_has_its_policy(tmp_path):
    (tmp_path / "flat").mkdir()
    dataset = write_flat(tmp_path / "flat")
    with served(dataset, tmp_path / "labels") as server:
        for path, status in (
            ("/", 200),
            ("/recordings", 200),
            ("/recordings/0/video", 200),
            ("/icon.svg", 200),
            ("/no", 404),
        ):
            found, given, _ = ask(server, "GET", path)
            (policy,) = given.get_all("Content-Security-Policy") or []
            assert (found, given.get_all("X-Content-Type-Options")) == (status, ["nosniff"])
            assert policy.startswith("default-src 'self'; frame-src 'none'; object-src 'none'")


def test_a_viser_with_another_page_is_not_served(monkeypatch, tmp_path):
    other = tmp_path / "index.html"
    other.write_text("<!doctype html><script>start()</script>")
    for page in (other, tmp_path / "none.html"):
        monkeypatch.setattr(page_server, "_PAGE", page)
        with pytest.raises(WearcapError, match=r"viser.*guarded.*Install the version"):
            view("", tmp_path)


@contextlib.contextmanager
def called() -> Iterator[tuple[str, list[str]]]:
    """A server elsewhere, and what was sent to it."""
    calls: list[str] = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            calls.append(self.path)
            self.send_response(200)
            self.send_header("Access-Control-Allow-Origin", "*")
            self.end_headers()

        def log_message(self, format: str, *args: Any) -> None:
            """Nothing is printed."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}", calls
    finally:
        server.shutdown()
        server.server_close()


def attack(url: str) -> str:
    script = f"parent.document.title = 'broken'; fetch('{url}/script')"
    return (
        f'<iframe srcdoc="<script>{html.escape(script)}</script>"></iframe><img src="{url}/image" onerror="{script}">'
    )


@pytest.mark.browser
@pytest.mark.slow
def test_a_page_shows_a_strangers_script_and_does_not_run_it(tmp_path):
    with called() as (url, calls):
        page = view("", tmp_path, name="<b>cloud</b>", activity=attack(url))
        try:
            with chromium(tmp_path / "profile", "about:blank") as browser:
                browser.call("Page.enable")
                watch = "window.kept = []; addEventListener('securitypolicyviolation', e => kept.push(e.effectiveDirective))"
                browser.call("Page.addScriptToEvaluateOnNewDocument", source=watch)
                browser.go(page.url)
                browser.poll(lambda: "Surroundings" in browser.text())  # from Python, over its WebSocket
                assert browser.evaluate("document.querySelectorAll('canvas').length")
                assert "<b>cloud</b>" in browser.text()
                assert attack(url) in browser.text()
                browser.screenshot(tmp_path / "attack.png")
                assert browser.evaluate("[kept, document.querySelectorAll('iframe, img[onerror]').length]") == [[], 0]
                assert not browser.exceptions
                # Were a text forgotten, the browser would not run it.
                page.server.gui.add_html(attack(url))
                browser.poll(lambda: browser.evaluate("document.querySelectorAll('iframe').length"))
                kept = browser.poll(lambda: browser.evaluate("kept.length >= 2 && kept"))
                assert {"img-src", "script-src-attr"} <= set(kept)
                time.sleep(1.0)
                assert browser.evaluate("document.title") == "Viser"
                assert calls == []
        finally:
            page.stop()
