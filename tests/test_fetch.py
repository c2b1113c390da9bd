"""Files from the network, by a server on this machine: resumed, verified, from another mirror, or from a folder."""

import base64
import hashlib
import subprocess
import sys
import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from ports import free_port
from wearcap.errors import WearcapError
from wearcap.fetch import Remote, fetch

DATA = bytes(range(256)) * 4096
SHA256 = f"sha256:{hashlib.sha256(DATA).hexdigest()}"


class Mirror(ThreadingHTTPServer):
    """A server that sends `data` under any path, breaks off after `breaks` bytes of each answer, and notes what was wanted."""

    daemon_threads = True

    def __init__(self, data: bytes = DATA, breaks: int = 1 << 30, ranges: bool = True, moved: str = ""):
        super().__init__(("127.0.0.1", 0), Answer)
        self.data, self.breaks, self.ranges, self.moved, self.wanted = data, breaks, ranges, moved, []

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}/file.bin"


class Answer(BaseHTTPRequestHandler):
    server: Mirror

    def do_GET(self):
        mirror, wanted = self.server, self.headers.get("Range", "")
        mirror.wanted.append(wanted)
        if mirror.moved:
            self.send_response(302)
            self.send_header("Location", mirror.moved)
            self.end_headers()
            return
        start = int(wanted[6:-1]) if wanted and mirror.ranges else 0
        if start and start >= len(mirror.data):
            self.send_error(416)
            return
        self.send_response(206 if wanted and mirror.ranges else 200)
        if wanted and mirror.ranges:
            self.send_header("Content-Range", f"bytes {start}-{len(mirror.data) - 1}/{len(mirror.data)}")
        self.send_header("Content-Length", str(len(mirror.data) - start))
        self.end_headers()
        self.wfile.write(mirror.data[start : start + mirror.breaks])

    def log_message(self, format, *arguments):
        pass


@contextmanager
def serving(*mirrors: Mirror):
    for mirror in mirrors:
        threading.Thread(target=mirror.serve_forever, args=(0.02,), daemon=True).start()
    try:
        yield tuple(mirror.url for mirror in mirrors)
    finally:
        for mirror in mirrors:
            mirror.shutdown()
            mirror.server_close()


@pytest.fixture(autouse=True)
def quiet(monkeypatch):
    monkeypatch.delenv("WEARCAP_WEIGHTS", raising=False)
    monkeypatch.setenv("no_proxy", "*")


@pytest.mark.parametrize(
    "digest", [SHA256, "sha512-" + base64.b64encode(hashlib.sha512(DATA).digest()).decode()], ids=["sha256", "npm"]
)
def test_a_file_is_fetched_once_and_again_when_it_is_damaged(tmp_path, digest):
    mirror = Mirror()
    with serving(mirror) as urls:
        remote = Remote("file.bin", urls, digest, len(DATA))
        path = fetch(remote, tmp_path)
        assert path.read_bytes() == DATA
        assert fetch(remote, tmp_path) == path
        assert len(mirror.wanted) == 1
        path.write_bytes(DATA[:-1] + b"?")
        assert fetch(remote, tmp_path).read_bytes() == DATA
    assert len(mirror.wanted) == 2


def test_without_a_folder_it_goes_into_the_users_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("WEARCAP_CACHE", str(tmp_path / "cache"))
    with serving(Mirror()) as urls:
        assert fetch(Remote("file.bin", urls, SHA256, len(DATA))).is_relative_to(tmp_path / "cache")


def test_a_download_that_breaks_off_goes_on_where_it_broke_off(tmp_path):
    mirror = Mirror(breaks=300_000)
    with serving(mirror) as urls:
        assert fetch(Remote("file.bin", urls, SHA256, len(DATA)), tmp_path).read_bytes() == DATA
    assert mirror.wanted == ["", "bytes=300000-", "bytes=600000-", "bytes=900000-"]


def test_a_later_run_goes_on_with_what_a_killed_one_left(tmp_path):
    mirror = Mirror(breaks=100_000)
    with serving(mirror) as urls:
        remote = Remote("file.bin", urls, SHA256, len(DATA))
        with pytest.raises(WearcapError, match="broke off after 500000 of 1048576 bytes"):
            fetch(remote, tmp_path)
        mirror.breaks = 1 << 30
        mirror.wanted.clear()
        assert fetch(remote, tmp_path).read_bytes() == DATA
    assert mirror.wanted == ["bytes=500000-"]
    assert not list(tmp_path.rglob("*.part"))


@pytest.mark.parametrize("ranges", [True, False])
@pytest.mark.parametrize("left", [b"x" * 1000, DATA + b"x", DATA])
def test_what_lay_there_before_does_no_harm(tmp_path, ranges, left):
    with serving(Mirror(ranges=ranges)) as urls:
        remote = Remote("file.bin", urls, SHA256, len(DATA))
        path = fetch(remote, tmp_path)
        path.unlink()
        path.with_name("file.bin.part").write_bytes(left)
        assert fetch(remote, tmp_path).read_bytes() == DATA


def test_another_content_is_refused_and_not_kept(tmp_path):
    with serving(Mirror(DATA[::-1])) as urls, pytest.raises(WearcapError, match="another file than sha256:") as error:
        fetch(Remote("file.bin", urls, SHA256, len(DATA)), tmp_path)
    assert f"download {urls[0]} into a folder DIR and set WEARCAP_WEIGHTS=DIR" in str(error.value)
    assert "\n" not in str(error.value)
    assert not list(tmp_path.rglob("file.bin*[!k]"))


def test_the_next_mirror_is_tried(tmp_path):
    dead = f"http://127.0.0.1:{free_port()}/file.bin"
    wrong, good = Mirror(DATA[::-1]), Mirror()
    with serving(wrong, good) as urls:
        assert fetch(Remote("file.bin", (dead, *urls), SHA256, len(DATA)), tmp_path).read_bytes() == DATA
    assert len(wrong.wanted) == len(good.wanted) == 1


def test_no_network_says_what_to_do(tmp_path):
    url = f"http://127.0.0.1:{free_port()}/file.bin"
    with pytest.raises(WearcapError, match=r"file\.bin cannot be fetched \(127\.0\.0\.1:.*Run again with a network"):
        fetch(Remote("file.bin", (url,), SHA256, len(DATA)), tmp_path)


def test_too_long_an_answer_is_not_kept(tmp_path):
    with serving(Mirror()) as urls, pytest.raises(WearcapError, match="more than the 1000 bytes"):
        fetch(Remote("file.bin", urls, SHA256, 1000), tmp_path)
    assert not any(path.stat().st_size for path in tmp_path.rglob("file.bin*"))


def test_only_safe_addresses_are_opened(tmp_path):
    with pytest.raises(WearcapError, match="is no https address"):
        fetch(Remote("file.bin", ("http://example.org/file.bin",), SHA256, len(DATA)), tmp_path)
    with (
        serving(Mirror(moved="http://example.org/file.bin")) as urls,
        pytest.raises(WearcapError, match="example.org/file.bin is no https address"),
    ):
        fetch(Remote("file.bin", urls, SHA256, len(DATA)), tmp_path)


def test_a_redirect_is_followed(tmp_path):
    with serving(good := Mirror()), serving(Mirror(moved=good.url)) as urls:
        assert fetch(Remote("file.bin", urls, SHA256, len(DATA)), tmp_path).read_bytes() == DATA


def test_a_folder_of_weights_needs_no_network(tmp_path, monkeypatch):
    monkeypatch.setenv("WEARCAP_WEIGHTS", str(tmp_path / "weights"))
    (tmp_path / "weights").mkdir()
    with serving(mirror := Mirror()) as urls:
        remote = Remote("file.bin", urls, SHA256, len(DATA))
        with pytest.raises(WearcapError, match=rf"no file\.bin in WEARCAP_WEIGHTS. Download {urls[0]} into it"):
            fetch(remote, tmp_path)
        (tmp_path / "weights/file.bin").write_bytes(b"?")
        with pytest.raises(WearcapError, match="another file than sha256:"):
            fetch(remote, tmp_path)
        (tmp_path / "weights/file.bin").write_bytes(DATA)
        assert fetch(remote, tmp_path) == tmp_path / "weights/file.bin"
    assert not mirror.wanted


def test_two_processes_fetch_once(tmp_path):
    script = (
        "import sys; from pathlib import Path; from wearcap.fetch import Remote, fetch;"
        f"print(fetch(Remote('file.bin', (sys.argv[1],), {SHA256!r}, {len(DATA)}), Path(sys.argv[2])))"
    )
    with serving(mirror := Mirror()) as (url,):
        command = [sys.executable, "-c", script, url, str(tmp_path)]
        both = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
        printed = {process.communicate(timeout=120)[0] for process in both}
    assert len(printed) == 1
    assert all(process.returncode == 0 for process in both)
    assert len(mirror.wanted) == 1


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").touch()
    with serving(Mirror()) as urls, pytest.raises(WearcapError, match="cannot be written"):
        fetch(Remote("file.bin", urls, SHA256, len(DATA)), tmp_path / "file")
