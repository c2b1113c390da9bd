"""The annotator: its server and files, and a real browser in which hands are clicked while a video plays."""

import http.client
import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
import torch

from wearcap.body.skeleton import Skeleton, xsens23
from wearcap.cli.annotate import main as annotate
from wearcap.errors import WearcapError
from wearcap.geometry.camera import Camera
from wearcap.geometry.mesh import Mesh
from wearcap.io.contact_labels import Label, LabelClock, annotation_of, read_contact_labels
from wearcap.io.environment import write_environment
from wearcap.io.motion_npz import write_motion
from wearcap.recording import CameraStream, Motion, Recording, RecordingStore
from wearcap.recording.interactions import Interactions
from wearcap.scene.environment import Environment
from wearcap.scene.objects import Freedom, SceneObject
from wearcap.viewer.annotate import Desk, take_of
from wearcap.viewer.annotate_server import AnnotationServer, byte_range
from wearcap.viewer.annotation_file import AnnotationFile, Conflict
from wearcap.viewer.annotation_start import starting_labels
from wearcap_browser import SHIFT, Chromium, chromium
from wearcap_testing import recording_of, swaying_motion

FRAMES, FPS = 600, 60.0
TIMES = torch.arange(FRAMES, dtype=torch.float64) / FPS
CLOCK = LabelClock.of("r0", TIMES)


def held(start: list[float], stop: list[float], hands: list[list[bool]], thing: str = "") -> Interactions:
    kind = "sliding" if thing else ""
    return Interactions(torch.tensor(start).double(), torch.tensor(stop).double(),
                        torch.tensor(hands, dtype=torch.bool).reshape(-1, 2), (thing,) * len(start), (kind,) * len(start))  # fmt: skip


def a_film(path: Path, seconds: float = 10.0, fps: int = 30) -> Path:
    """A video whose brightness is its time."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264" if "libx264" in av.codecs_available else "mpeg4", rate=fps)
        stream.width, stream.height, stream.pix_fmt = 160, 120, "yuv420p"
        for number in range(round(seconds * fps)):
            picture = np.full((120, 160, 3), 40 + int(180 * number / (seconds * fps)), np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode(None))
    return path


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    """Recordings r0 (with a camera's video) and r1 (without), and what is known of r0's objects."""
    root = tmp_path_factory.mktemp("flat")
    store = RecordingStore(root)
    a_film(root / "r0.mp4")
    stamps = torch.arange(300, dtype=torch.float64) / 30
    camera = CameraStream(stamps, Camera("pinhole", 160, 120, 100.0, 100.0, 79.5, 59.5), torch.eye(3), torch.zeros(3),
                          video="r0.mp4")  # fmt: skip
    for number in range(2):
        recording = recording_of(swaying_motion(FRAMES, number, FPS), f"r{number}")
        if number == 0:
            sofa = held([2.0], [4.0], [[True, True]], "sofa")
            recording = replace(recording, camera=camera, interactions=sofa)
        store.add(recording, split="test", config_hash="x")
    return root


@contextmanager
def served(dataset: Path, output: Path, where: str = "", **options) -> Iterator[AnnotationServer]:
    server = AnnotationServer(Desk.of(dataset / where, output, **options), port=18300)
    try:
        yield server
    finally:
        server.stop()


def ask(server: AnnotationServer, method: str, path: str, body: object = None, **headers: str):
    """Status, headers and body of a request."""
    connection = http.client.HTTPConnection("127.0.0.1", int(server.url.rsplit(":", 1)[1]), timeout=20)
    text = None if body is None else body if isinstance(body, str) else json.dumps(body)
    given = ({"Content-Type": "application/json"} if text is not None else {}) | {
        key.replace("_", "-"): value for key, value in headers.items()
    }
    connection.request(method, path, text, given)
    reply = connection.getresponse()
    data = reply.read()
    connection.close()
    return reply.status, reply.headers, data


def labels(left=(), right=(), clock: LabelClock = CLOCK) -> dict:
    return annotation_of(
        {"left": tuple(Label(*s) for s in left), "right": tuple(Label(*s) for s in right)}, clock
    )


def test_the_page_gets_its_files_and_a_recordings_numbers(dataset, tmp_path):
    motion = swaying_motion(FRAMES, 0, FPS)
    with served(dataset, tmp_path) as server:
        for name in ("", "annotator.js", "annotator.css", "labels.js", "player.js", "saver.js", "skeleton.js", "take.js", "timeline.js"):  # fmt: skip
            status, headers, data = ask(server, "GET", f"/{name}")
            assert status == 200
            assert b"http:" not in data.replace(b"http://www.w3.org/2000/svg", b""), "nothing from elsewhere"
            assert headers["Content-Type"].split(";")[0] in ("text/html", "text/javascript", "text/css")
        assert json.loads(ask(server, "GET", "/recordings")[2]) == [
            {"name": "r0", "annotated": False}, {"name": "r1", "annotated": False},
        ]  # fmt: skip
        header = json.loads(ask(server, "GET", "/recordings/0")[2])
        assert (header["frames"], header["start_s"], header["stop_s"]) == (600, 0.0, pytest.approx(10.0))
        assert header["objects"] == {"sofa": "sliding"}
        numbers = ask(server, "GET", "/recordings/0/numbers")[2]
        times = np.frombuffer(numbers, "<f8", 600)
        points = np.frombuffer(numbers, "<f4", offset=600 * 12).reshape(600, len(header["points"]), 3)
        np.testing.assert_array_equal(times, TIMES)
        wrist = points[:, header["points"].index("left_wrist")]
        np.testing.assert_allclose(wrist, motion.joint("left_wrist").t, atol=1e-6)
        assert header["points"][header["hands"]["left"]] == "left_palm"
        for path in (
            "/nothing",
            "/..%2fannotate.py",
            "/../annotate.py",
            "/recordings/7",
            "/recordings/1/video",
        ):
            assert ask(server, "GET", path)[0] == 404


def test_video_in_ranges(dataset, tmp_path):
    film = (dataset / "r0.mp4").read_bytes()
    with served(dataset, tmp_path, "r0") as server:
        status, headers, data = ask(server, "GET", "/recordings/0/video", Range="bytes=100-299")
        assert (status, data) == (206, film[100:300])
        assert headers["Content-Range"] == f"bytes 100-299/{len(film)}"
        assert ask(server, "GET", "/recordings/0/video")[2] == film
        assert ask(server, "GET", "/recordings/0/video", Range="bytes=-10")[2] == film[-10:]
        assert ask(server, "GET", "/recordings/0/video", Range=f"bytes={len(film)}-")[0] == 416
        status, headers, data = ask(server, "HEAD", "/recordings/0/video")
        assert (status, headers["Content-Length"], data) == (200, str(len(film)), b"")
    for header, wanted in (("bytes=5-", (5, 9, True)), ("bytes=2-99", (2, 9, True)), ("bytes=-99", (0, 9, True)), ("bytes=9-", None),
                           ("", (0, 9, False)), ("lines=1-2", (0, 9, False)), ("bytes=4-2", (0, 9, False)), ("bytes=-", (0, 9, False))):  # fmt: skip
        assert byte_range(header, 9) == wanted


def test_a_save_is_checked_written_and_given_back(dataset, tmp_path):
    with served(dataset, tmp_path) as server:
        status, _, data = ask(server, "POST", "/recordings/0/labels", {"labels": labels([(1.0, 2.0)]), "base": "", "client": "a"})  # fmt: skip
        assert status == 200
        header = json.loads(ask(server, "GET", "/recordings/0")[2])
        assert header["labels"]["contacts"] == {"left_hand": [[1.0, 2.0]], "right_hand": []}
        assert header["revision"] == json.loads(data)["revision"]
        _, headers, data = ask(server, "GET", "/recordings/0/export")
        assert json.loads(data) == {"contacts": {"left_hand": [[1.0, 2.0]], "right_hand": []}}
        assert 'filename="r0.json"' in headers["Content-Disposition"]
        assert json.loads(ask(server, "GET", "/recordings")[2])[0]["annotated"]
    assert read_contact_labels(tmp_path / "r0.contacts.json", CLOCK).start_s.tolist() == [1.0]


def test_saves_that_must_not_be(dataset, tmp_path):
    good = {"labels": labels([(1.0, 2.0)]), "base": "", "client": "a"}
    with served(dataset, tmp_path) as server:
        overlap = {"contacts": {"left_hand": [[1, 3], [2, 4]], "right_hand": []}}
        for body, status, message in (
            (good | {"labels": overlap}, 422, "overlap"), (good | {"labels": labels(clock=replace(CLOCK, name="r7"))}, 422, "'r7'"),
            ("{", 400, "not a save"), ({"labels": {}}, 400, "not a save"), ([], 400, "not a save"), (good | {"labels": 3}, 422, "no contact labels"),
        ):  # fmt: skip
            told, _, data = ask(server, "POST", "/recordings/0/labels", body)
            assert told == status
            assert message in json.loads(data)["error"]
        assert ask(server, "POST", "/recordings/9/labels", good)[0] == 404
        assert ask(server, "POST", "/recordings/0/labels", good, Origin="http://elsewhere.net")[0] == 403
        assert ask(server, "POST", "/recordings/0/labels", good, Content_Type="text/plain")[0] == 403
        assert ask(server, "GET", "/recordings", Host="elsewhere.net:18300")[0] == 403
        assert ask(server, "POST", "/recordings/0/labels", "", Content_Length="99999999999")[0] == 413
    assert not list(tmp_path.iterdir())


def test_nothing_is_lost_when_two_write(tmp_path):
    file = AnnotationFile(tmp_path, CLOCK)
    first = file.save(labels([(1.0, 2.0)]), "", client="a")
    second = file.save(labels([(1.0, 3.0)]), "", client="a")  # its own reply was lost: no conflict
    assert (
        file.save(labels([(1.0, 3.0)]), first, client="b") == second
    )  # the same labels: nothing to fight about
    with pytest.raises(Conflict, match="another window"):
        file.save(labels([(5.0, 6.0)]), first, client="b")
    assert file.read()[0]["left"] == (Label(1.0, 3.0),)
    later = AnnotationFile(tmp_path, CLOCK)
    kept = file.path.read_text()
    later.save(labels([(5.0, 6.0)]), "", force=True)
    assert [path.read_text() for path in (tmp_path / "backups").iterdir()] == [kept]
    later.save(labels(), later.read()[1])
    assert len(list((tmp_path / "backups").iterdir())) == 1, "a session's own states need no backup"


def test_files_that_are_not_this_recordings_are_left_alone(dataset, tmp_path):
    path = tmp_path / "r0.contacts.json"
    other = labels([(1.0, 2.0)], clock=replace(CLOCK, frames=700))
    for text, message in ((json.dumps(other), "700 frames"), ('{"contacts": {"left', "JSON")):
        path.write_text(text)
        with pytest.raises(WearcapError, match=message):
            annotate([str(dataset / "r0"), "--output", str(tmp_path), "--no-browser"])
        with served(dataset, tmp_path) as server:
            status, _, data = ask(server, "GET", "/recordings/0")
            assert status == 422
            assert message in json.loads(data)["error"]
            save = {"labels": labels(), "base": "", "client": "a"}
            assert ask(server, "POST", "/recordings/0/labels", save)[0] == 409
        assert path.read_text() == text


def test_export_and_import(dataset, tmp_path, capsys):
    file = AnnotationFile(tmp_path, CLOCK)
    file.save(labels([(1.0, 2.0, "sofa", "sliding"), (9.0, CLOCK.stop_s)], [(3.0, 4.0)]), "")
    annotate(["export", str(dataset), "--output", str(tmp_path), "--to", str(tmp_path / "out")])
    assert "r0.json: 2 contacts of the left hand, 1 of the right" in capsys.readouterr().out
    exported = tmp_path / "out" / "r0.json"
    assert json.loads(exported.read_text()) == {
        "contacts": {"left_hand": [[1.0, 2.0], [9.0, -1.0]], "right_hand": [[3.0, 4.0]]}
    }
    recording = RecordingStore.open(dataset).load("r0")
    back = starting_labels(exported, recording, CLOCK)
    assert back["left"] == (Label(1.0, 2.0), Label(9.0, CLOCK.stop_s))
    assert file.read()[0]["left"][0] == Label(1.0, 2.0, "sofa", "sliding")
    with pytest.raises(WearcapError, match="no labels to export"):
        annotate(["export", str(dataset / "r1"), "--output", str(tmp_path)])
    with pytest.raises(WearcapError, match="replace the labels"):
        annotate(["export", str(dataset / "r0"), "--output", str(tmp_path), "--to", str(file.path)])


def test_labels_to_start_from(dataset, tmp_path, monkeypatch):
    monkeypatch.setattr(AnnotationServer, "wait", lambda self: None)
    common = [str(dataset / "r0"), "--no-browser", "--port", "18320"]
    annotate([*common, "--output", str(tmp_path / "own"), "--from", "recording"])
    own = AnnotationFile(tmp_path / "own", CLOCK).read()[0]
    assert own["left"] == own["right"] == (Label(2.0, 4.0, "sofa", "sliding"),)
    prob = torch.zeros(FRAMES, 2)
    prob[60:120, 0], prob[130:180, 0], prob[500:, 1] = 0.9, 0.8, 0.7
    write_motion(replace(swaying_motion(FRAMES, 0, FPS), hand_contact_prob=prob), tmp_path / "motion.npz")
    annotate([*common, "--output", str(tmp_path / "network"), "--from", str(tmp_path / "motion.npz")])
    network = AnnotationFile(tmp_path / "network", CLOCK).read()[0]
    assert network == {"left": (Label(1.0, 3.0),), "right": (Label(TIMES[500].item(), CLOCK.stop_s),)}
    with pytest.raises(WearcapError, match="labels already"):
        annotate([*common, "--output", str(tmp_path / "own"), "--from", str(tmp_path / "motion.npz")])
    assert AnnotationFile(tmp_path / "own", CLOCK).read()[0] == own
    write_motion(swaying_motion(FRAMES, 0, FPS), tmp_path / "bare.npz")
    with pytest.raises(WearcapError, match="without contacts"):
        annotate([*common, "--output", str(tmp_path / "bare"), "--from", str(tmp_path / "bare.npz")])


def test_recordings_that_cannot_be_annotated(dataset, tmp_path):
    worm = Skeleton("worm", ("a", "b"), (-1, 0), torch.tensor([[0.0, 0, 0], [0, 0, 1]]))
    still = Motion(TIMES[:2], worm, torch.eye(3).expand(2, 2, 3, 3), torch.zeros(2, 3))
    for recording, message in (
        (Recording("bare"), "no motion"),
        (Recording("worm", motion=still), "left_wrist"),
    ):
        with pytest.raises(WearcapError, match=message):
            take_of(recording, tmp_path)
    for arguments, message in (
        ([str(dataset), "--video", str(dataset / "r0.mp4")], "several recordings"), ([str(dataset / "r9")], "r9"),
        ([str(dataset / "r0"), "--video", "none.mp4"], "no such video"), ([str(dataset / "r0"), "--port", "0"], "port"),
        ([str(dataset / "r0"), "--video-start", "1"], "--video FILE"),
    ):  # fmt: skip
        with pytest.raises(WearcapError, match=message):
            annotate([*arguments, "--no-browser", "--output", str(tmp_path)])
    r0 = RecordingStore.open(dataset).load("r0")
    assert "r0.mp4 is not there" in take_of(r0, tmp_path).notice
    suit = Recording("suit", suit=swaying_motion(30, skeleton=xsens23()))
    assert take_of(suit, tmp_path).clock.frames == 30


def test_objects_of_the_environment_can_be_named(tmp_path):
    triangle = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32), np.full(3, 0.5, np.float32))
    door = SceneObject(
        "door_1", "door", triangle, torch.eye(3), torch.zeros(3), Freedom("hinge", (0.0, 0.0, 0.0))
    )
    write_environment(Environment((door,)), tmp_path / "environment.json")
    recording = replace(recording_of(swaying_motion(30), "r"), environment="environment.json")
    seen = replace(recording, interactions=held([0.1], [0.2], [[True, False]], "sofa"))
    assert take_of(seen, tmp_path).objects == {"door_1": "hinged", "sofa": "sliding"}


# The page itself.


@contextmanager
def opened(
    dataset: Path, output: Path, profile: Path, where: str = "r0"
) -> Iterator[tuple[Chromium, AnnotationServer]]:
    with served(dataset, output, where) as server, chromium(profile, server.url, webgl=False) as browser:
        settled(browser)
        yield browser, server


def settled(browser: Chromium) -> None:
    """The page is open and, where there is a video, it shows its first picture."""
    browser.poll(lambda: browser.evaluate(
        "window.annotator?.ready && (annotator.player.usable || !annotator.take.header.video)"
    ))  # fmt: skip


def spans(browser: Chromium, hand: str) -> list[list[float]]:
    return browser.evaluate(f"annotator.labels.state.{hand}.map(l => [l.start, l.stop])")


def saved(browser: Chromium) -> bool:
    return browser.poll(lambda: browser.evaluate("document.getElementById('saved').className") == "saved", 20)


def film_time(browser: Chromium) -> float:
    return browser.evaluate("document.getElementById('video').currentTime")


def shown_time(browser: Chromium) -> float:
    return browser.evaluate("annotator.player.time")


def click_hand(browser: Chromium, hand: str) -> None:
    """Where the hand is once the frame that was asked for is drawn."""
    browser.poll(
        lambda: browser.evaluate("annotator.view.frame === annotator.player.frame && !annotator.view.stale")
    )
    browser.click(*browser.evaluate(f"annotator.handPosition('{hand}')"))


def on_disk(output: Path, hand: str) -> list[list[float]]:
    return json.loads((output / "r0.contacts.json").read_text())["contacts"][f"{hand}_hand"]


@pytest.mark.browser
@pytest.mark.slow
def test_contacts_are_marked_while_the_video_plays_and_are_there_after_a_reload(dataset, tmp_path):
    with opened(dataset, tmp_path, tmp_path / "profile") as (browser, _):
        browser.key(" ")
        begin = time.monotonic()
        browser.poll(lambda: shown_time(browser) > 1.0)
        assert abs(film_time(browser) - shown_time(browser)) < 0.15
        click_hand(browser, "left")
        browser.poll(lambda: shown_time(browser) > 2.0)
        assert abs(shown_time(browser) - (time.monotonic() - begin)) < 1.0, "about real time"
        browser.key(" ")
        (start, stop), = spans(browser, "left")  # fmt: skip
        assert 1.0 <= start < 2.0
        assert stop == pytest.approx(10.0), "open until it is ended"

        browser.key("ArrowRight", SHIFT)
        frame = browser.evaluate("annotator.player.frame")
        assert shown_time(browser) == pytest.approx(frame / FPS)
        browser.poll(lambda: abs(film_time(browser) - frame / FPS) < 0.01)
        click_hand(browser, "left")
        assert spans(browser, "left") == [[start, pytest.approx(frame / FPS)]]
        browser.key("l")
        browser.key("ArrowRight", SHIFT)
        browser.key("l")
        assert spans(browser, "right") == [[pytest.approx(frame / FPS), pytest.approx((frame + 60) / FPS)]]

        grip = browser.evaluate(f"annotator.lanePosition('left', {frame / FPS})")
        target = browser.evaluate("annotator.lanePosition('left', 7.0)")
        browser.drag([tuple(grip), ((grip[0] + target[0]) / 2, grip[1]), tuple(target)])
        assert spans(browser, "left")[0][1] == pytest.approx(7.0, abs=0.05)
        browser.poll(lambda: abs(film_time(browser) - spans(browser, "left")[0][1]) < 0.02)
        browser.key("z")
        assert spans(browser, "left") == [[start, pytest.approx(frame / FPS)]]
        browser.key("z", SHIFT)
        moved = spans(browser, "left")
        assert moved[0][1] == pytest.approx(7.0, abs=0.05)
        assert saved(browser)
        assert on_disk(tmp_path, "left") == moved

        browser.evaluate("window.before_reload = true")
        browser.call("Page.reload")
        browser.poll(lambda: browser.evaluate("!window.before_reload"))
        settled(browser)
        assert spans(browser, "left") == moved
        assert len(spans(browser, "right")) == 1
        assert browser.exceptions == []
    clock = LabelClock.of("r0", TIMES)
    assert read_contact_labels(tmp_path / "r0.contacts.json", clock).start_s[0].item() == start


@pytest.mark.browser
@pytest.mark.slow
def test_editing_by_keys_and_mouse(dataset, tmp_path):
    AnnotationFile(tmp_path, CLOCK).save(labels([(1.0, 2.0), (5.0, 6.0)], [(3.0, CLOCK.stop_s)]), "")
    with opened(dataset, tmp_path, tmp_path / "profile") as (browser, _):
        seen = []
        for _ in range(6):
            browser.key("]")
            seen.append(round(shown_time(browser), 3))
        assert seen[:5] == [1.0, 2.0, 3.0, 5.0, 6.0]
        browser.key("[")
        assert shown_time(browser) == pytest.approx(6.0) or shown_time(browser) == pytest.approx(5.0)
        browser.key("Home")
        browser.key("ArrowRight")
        browser.key("ArrowRight")
        browser.key("ArrowLeft")
        assert browser.evaluate("annotator.player.frame") == 1
        browser.key("ArrowDown")
        assert browser.evaluate("document.getElementById('video').playbackRate") == 0.75

        browser.click(*browser.evaluate("annotator.lanePosition('left', 5.5)"))
        assert shown_time(browser) == pytest.approx(5.5, abs=0.05)
        browser.fill(*browser.element("document.getElementById('object')"), "sofa")
        browser.poll(lambda: browser.evaluate("annotator.labels.state.left[1].kind") == "sliding")
        browser.click(*browser.evaluate("annotator.lanePosition('left', 1.5)"))
        browser.key("Delete")
        assert spans(browser, "left") == [[5.0, 6.0]]
        # A start is not dragged beyond the contact's own end, nor an end over the next start.
        grip = browser.evaluate("annotator.lanePosition('left', 5.0)")
        browser.drag([tuple(grip), tuple(browser.evaluate("annotator.lanePosition('left', 9.0)"))])
        (start, stop), = spans(browser, "left")  # fmt: skip
        assert stop - start == pytest.approx(1 / FPS)
        browser.key("z")
        x, y = browser.evaluate("annotator.lanePosition('left', 6.0)")
        browser.drag([(x, y), (1090, y)])
        assert spans(browser, "left") == [[5.0, CLOCK.stop_s]], "an end can be taken away again"
        browser.key("z")

        before = browser.evaluate("annotator.view.yaw")
        x, y = browser.evaluate(
            "(() => { const b = annotator.view.canvas.getBoundingClientRect(); return [b.x + 30, b.y + 30] })()"
        )
        browser.drag([(x, y), (x + 40, y + 10)])
        assert browser.evaluate("annotator.view.yaw") != before
        assert browser.evaluate("annotator.labels.before.length") == 2, "turning the view changes no label"
        assert saved(browser)
        assert browser.exceptions == []
    stored = json.loads((tmp_path / "r0.contacts.json").read_text())
    assert stored["contacts"] == {"left_hand": [[5.0, 6.0]], "right_hand": [[3.0, -1.0]]}
    assert stored["objects"]["left_hand"] == ["sofa"]
    assert stored["classes"]["left_hand"] == ["sliding"]


@pytest.mark.browser
@pytest.mark.slow
def test_labels_outlive_a_server_that_is_away_and_another_window(dataset, tmp_path):
    profile = tmp_path / "profile"
    with opened(dataset, tmp_path, profile) as (browser, server):
        port = int(server.url.rsplit(":", 1)[1])
        server.stop()
        browser.key("End")
        browser.key("ArrowLeft", SHIFT)
        browser.key("a")
        browser.poll(lambda: "does not answer" in browser.text())
        again = AnnotationServer(Desk.of(dataset / "r0", tmp_path), port)
        assert again.url == server.url
        try:
            assert saved(browser)
            assert len(on_disk(tmp_path, "left")) == 1
            AnnotationFile(tmp_path, CLOCK).save(labels([(1.0, 2.0)]), "", force=True)
            browser.key("l")
            browser.poll(lambda: "another window" in browser.text())
            assert on_disk(tmp_path, "left") == [[1.0, 2.0]]
            browser.click(*browser.element("document.getElementById('mine')"))
            assert saved(browser)
            assert len(on_disk(tmp_path, "right")) == 1
            kept = [
                json.loads(p.read_text())["contacts"]["left_hand"] for p in (tmp_path / "backups").iterdir()
            ]
            assert [[1.0, 2.0]] in kept
            assert browser.exceptions == []
        finally:
            again.stop()


@pytest.mark.browser
@pytest.mark.slow
def test_unsaved_labels_come_back_when_the_browser_was_closed(dataset, tmp_path):
    with opened(dataset, tmp_path, tmp_path / "profile") as (browser, server):
        kept = {"labels": labels([(1.0, 2.0)]), "base": ""}
        browser.evaluate(f"localStorage.setItem(annotator.saver.key, {json.dumps(json.dumps(kept))})")
        browser.go("about:blank")
        browser.go(server.url)
        settled(browser)
        assert spans(browser, "left") == [[1.0, 2.0]]
        assert saved(browser)
        assert on_disk(tmp_path, "left") == [[1.0, 2.0]]
        assert browser.evaluate("localStorage.length") == 0
        browser.key("l")
        browser.go("about:blank")  # at once, before the save that waits
        browser.poll(lambda: len(on_disk(tmp_path, "right")) == 1, 10)

        browser.go(server.url)
        settled(browser)
        browser.evaluate(f"localStorage.setItem(annotator.saver.key, {json.dumps(json.dumps(kept))})")
        browser.go("about:blank")
        browser.go(server.url)  # the file has changed since these were kept
        settled(browser)
        browser.poll(lambda: "never saved" in browser.text())
        assert len(spans(browser, "right")) == 1
        browser.click(*browser.element("document.getElementById('mine')"))
        browser.poll(lambda: on_disk(tmp_path, "right") == [])


@pytest.mark.browser
@pytest.mark.slow
def test_several_recordings_and_one_without_a_video(dataset, tmp_path):
    with opened(dataset, tmp_path, tmp_path / "profile", "") as (browser, _):
        browser.key("a")
        browser.key("PageDown")
        browser.poll(lambda: browser.evaluate("annotator.ready && annotator.take.header.name") == "r1")
        assert len(on_disk(tmp_path, "left")) == 1, "saved before the next was opened"
        assert browser.evaluate("document.getElementById('film').hidden")
        browser.key(" ")
        browser.poll(lambda: shown_time(browser) > 3.0)
        assert browser.evaluate("annotator.framesPerSecond") > 5
        browser.key(" ")
        assert spans(browser, "left") == []
        assert browser.exceptions == []
