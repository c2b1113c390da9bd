"""The site is built of the pages, without a warning and without the network."""

import importlib.util
import inspect
import re
import subprocess
import sys
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from types import ModuleType
from urllib.parse import urlsplit

import pytest

import wearcap
from wearcap_browser import chromium

ROOT = Path(__file__).parents[1]
REPOSITORY = "https://github.com/wearcap/wearcap"


class Quiet(SimpleHTTPRequestHandler):
    """Serves a folder, and says nothing."""

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture(scope="module")
def hooks() -> ModuleType:
    for module in ("mkdocs", "material", "mkdocstrings", "nbconvert"):
        pytest.importorskip(module, reason="the site needs: pip install -e '.[site]'")
    spec = importlib.util.spec_from_file_location("website_hooks", ROOT / "website" / "hooks.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def built(hooks, tmp_path_factory) -> Path:
    """Folder of the site, built without a warning."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr[-4000:]
    return folder


@pytest.fixture(scope="module")
def site(built) -> dict[str, str]:
    """The site's files of text, by path."""
    texts = (path for path in built.rglob("*") if path.suffix in (".html", ".css"))
    return {path.relative_to(built).as_posix(): path.read_text(encoding="utf-8") for path in texts}


def test_every_page_is_there(site):
    for page in (ROOT / "docs").rglob("*.md"):
        assert f"{page.relative_to(ROOT / 'docs').with_suffix('').as_posix()}/index.html" in site
    for notebook in (ROOT / "examples" / "notebooks").glob("*.ipynb"):
        assert f"notebooks/{notebook.stem}/index.html" in site
    assert "Nothing to register" in site["index.html"]


def test_nothing_is_loaded_from_elsewhere(site):
    for path, text in site.items():
        loaded = re.findall(r'<(?:script|img|source|video|iframe)[^>]* src="([^"]*)"', text)
        loaded += re.findall(r'<link[^>]* rel="(?:stylesheet|preconnect|preload)"[^>]* href="([^"]*)"', text)
        loaded += re.findall(r'<link[^>]* href="([^"]*)"[^>]* rel="(?:stylesheet|preconnect|preload)"', text)
        loaded += re.findall(r"url\(([^)]*)\)", text) if path.endswith(".css") else []
        assert not [address for address in loaded if re.match(r"[\"']?(https?:)?//", address)], path
        assert 'data-md-component="source"' not in text, "it would ask GitHub for stars"


def test_links_that_leave_the_pages_go_to_the_repository(site):
    home = site["index.html"]
    assert f'href="{REPOSITORY}/tree/main/checkpoints"' in home
    assert f'href="{REPOSITORY}/blob/main/checkpoints/hmd2_paper.md"' in home
    assert 'href="motion_files/#written-formats"' in home
    assert 'href="../../motion_files/#written-formats"' in site["notebooks/capture/index.html"]
    assert f'href="{REPOSITORY}/blob/main/src/wearcap/boundary/limits.py"' in site["reliability/index.html"]


def test_a_link_to_nothing_is_a_warning(hooks, caplog):
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files

    config = MkDocsConfig()
    config.load_dict({"repo_url": REPOSITORY})

    def mended(link: str) -> str:
        found = hooks.LINK.search(f"[words]({link})")
        return link if found is None else hooks.mended(found, "results/hmd2.md", config, Files([]))

    with caplog.at_level("WARNING"):
        assert mended("../../src/wearcap/files.py#L3") == f"{REPOSITORY}/blob/main/src/wearcap/files.py#L3"
        assert mended("https://example.org/page") == "https://example.org/page"
        assert mended("#limits") == "#limits"
        assert not caplog.records
        mended("../../src/wearcap/no_such_file.py")
        mended("../../../elsewhere.md")
    assert [record.message.split(" links ")[1].split(",")[0] for record in caplog.records] == [
        "../../src/wearcap/no_such_file.py",
        "../../../elsewhere.md",
    ]


def test_the_api_shows_what_the_package_offers(site):
    page = site["api/wearcap/index.html"]
    for name, _ in inspect.getmembers(wearcap, inspect.isfunction):
        assert f'id="wearcap.{name}"' in page, name
    motion = site["api/motion/index.html"]
    assert 'id="wearcap.recording.Motion.t_world_root"' in motion
    assert re.search(r'href="\.\./body/#wearcap\.body\.skeleton\.Skeleton"', motion)
    assert '<span class="s2">"time"</span>' in motion, "a shape of one word is text"
    assert 'id="wearcap.runtime.system.System.__call__"' in site["api/system/index.html"]
    assert re.search(r'<a [^>]*href="\.\./system/#wearcap\.runtime\.system\.System"[^>]*><code>', page)


def test_the_gallery_shows_every_picture(site):
    gallery = site["gallery/index.html"]
    for path in [*(ROOT / "docs").glob("*.png"), *(ROOT / "docs").glob("*.mp4")]:
        assert f'src="../{path.name}"' in gallery or f'src="{path.name}"' in site["index.html"], path.name
        assert path.stat().st_size <= 500_000
    assert gallery.count("<video ") == 2


@pytest.mark.browser
def test_a_browser_finds_words_and_plays_videos_from_the_site_alone(built, tmp_path):
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(built)))
    Thread(target=server.serve_forever, daemon=True).start()
    address = f"http://127.0.0.1:{server.server_port}"
    try:
        with chromium(tmp_path / "profile", f"{address}/?q=static-object", webgl=False) as browser:
            found = "[...document.querySelectorAll('.md-search-result__item a')].map(a => a.pathname).join(' ')"
            browser.poll(lambda: "/ireplica/" in browser.evaluate(found))
            browser.go(f"{address}/gallery/")
            playing = "(v => v && (v.play(), v.readyState > 2 && v.videoWidth))(document.querySelector('video'))"
            assert browser.poll(lambda: browser.evaluate(playing)) == 400
            loaded = browser.evaluate("performance.getEntriesByType('resource').map(entry => entry.name).join(' ')")
            assert {urlsplit(name).netloc for name in loaded.split()} == {urlsplit(address).netloc}
    finally:
        server.shutdown()
        server.server_close()
