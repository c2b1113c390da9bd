"""The wheel carries configs, split lists and one checkpoint, its command works without the checkout, and a release is checked."""

import os
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
import yaml

from release import __main__ as release
from release import install
from release.__main__ import newest
from wearcap import __version__

ROOT = Path(__file__).parents[1]
FIRST = "echo.safetensors"
"""The checkpoint that README's first capture takes."""


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
    wanted = names_of(project["dependencies"]) | names_of(extras["dev"])
    for extra in ("train", "view", "live", "scene", "export", "cluster", "notebooks", "site"):
        wanted |= names_of(extras[extra])
    assert not wanted - set(pins) - {"wearcap"}
    assert pins["torch"] == "2.13.0"
    assert "wearcap" not in pins


def test_one_version_everywhere(project):
    assert set(project["dynamic"]) == {"readme", "version"}
    assert f"version: {__version__}" in (ROOT / "CITATION.cff").read_text()
    assert newest((ROOT / "CHANGELOG.md").read_text(encoding="utf-8"))[0] == __version__


def test_the_extra_of_all_and_the_developers_hold_every_other(project):
    extras = project["optional-dependencies"]
    assert set(re.findall(r"\w+", extras["all"][0])) - {"wearcap", "view"} == {"train", "live", "scene", "export"}
    assert "wearcap[view]" in extras["live"]
    assert extras["dev"][0].startswith("wearcap[all,")


def test_a_changelog_has_a_newest_version():
    assert newest("# Changelog\n\n## 0.2.0 - 2027-01-31\n\n## 0.1.0 - unreleased\n") == ("0.2.0", "2027-01-31")
    assert newest("# Changelog\n\n## soon\n") == ("", "")


def test_a_release_is_refused_with_what_stands_against_it(monkeypatch):
    answers = {("status", "--porcelain"): " M file", ("tag", "--list", f"v{__version__}"): f"v{__version__}"}
    monkeypatch.setattr(release, "git", lambda *arguments: answers[arguments])
    monkeypatch.setattr(release, "__version__", "9.9.9")
    answers[("tag", "--list", "v9.9.9")] = "v9.9.9"
    found = release.faults()
    assert "the tree has changes that are not committed" in found
    assert f"CHANGELOG.md begins with {__version__}, the package is 9.9.9" in found
    assert "the tag v9.9.9 exists" in found
    assert not any("registry" in fault for fault in found)


def test_the_workflow_tests_every_python_that_the_project_names(project):
    workflow = yaml.safe_load((ROOT / ".github/workflows/test.yml").read_text())
    named = {line.rsplit(" ", 1)[1] for line in project["classifiers"] if re.search(r"Python :: 3\.\d+$", line)}
    assert set(workflow["jobs"]["test"]["strategy"]["matrix"]["python"]) == named
    low, high = re.fullmatch(r">=3\.(\d+),<3\.(\d+)", project["requires-python"]).groups()
    assert named == {f"3.{minor}" for minor in range(int(low), int(high))}


@pytest.mark.parametrize("extra", install.CHECKS)
def test_every_environment_of_the_wheels_test_is_an_extra(project, extra):
    assert extra == "core" or extra in project["optional-dependencies"]
    assert all(command[0] in ("wearcap", "python") for command in install.CHECKS[extra])


def test_a_command_of_the_wheels_test_that_fails_is_reported(tmp_path):
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin/python").symlink_to(sys.executable)
    assert install.run(["python", "-c", "pass"], tmp_path, tmp_path) == ""
    assert "ZeroDivisionError" in install.run(["python", "-c", "1 / 0"], tmp_path, tmp_path)


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


def run(site: Path, cwd: Path, *arguments: str, **variables: str) -> subprocess.CompletedProcess:
    environment = os.environ | {"PYTHONPATH": str(site)} | variables
    return subprocess.run(
        [sys.executable, *arguments], cwd=cwd, env=environment, capture_output=True, text=True, check=False
    )


@pytest.mark.slow
def test_the_wheel_carries_every_config_and_split_list(unpacked, tmp_path):
    resources = unpacked / "wearcap" / "_resources"
    assert {path.name for path in (resources / "checkpoints").iterdir()} == {"registry.json", FIRST, "echo.md"}
    assert (unpacked / "wearcap/py.typed").is_file()
    assert (unpacked / "wearcap/body/anny.safetensors").is_file()
    for ours, theirs in (("conf", "conf"), ("data_prep/splits", "splits")):
        expected = {path.relative_to(ROOT / ours) for path in (ROOT / ours).rglob("*") if path.is_file()}
        assert expected
        assert expected == {
            path.relative_to(resources / theirs) for path in (resources / theirs).rglob("*") if path.is_file()
        }
    (described,) = unpacked.glob("*.dist-info/METADATA")
    links = re.findall(r"\]\(([^)]+)\)", described.read_text(encoding="utf-8"))
    assert len(links) > 20, "README, as an index shows it"
    assert [link for link in links if not link.startswith("https://")] == []
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
    listed = "from wearcap.models.checkpoint import checkpoint_file, shared_checkpoints as s; print(len(s()), checkpoint_file('echo'))"
    count, file = run(unpacked, tmp_path, "-c", listed).stdout.split()
    assert int(count) == len(list((ROOT / "checkpoints").glob("*.safetensors")))
    assert file == str(unpacked / "wearcap/_resources/checkpoints" / FIRST)
    lacking = run(unpacked, tmp_path, "-m", "wearcap.cli.main", "evaluate", "hmd2", WEARCAP_WEIGHTS=str(tmp_path))
    assert lacking.returncode == 2
    assert re.fullmatch(
        r"wearcap evaluate: .*: no hmd2\.safetensors in WEARCAP_WEIGHTS\. Download https\S+ into it\.\n", lacking.stderr
    )
    held = "from wearcap.models.checkpoint import read_checkpoint; print(read_checkpoint('hmd2')[0]['name'])"
    assert run(unpacked, tmp_path, "-c", held, WEARCAP_WEIGHTS=str(ROOT / "checkpoints")).stdout == "hmd2\n"
    typo = run(unpacked, tmp_path, "-m", "wearcap.cli.main", "train", "data=smulated")
    assert typo.returncode == 2
    assert "Did you mean 'simulated'" in typo.stderr
    assert not list(tmp_path.iterdir())
