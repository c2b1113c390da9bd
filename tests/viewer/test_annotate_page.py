"""The annotator's page in a real browser, in which hands are clicked while a video plays."""

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from annotated_flat import CLOCK, FPS, TIMES, labels, served, write_flat

from wearcap.apps.annotate.server import AnnotationServer
from wearcap.apps.annotate.takes import AnnotationFile, Desk
from wearcap.io.formats.contact_labels import LabelClock, read_contact_labels
from wearcap_browser import SHIFT, Chromium, chromium


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    return write_flat(tmp_path_factory.mktemp("flat"))


@contextmanager
def opened(
    dataset: Path, output: Path, profile: Path, where: str = "r0"
) -> Iterator[tuple[Chromium, AnnotationServer]]:
    with served(dataset, output, where) as server, chromium(profile, server.url, webgl=False) as browser:
        settled(browser)
        yield browser, server


def settled(browser: Chromium) -> None:
    """The page is open and, where there is a video, it shows its first picture."""
    browser.poll(
        lambda: browser.evaluate("window.annotator?.ready && (annotator.player.usable || !annotator.take.header.video)")
    )


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
    browser.poll(lambda: browser.evaluate("annotator.view.frame === annotator.player.frame && !annotator.view.stale"))
    browser.click(*browser.evaluate(f"annotator.handPosition('{hand}')"))


def on_disk_at_all(output: Path) -> bool:
    return (output / "r0.contacts.json").exists()


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
        ((start, stop),) = spans(browser, "left")
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
        ((start, stop),) = spans(browser, "left")
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
        server.stop()
        browser.key("End")
        browser.key("ArrowLeft", SHIFT)
        browser.key("a")
        browser.poll(lambda: "does not answer" in browser.text())
        again = AnnotationServer(Desk(dataset / "r0", tmp_path), server.server_port)
        assert again.server_port == server.server_port
        try:
            browser.poll(lambda: "open the address that it printed" in browser.text())
            assert not on_disk_at_all(tmp_path)
            browser.call("Target.createTarget", url=again.url)  # another window, as the command opens it
            assert saved(browser)
            assert len(on_disk(tmp_path, "left")) == 1
            AnnotationFile(tmp_path, CLOCK).save(labels([(1.0, 2.0)]), "", force=True)
            browser.key("l")
            browser.poll(lambda: "another window" in browser.text())
            assert on_disk(tmp_path, "left") == [[1.0, 2.0]]
            browser.click(*browser.element("document.getElementById('mine')"))
            assert saved(browser)
            assert len(on_disk(tmp_path, "right")) == 1
            kept = [json.loads(p.read_text())["contacts"]["left_hand"] for p in (tmp_path / "backups").iterdir()]
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
