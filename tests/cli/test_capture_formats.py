"""`wearcap capture formats=[…]`: the files that are written, and what is refused before anything is computed."""

import importlib.util

import pytest

from captured_motion import walk
from wearcap.cli import capture
from wearcap.errors import WearcapError
from wearcap.io.formats.motion_npz import write_motion
from wearcap.io.saving import require_formats

USD = ["usda"] if importlib.util.find_spec("pxr") else []


def test_a_capture_writes_the_formats_of_the_list(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "gait.json").write_text("{}")  # of somebody who walked
    write_motion(walk(1.0), tmp_path / "walk.npz")
    given = [
        "pipeline=recorded",
        f"recording={tmp_path}/walk.npz",
        f"hydra.run.dir={tmp_path}/run",
        f"output={tmp_path}/out",
    ]
    formats = ["vrma", "bvh", *USD]
    capture.main([*given, "video=false", "body=false", "smpl=false", f"formats=[{','.join(formats)}]"])
    assert {path.name for path in (tmp_path / "out").iterdir()} == {f"motion.{ending}" for ending in ("npz", *formats)}


def test_a_character_cannot_move_while_a_recording_grows(tmp_path):
    given = ["pipeline=hps", "live=true", f"recording={tmp_path}", f"to_rig={tmp_path}/hero.glb"]
    with pytest.raises(WearcapError, match="to_rig.*pipeline=recorded to_rig="):
        capture.main([*given, f"hydra.run.dir={tmp_path}/run"])


@pytest.mark.parametrize("formats", ["usd", ["glb", "fbx"], [""]])
def test_formats_that_are_not_written_are_named(formats):
    with pytest.raises(WearcapError, match=r"formats.*Expected.*(glb|a list: formats=\[usd\])"):
        require_formats(formats)
