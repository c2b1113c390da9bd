"""What each command says where the extra that it needs is not installed, and what works without any."""

import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from PIL import Image

from wearcap.cli.verbs import VERBS
from wearcap.errors import WearcapError
from wearcap.extras import EXTRAS, at_first_use, required
from wearcap.extras import VERBS as MODULES
from wearcap.runtime.graphs import open_onnx

ROOT = Path(__file__).parents[1]
WALK = str(ROOT / "examples" / "headset_walk.csv")
BLOCKED = """
import sys
from importlib.machinery import PathFinder

class Others(PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return None if name.partition(".")[0] in {blocked!r} else super().find_spec(name, path, target)

sys.meta_path[sys.meta_path.index(PathFinder)] = Others
"""
NEEDS = {
    "train": ("train", ["data=simulated"]),
    "adapt": ("train", ["mocap_every", "recordings=nowhere"]),
    "demo": ("train", []),
    "view": ("view", [WALK]),
    "live": ("live", ["system=mocap_every", "source=vmc"]),
    "annotate": (None, ["--help"]),
    "scene": ("scene", ["nowhere"]),
    "calibrate": ("scene", ["source=pictures", "columns=9", "rows=6", "square_m=0.03"]),
    "track": ("scene", ["nowhere"]),
    "export": ("export", ["mocap_every", "format=onnx", "output=x.onnx"]),
    "evaluate": (None, ["mocap_every", "--cfg", "job"]),
    "capture": (None, [WALK, "height=1.68", "output=out"]),
    "render": (None, [WALK, "frames=1", "size=80x80", "out=x.png"]),
    "doctor": (None, [WALK]),
    "prepare": (None, ["--help"]),
}
"""The extra that a verb needs with these arguments; None: it needs none."""


RUNS = """
import contextlib, io, json, time
from wearcap.cli.main import run_verb
runs = {}
for verb, arguments in json.loads(sys.argv[1]).items():
    err, out, began = io.StringIO(), io.StringIO(), time.time()
    with contextlib.redirect_stderr(err), contextlib.redirect_stdout(out):
        try:
            code = run_verb(verb, arguments)
        except SystemExit as ended:
            code = ended.code
    runs[verb] = [code, err.getvalue(), time.time() - began]
import importlib, pkgutil, wearcap
for name in ("hps", "ireplica", "hmd2", "mocap_every", "echo"):
    wearcap.load(name)
for package in ("wearsim", "data_prep"):
    for module in pkgutil.walk_packages(importlib.import_module(package).__path__, f"{package}."):
        importlib.import_module(module.name)
print(json.dumps(runs))
"""
"""Runs verbs one after the other, and prints their exit codes and what they wrote to stderr; then
loads every system, and imports all that prepares and simulates."""


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> dict[str, list]:
    """What the verbs do in a process without any extra."""
    folder = tmp_path_factory.mktemp("core")
    (folder / "pictures").mkdir()
    for number in range(4):
        Image.new("RGB", (64, 48)).save(folder / "pictures" / f"{number}.png")
    ended = subprocess.run(
        [
            sys.executable,
            "-c",
            BLOCKED.format(blocked=set(EXTRAS)) + RUNS,
            json.dumps({v: a for v, (_, a) in NEEDS.items()}),
        ],
        cwd=folder,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    return json.loads(ended.stdout.splitlines()[-1])


def test_every_verb_has_its_row():
    assert set(NEEDS) == set(VERBS)


@pytest.mark.slow
@pytest.mark.parametrize("verb", NEEDS)
def test_a_verb_names_the_extra_that_it_needs_or_works_without(runs, verb):
    code, err, _ = runs[verb]
    if (extra := NEEDS[verb][0]) is None:
        assert code == 0, err
    else:
        assert code == 2
        assert err.count("\n") == 1
        assert f'Run: pip install "wearcap[{extra}]"' in err


def test_a_setting_names_the_extra_that_it_needs(monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(
        WearcapError, match=r"localisation needs the package 'cv2'. Run: pip install \"wearcap\[scene\]\""
    ):
        at_first_use("cv2", "localisation").SIFT.create()


def test_a_lazy_module_is_the_module():
    assert at_first_use("json", "this test").dumps is json.dumps
    assert required("json.decoder", "this test").JSONDecoder is json.JSONDecoder
    with pytest.raises(
        WearcapError, match="this test needs the package 'no_such'. Run: pip install \"no_such\", or rest"
    ):
        required("no_such.part", "this test", "rest")


def test_the_table_names_extras_of_the_project():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(EXTRAS.values()) <= set(extras)
    assert {module for modules in MODULES.values() for module in modules} <= set(EXTRAS)


def test_an_onnx_file_names_the_extra_that_runs_it(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(
        WearcapError, match=r"an ONNX file needs the package 'onnxruntime'. Run: pip install \"wearcap\[export\]\""
    ):
        open_onnx(tmp_path / "x.onnx")
