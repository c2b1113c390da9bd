"""The wheel carries configs and split lists, and its command works without the checkout."""

import os
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

from wearcap import __version__

ROOT = Path(__file__).parents[1]


def names_of(requirements: list[str]) -> set[str]:
    return {re.split(r"[<>=\[; ]", line)[0].lower().replace("_", "-") for line in requirements}


@pytest.fixture(scope="module")
def project() -> dict:
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


@pytest.fixture(scope="module")
def pins() -> dict[str, str]:
    lines = [line for line in (ROOT / "requirements.lock").read_text().splitlines() if line and line[0] != "#"]
    assert all(re.fullmatch(r"[\w.\-]+==[\w.]+", line) for line in lines), "exact pins alone"
    return {name.lower().replace("_", "-"): version for name, version in (line.split("==") for line in lines)}


def test_every_dependency_of_the_developers_install_is_pinned(project, pins):
    extras = project["optional-dependencies"]
    wanted = names_of(project["dependencies"])
    for extra in ("dev", "export", "sweep", "cluster", "notebooks", "site"):
        wanted |= names_of(extras[extra])
    assert not wanted - set(pins) - {"wearcap"}
    assert pins["torch"] == "2.13.0"
    assert "wearcap" not in pins


def test_one_version_everywhere(project):
    assert project["version"] == __version__
    assert f"version: {__version__}" in (ROOT / "CITATION.cff").read_text()


def test_pre_commit_takes_the_locked_ruff(pins):
    assert f"rev: v{pins['ruff']}" in (ROOT / ".pre-commit-config.yaml").read_text()


def test_the_notices_are_there():
    notice = (ROOT / "NOTICE.md").read_text()
    assert "The data used in this project was obtained from mocap.cs.cmu.edu" in " ".join(notice.split())
    assert "NSF EIA-0196217" in notice
    assert "MIT" in (ROOT / "LICENSE").read_text()


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory) -> Path:
    """The wheel, built and unpacked like an installation."""
    pytest.importorskip("hatchling")
    folder = tmp_path_factory.mktemp("wheel")
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", folder],
        cwd=ROOT,
        check=True,
        capture_output=True,
    )
    with zipfile.ZipFile(next(folder.glob("*.whl"))) as wheel:
        wheel.extractall(folder / "site")
    return folder / "site"


def run(site: Path, cwd: Path, *arguments: str) -> subprocess.CompletedProcess:
    environment = os.environ | {"PYTHONPATH": str(site)}
    return subprocess.run(
        [sys.executable, *arguments], cwd=cwd, env=environment, capture_output=True, text=True, check=False
    )


@pytest.mark.slow
def test_the_wheel_carries_every_config_and_split_list(unpacked, tmp_path):
    resources = unpacked / "wearcap" / "_resources"
    for ours, theirs in (("checkpoints", "checkpoints"), ("conf", "conf"), ("data_prep/splits", "splits")):
        expected = {path.relative_to(ROOT / ours) for path in (ROOT / ours).rglob("*") if path.is_file()}
        assert expected
        assert expected == {
            path.relative_to(resources / theirs) for path in (resources / theirs).rglob("*") if path.is_file()
        }
    ended = run(unpacked, tmp_path, "-c", "from wearcap.cli import conf; print(conf.conf_dir(), conf.splits_dir())")
    assert ended.stdout.split() == [str(resources / "conf"), str(resources / "splits")]


@pytest.mark.slow
def test_the_command_works_from_the_wheel(unpacked, tmp_path):
    version = run(unpacked, tmp_path, "-m", "wearcap.cli.main", "--version")
    assert version.stdout == f"wearcap {__version__}\n"
    ended = run(unpacked, tmp_path, "-m", "wearcap.cli.main", "prepare", "cmu", f"source={tmp_path}")
    assert ended.returncode == 2
    assert (
        ended.stderr
        == f"wearcap prepare: {tmp_path}: no .amc or .bvh files. Expected motion files, plain or .xz or .gz.\n"
    )
    typo = run(unpacked, tmp_path, "-m", "wearcap.cli.main", "train", "data=smulated")
    assert typo.returncode == 2
    assert "Did you mean 'simulated'" in typo.stderr
    assert not list(tmp_path.iterdir())
