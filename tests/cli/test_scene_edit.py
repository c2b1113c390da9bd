"""`wearcap scene edit`: what it opens, where it saves, and what it reports about what is none."""

import numpy as np
import pytest
import torch

from wearcap.apps.scene_editor.editor import ObjectEditor
from wearcap.cli import scene_edit
from wearcap.errors import WearcapError
from wearcap.geometry.mesh import Mesh
from wearcap.io.formats.environment import write_environment
from wearcap.io.formats.ply import Ply, write_ply
from wearcap.scene.objects import Environment, Freedom, SceneObject


def a_floor(folder, scale: float = 1.0):
    side = np.arange(0, 3, 0.05)
    points = np.stack(np.meshgrid(side, side, [0.0, 0.02]), -1).reshape(-1, 3)
    write_ply(Ply((scale * points).astype(np.float32)), folder / "pointcloud.ply")


def an_environment(x: float) -> Environment:
    crate = Mesh(np.eye(3, dtype=np.float32) * 0.3, np.array([[0, 1, 2]], np.int32), np.ones(3, np.float32))
    return Environment(
        (SceneObject("crate", "box", crate, torch.eye(3), torch.tensor([x, 1.0, 0.0]), Freedom("free")),)
    )


@pytest.fixture
def pages(monkeypatch):
    opened = []
    monkeypatch.setattr(ObjectEditor, "run", lambda self: opened.append(self))
    return opened


def test_a_folder_or_a_file_opens_with_what_was_made_before(tmp_path, pages, capsys):
    a_floor(tmp_path)
    write_environment(an_environment(1.0), tmp_path / "environment.json")
    scene_edit.main([str(tmp_path), "--port", "18420"])
    printed = capsys.readouterr().out
    assert "open http://127.0.0.1:" in printed
    assert str(tmp_path / "environment.json") in printed
    assert pages[0].current == "crate"
    scene_edit.main(
        [str(tmp_path / "pointcloud.ply"), "--environment", str(tmp_path / "other.json"), "--port", "18420"]
    )
    assert pages[1].file == tmp_path / "other.json"
    assert pages[1].current is None
    assert not (tmp_path / "other.json").exists(), "nothing was made"


def test_a_scan_in_millimetres(tmp_path, pages):
    a_floor(tmp_path, 1000.0)
    scene_edit.main([str(tmp_path), "--metres-per-unit", "0.001", "--port", "18420"])
    assert pages[0].editing.scan.points.max() == pytest.approx(2.95)
    with pytest.raises(WearcapError, match="millimetres"):
        scene_edit.main([str(tmp_path)])


def test_what_is_wrong_is_printed(tmp_path, pages):
    for arguments, match in (
        ([str(tmp_path / "none")], "no scan of a scene here"),
        ([str(tmp_path)], r"no scan of a scene here.*pointcloud.ply"),
        ([str(tmp_path), "--port", "0"], "1 to 65535"),
    ):
        with pytest.raises(WearcapError, match=match):
            scene_edit.main([*arguments])
    a_floor(tmp_path)
    with pytest.raises(WearcapError, match=r"a \.json file"):
        scene_edit.main([str(tmp_path), "--environment", str(tmp_path / "map.ply")])
    write_environment(an_environment(50.0), tmp_path / "environment.json")
    with pytest.raises(WearcapError, match=r"environment\.json: the object 'crate' stands .* outside the scan"):
        scene_edit.main([str(tmp_path)])
    (tmp_path / "environment.json").write_text("{")
    with pytest.raises(WearcapError, match=r"environment\.json"):
        scene_edit.main([str(tmp_path)])
    assert not pages


def test_help_tells_of_every_option(capsys):
    with pytest.raises(SystemExit) as ended:
        scene_edit.main(["--help"])
    assert ended.value.code == 0
    printed = capsys.readouterr().out
    for word in ("scene", "environment=", "metres_per_unit=", "port=", "host="):
        assert word in printed
