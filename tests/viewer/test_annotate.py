"""The annotator's server and files: what is served, saved, refused, exported and started from."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from annotated_flat import CLOCK, FPS, FRAMES, TIMES, ask, held, labels, served, write_flat

from wearcap.apps.annotate.server import AnnotationServer, _byte_range
from wearcap.apps.annotate.takes import AnnotationFile, Conflict, Take, starting_labels
from wearcap.body.skeleton import Skeleton, xsens23
from wearcap.cli.annotate import main as annotate
from wearcap.errors import WearcapError
from wearcap.geometry.mesh import Mesh
from wearcap.io.formats.contact_labels import Label, read_contact_labels
from wearcap.io.formats.environment import write_environment
from wearcap.io.formats.motion_npz import write_motion
from wearcap.recording import Motion, Recording, RecordingStore
from wearcap.scene.objects import Environment, Freedom, SceneObject
from wearcap_testing import recording_of, swaying_motion


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    return write_flat(tmp_path_factory.mktemp("flat"))


def test_the_page_gets_its_files_and_a_recordings_numbers(dataset, tmp_path):
    motion = swaying_motion(FRAMES, 0, FPS)
    with served(dataset, tmp_path) as server:
        for name in (
            "",
            "annotator.js",
            "annotator.css",
            "labels.js",
            "player.js",
            "saver.js",
            "skeleton.js",
            "take.js",
            "timeline.js",
        ):
            status, headers, data = ask(server, "GET", f"/{name}")
            assert status == 200
            assert b"http:" not in data.replace(b"http://www.w3.org/2000/svg", b""), "nothing from elsewhere"
            assert headers["Content-Type"].split(";")[0] in ("text/html", "text/javascript", "text/css")
        assert json.loads(ask(server, "GET", "/recordings")[2]) == [
            {"name": "r0", "annotated": False},
            {"name": "r1", "annotated": False},
        ]
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
        for path in ("/nothing", "/..%2fannotate.py", "/../annotate.py", "/recordings/7", "/recordings/1/video"):
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
    for header, wanted in (
        ("bytes=5-", (5, 9, True)),
        ("bytes=2-99", (2, 9, True)),
        ("bytes=-99", (0, 9, True)),
        ("bytes=9-", None),
        ("", (0, 9, False)),
        ("lines=1-2", (0, 9, False)),
        ("bytes=4-2", (0, 9, False)),
        ("bytes=-", (0, 9, False)),
    ):
        assert _byte_range(header, 9) == wanted


def test_a_save_is_checked_written_and_given_back(dataset, tmp_path):
    with served(dataset, tmp_path) as server:
        status, _, data = ask(
            server, "POST", "/recordings/0/labels", {"labels": labels([(1.0, 2.0)]), "base": "", "client": "a"}
        )
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
            (good | {"labels": overlap}, 422, "overlap"),
            (good | {"labels": labels(clock=replace(CLOCK, name="r7"))}, 422, "'r7'"),
            ("{", 400, "not a save"),
            ({"labels": {}}, 400, "not a save"),
            ([], 400, "not a save"),
            (good | {"labels": 3}, 422, "no contact labels"),
            (good | {"base": 3}, 400, "not a save"),
            (good | {"force": "yes"}, 400, "not a save"),
            ('{"labels": ' + "[" * 100_000, 400, "not a save"),
            ('{"labels": ' + "[" * 100 + "]" * 100 + ', "base": "", "client": "a"}', 400, "nested too deeply"),
            (good | {"labels": {"contacts": {"left_hand": [[1, 10**400]], "right_hand": []}}}, 400, "64 bits"),
            (good | {"labels": labels([(1.0, 2.0, "\ud800")])}, 400, "not a save"),
        ):
            answered, _, data = ask(server, "POST", "/recordings/0/labels", body)
            assert answered == status
            assert message in json.loads(data)["error"]
        assert ask(server, "POST", "/recordings/9/labels", good)[0] == 404
        assert ask(server, "POST", "/recordings/0/labels", good, Origin="http://elsewhere.net")[0] == 403
        assert ask(server, "POST", "/recordings/0/labels", good, Content_Type="text/plain")[0] == 403
        assert ask(server, "GET", "/recordings", Host="elsewhere.net:18300")[0] == 403
        for length, status in (("99999999999", 413), ("9" * 5000, 411), ("-1", 411), ("1e3", 411)):
            assert ask(server, "POST", "/recordings/0/labels", "", Content_Length=length)[0] == status
    assert not list(tmp_path.iterdir())


def test_nothing_is_lost_when_two_write(tmp_path):
    file = AnnotationFile(tmp_path, CLOCK)
    first = file.save(labels([(1.0, 2.0)]), "", client="a")
    second = file.save(labels([(1.0, 3.0)]), "", client="a")  # its own reply was lost: no conflict
    assert file.save(labels([(1.0, 3.0)]), first, client="b") == second  # the same labels: nothing to fight about
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
    for recording, message in ((Recording("bare"), "no motion"), (Recording("worm", motion=still), "left_wrist")):
        with pytest.raises(WearcapError, match=message):
            Take.of(recording, tmp_path)
    for arguments, message in (
        ([str(dataset), "--video", str(dataset / "r0.mp4")], "several recordings"),
        ([str(dataset / "r9")], "r9"),
        ([str(dataset / "r0"), "--video", "none.mp4"], "no such video"),
        ([str(dataset / "r0"), "--port", "0"], "port"),
        ([str(dataset / "r0"), "--video-start", "1"], "--video FILE"),
    ):
        with pytest.raises(WearcapError, match=message):
            annotate([*arguments, "--no-browser", "--output", str(tmp_path)])
    r0 = RecordingStore.open(dataset).load("r0")
    assert "r0.mp4 is not there" in Take.of(r0, tmp_path).notice
    suit = Recording("suit", suit=swaying_motion(30, skeleton=xsens23()))
    assert Take.of(suit, tmp_path).clock.frames == 30


def test_objects_of_the_environment_can_be_named(tmp_path):
    triangle = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32), np.full(3, 0.5, np.float32))
    door = SceneObject("door_1", "door", triangle, torch.eye(3), torch.zeros(3), Freedom("hinge", (0.0, 0.0, 0.0)))
    write_environment(Environment((door,)), tmp_path / "environment.json")
    recording = replace(recording_of(swaying_motion(30), "r"), environment="environment.json")
    seen = replace(recording, interactions=held([0.1], [0.2], [[True, False]], "sofa"))
    assert Take.of(seen, tmp_path).objects == {"door_1": "hinged", "sofa": "sliding"}
