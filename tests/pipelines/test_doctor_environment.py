"""The doctor on environments: a sound one is listed, each planted defect is named."""

import json
import math
from dataclasses import replace

import pytest
import torch

from boxes import box_mesh
from wearcap.apps.doctor import examine
from wearcap.checks import Finding
from wearcap.checks.places import _check_environment
from wearcap.cli.main import run_verb
from wearcap.io.formats.environment import write_environment
from wearcap.scene.objects import Environment, Freedom, SceneObject


def scene_object(name, size=(1.0, 0.6, 0.8), at=(0.0, 0.0, 0.0), freedom=Freedom("plane"), origin=0.0) -> SceneObject:
    """A box on its frame's floor; with origin 0.5 its frame is at its left end."""
    x, y, z = size
    mesh = box_mesh(((origin - 0.5) * x, -y / 2, 0.0), ((origin + 0.5) * x, y / 2, z))
    return SceneObject(name, name.split("_")[0], mesh, torch.eye(3), torch.tensor(at), freedom)


def door(at=(5.0, 0.0, 0.0), **freedom) -> SceneObject:
    return scene_object(
        "door_1", (0.9, 0.05, 2.0), at, Freedom(**{"kind": "hinge", "pivot": at, "limits": (0.0, 1.6)} | freedom), 0.5
    )


SOUND = (scene_object("sofa_1"), scene_object("table_1", at=(3.0, 0.0, 0.0)), door(),
         scene_object("drawer_1", (0.4, 0.4, 0.2), (0.0, 4.0, 0.5), Freedom("axis", axis=(1.0, 0.0, 0.0), limits=(0.0, 0.4))),
         scene_object("box_1", (0.3, 0.3, 0.3), (0.0, 0.0, 0.8), Freedom("free")))  # fmt: skip


def found(*objects, severity=("error", "warning", "note")) -> list[Finding]:
    return [finding for finding in _check_environment(Environment(objects)) if finding.severity in severity]


def test_a_sound_environment_is_listed():
    assert not found(*SOUND)
    reported = {finding.check: finding for finding in found(*SOUND, severity=("ok",))}
    assert reported["environment"].what == "5 objects"
    assert reported["environment"].evidence == "1 axis, 1 free, 1 hinge, 2 plane"
    assert reported["object door_1"].what == "door: turns about a hinge, 0° to 92°"
    assert reported["object drawer_1"].what == "drawer: slides along an axis, 0.00 to 0.40 m"
    assert "0.90 x 0.05 x 2.00 m, 12 triangles" in reported["object door_1"].evidence


@pytest.mark.parametrize(
    ("item", "what", "severity"),
    [
        (scene_object("chair_9", (0.0009, 0.0006, 0.001), (7.0, 0.0, 0.0)), "the mesh is tiny", "warning"),
        (scene_object("chair_9", (20.0, 0.6, 0.8), (0.0, 30.0, 0.0)), "the mesh is larger than an object", "warning"),
        (scene_object("sofa_9"), "are at the same place", "warning"),
        (
            scene_object("chair_9", (0.4, 0.4, 0.5), (3.0, 0.0, 0.05)),
            "the first stands within the second's box",
            "note",
        ),
        (scene_object("chair_9", at=(9.0, 0.0, -0.5)), "reaches below the floor", "warning"),
        (scene_object("box_9", at=(9.0, 0.0, -0.5), freedom=Freedom("free")), "reaches below the floor", "warning"),
        (scene_object("chair_9", at=(9.0, 0.0, 0.5)), "slides above the others' floor", "note"),
        (
            replace(door((8.0, 0.0, 0.0), pivot=(7.7, 0.0, 0.0)), name="door_9"),
            "the hinge is beside the mesh",
            "warning",
        ),
        (replace(door((8.0, 0.0, 0.0), pivot=(8.4, 0.0, 0.0)), name="door_9"), "the hinge is in the middle", "note"),
        (replace(door((8.0, 0.0, 0.0), limits=None), name="door_9"), "no limits", "note"),
    ],
)
def test_what_looks_wrong_is_named(item, what, severity):
    reported = found(*SOUND, item)
    assert [(finding.what, finding.severity) for finding in reported] == [(what, severity)]
    assert "_9" in reported[0].check
    assert reported[0].fix


def test_an_empty_environment():
    assert [finding.what for finding in found()] == ["no objects"]


def test_files_and_folders(tmp_path, capsys):
    write_environment(Environment(SOUND), tmp_path)
    for path in (tmp_path, tmp_path / "environment.json"):
        report = examine(path)
        assert report.sound
        assert len(report.of_severity("ok")) == 6
    assert run_verb("doctor", [str(tmp_path)]) == 0
    assert "door: turns about a hinge" in " ".join(capsys.readouterr().out.split())


def test_a_file_that_cannot_be_read_is_an_error(tmp_path, capsys):
    write_environment(Environment(SOUND), tmp_path)
    path = tmp_path / "environment.json"
    content = json.loads(path.read_text())
    content["objects"][2]["freedom"]["pivot"] = [50.0, math.pi, 0.0]
    path.write_text(json.dumps(content))
    report = examine(path)
    assert not report.sound
    ((_, finding),) = report.of_severity("error")
    assert finding.check == "environment"
    assert "its hinge is 44." in finding.what
    with pytest.raises(SystemExit, match="1"):
        run_verb("doctor", [str(path)])
    assert "at most 0.5 m" in " ".join(capsys.readouterr().out.split())
    path.write_text("{}")
    assert "not an environment" in examine(path).of_severity("error")[0][1].what
