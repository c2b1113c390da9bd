"""The Blender add-on, in Blender's own Python: WEARCAP_BPY=PYTHON is one in which `import bpy` works."""

import ast
import importlib
import json
import os
import re
import socket
import struct
import subprocess
import sys
import time
import tomllib
import zipfile
from pathlib import Path
from types import ModuleType
from unittest.mock import MagicMock

import numpy as np
import pytest

from wearcap.apps.live.sinks import sink_of
from wearcap.apps.live.sinks.vmc import BONES
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.formats.motion_npz import write_motion
from wearcap.recording import Motion
from wearcap_testing import PROJECT, swaying_motion

ADDON = PROJECT / "integrations" / "blender"
BPY = os.environ.get("WEARCAP_BPY", "")
needs_blender = pytest.mark.skipif(not BPY, reason="needs WEARCAP_BPY=PYTHON with bpy")


def started(*arguments: object) -> subprocess.Popen:
    checks = Path(__file__).with_name("blender_checks.py")
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}  # nothing of wearcap inside
    command = [BPY, str(checks), str(ADDON), *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment)


def answer(process: subprocess.Popen) -> dict:
    out, _ = process.communicate(timeout=300)
    found = re.search(r"^ANSWER (.*)$", out, re.MULTILINE)
    assert found, out[-3000:]
    return json.loads(found[1])


def moving() -> Motion:
    motion = swaying_motion(40, 2, fps=30.0)
    door = Trajectory(motion.timestamps[:20], motion.joint("head").R[:20], motion.joint("head").t[:20])
    return Motion(motion.timestamps + 5, motion.skeleton, motion.R_parent_joint, motion.t_world_root,
                  object_motion={"door": Trajectory(door.timestamps + 5, door.R_world_body, door.t_world_body)})  # fmt: skip


@needs_blender
def test_bones_stand_where_the_motions_joints_do(tmp_path):
    motion, frames = moving(), [0, 7, 23, 39]
    write_motion(motion, tmp_path / "walk.npz")
    times = (motion.timestamps[frames] - motion.timestamps[0]).tolist()
    found = answer(started("imported", tmp_path / "walk.npz", json.dumps(times)))
    assert set(found["bones"]) == set(motion.skeleton.joint_names)
    for name, places in found["bones"].items():
        np.testing.assert_allclose(places, motion.joint(name).t[frames].numpy(), atol=1e-3)
    assert (found["fps"], found["end"]) == (30.0, 40)
    assert motion.object_motion is not None
    door = motion.object_motion["door"]
    np.testing.assert_allclose(np.array(found["objects"]["door"])[:3, 3], door.t_world_body[0].numpy(), atol=1e-4)
    np.testing.assert_allclose(np.array(found["objects"]["door"])[:3, :3], door.R_world_body[0].numpy(), atol=1e-4)


@needs_blender
def test_live_motion_is_followed_and_baked():
    """Sent by the VMC sink, among packets that are damaged."""
    motion = swaying_motion(30, 5)
    process = started("received", 0, 30, 60)
    assert process.stdout is not None
    port = next(int(line.split()[1]) for line in process.stdout if line.startswith("PORT"))
    sink = sink_of(f"vmc://127.0.0.1:{port}", "127.0.0.1", pace=False)
    sink.open()
    sink.begin("anna", motion.skeleton, 60.0)
    with socket.socket(type=socket.SOCK_DGRAM) as other:
        for bad in (
            b"",
            b"#bundle\0" + bytes(8) + struct.pack(">i", 1 << 30),
            b"/VMC/Ext/Bone/Pos\0\0\0,sf",
            os.urandom(999),
        ):
            other.sendto(bad, ("127.0.0.1", port))
        for k in range(30):
            sink.take("anna", motion.sliced(k, k + 1))
            time.sleep(0.005)
    found = answer(process)
    assert found["frames"] == 30
    assert found["refused"] >= 3
    assert list(found["live"]) == list(found["baked"])
    assert set(found["live"]) == set(BONES)
    np.testing.assert_allclose(found["times"], motion.timestamps.numpy(), atol=1e-5)
    for bone, joint in BONES.items():
        places = motion.joint(joint).t.numpy()
        np.testing.assert_allclose(found["live"][bone], places[-1], atol=1e-3)
        np.testing.assert_allclose(found["baked"][bone], places, atol=1e-3)


@needs_blender
def test_the_command_is_run_followed_and_canceled(tmp_path):
    """Of the installed wearcap a small stand-in: a script that takes the same arguments, slowly."""
    write_motion(moving(), tmp_path / "own motion.npz")
    script = tmp_path / "stand_in.py"
    script.write_text(
        "import shutil, sys, time\nprint('reading', flush=True)\n"
        "given = dict(word.split('=', 1) for word in sys.argv[2:])\ntime.sleep(float(given.get('height', 0)))\n"
        "shutil.copy(given['recording'].strip(\"'\"), given['output'].strip(\"'\") + '/motion.npz')\nprint('motion', sys.argv[1])\n"
    )
    command, recording = f"{sys.executable} {script}", tmp_path / "own motion.npz"
    found = answer(started("captured", command, recording, tmp_path, "", 0))
    assert (found["done"], found["lines"], found["bones"]) == (True, ["reading", "motion capture"], 23)
    begun = time.monotonic()
    found = answer(started("captured", command, recording, tmp_path, "height=600", 1))
    assert (found["done"], found["canceled"]) == (False, True)
    assert time.monotonic() - begun < 200


@needs_blender
def test_foreign_and_damaged_files_are_refused(tmp_path):
    write_motion(moving(), tmp_path / "whole.npz")
    data = (tmp_path / "whole.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(data[: len(data) // 2])
    np.savez(tmp_path / "foreign.npz", poses=np.zeros(3))
    np.savez(tmp_path / "pickled.npz", wearcap=np.array([{"a": 1}], dtype=object))
    paths = [str(tmp_path / name) for name in ("cut.npz", "foreign.npz", "pickled.npz", "none.npz")]
    found = answer(started("refused", *paths))
    assert all(path in said and "Error" in said for path, said in found.items()), found


def test_the_add_on_needs_nothing_of_wearcap_and_packs_as_an_extension(tmp_path):
    folder = ADDON / "wearcap_blender"
    allowed = {"bpy", "bpy_extras", "mathutils", "numpy", *sys.stdlib_module_names}
    for path in folder.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) and not node.level else []
            assert {name.split(".")[0] for name in names} <= allowed, path
    manifest = tomllib.loads((folder / "blender_manifest.toml").read_text(encoding="utf-8"))
    assert (manifest["id"], manifest["blender_version_min"]) == ("wearcap_blender", "4.2.0")
    rule = (PROJECT / "Makefile").read_text(encoding="utf-8").split("\naddon:\n\t")[1].splitlines()[1].strip()
    command = rule.replace("$(PYTHON)", sys.executable).replace("dist/", f"{tmp_path}/")
    subprocess.run(command, shell=True, check=True, cwd=PROJECT)
    with zipfile.ZipFile(tmp_path / "wearcap_blender.zip") as packed:
        names = packed.namelist()
    assert {path.name for path in folder.iterdir() if path.is_file()} == set(names)


def test_the_add_on_knows_the_bones_of_the_sink(monkeypatch):
    from wearcap.apps.live.sinks.vmc import PARENTS

    package = ModuleType("wearcap_blender")  # without its __init__, which needs Blender
    package.__path__ = [str(ADDON / "wearcap_blender")]
    monkeypatch.setitem(sys.modules, "wearcap_blender", package)
    monkeypatch.setitem(sys.modules, "mathutils", MagicMock())
    known = importlib.import_module("wearcap_blender.osc").PARENTS
    assert {name: parent or None for name, parent in known.items()} == PARENTS
