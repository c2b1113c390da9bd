"""The list of shared checkpoints: it fits the files, and names that are not here are fetched."""

import hashlib
import json
import shutil

import pytest

from release.registry import FOLDER, registry
from wearcap.errors import WearcapError
from wearcap.models import checkpoint
from wearcap.models.checkpoint import checkpoint_file, read_checkpoint, shared_checkpoints
from wearcap.version import __version__


def test_the_registry_is_that_of_the_files():
    assert (FOLDER / "registry.json").read_text(encoding="utf-8") == registry(), "python -m release.registry"


def test_an_entry_says_where_the_file_is_and_how_large():
    remote = shared_checkpoints()["echo"]
    file = FOLDER / "echo.safetensors"
    assert remote.digest == f"sha256:{hashlib.sha256(file.read_bytes()).hexdigest()}"
    assert remote.bytes == file.stat().st_size
    assert remote.urls == (f"https://huggingface.co/wearcap/wearcap/resolve/v{__version__}/echo.safetensors",)


def test_a_checkout_uses_its_own_files():
    assert checkpoint_file("echo") == FOLDER / "echo.safetensors"


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """A folder as the wheel has it: the registry, and no file."""
    shutil.copy(FOLDER / "registry.json", tmp_path)
    monkeypatch.setattr(checkpoint, "_folder", lambda: tmp_path)
    monkeypatch.setenv("WEARCAP_WEIGHTS", str(FOLDER))
    return tmp_path


def test_a_name_that_is_not_here_is_fetched(installed):
    assert checkpoint_file("contact_sequence") == FOLDER / "contact_sequence.safetensors"
    assert read_checkpoint("contact_sequence")[1]


def test_what_cannot_be_fetched_is_a_sentence(installed, monkeypatch):
    monkeypatch.setenv("WEARCAP_WEIGHTS", str(installed))
    monkeypatch.setenv("WEARCAP_CACHE", str(installed))
    with pytest.raises(
        WearcapError, match=r"no hmd2\.safetensors in WEARCAP_WEIGHTS\. Download https.*hmd2\.safetensors into it"
    ):
        checkpoint_file("hmd2")
    with pytest.raises(WearcapError, match="Did you mean 'echo'"):
        checkpoint_file("ecko")


def test_another_file_under_a_checkpoints_name_is_refused(installed, monkeypatch):
    (installed / "weights").mkdir()
    (installed / "weights/hmd2.safetensors").write_bytes((FOLDER / "echo.safetensors").read_bytes())
    monkeypatch.setenv("WEARCAP_WEIGHTS", str(installed / "weights"))
    with pytest.raises(WearcapError, match="another file than sha256:"):
        checkpoint_file("hmd2")


def test_the_registry_is_small_and_plain():
    listed = json.loads((FOLDER / "registry.json").read_text(encoding="utf-8"))
    assert set(listed) == {"urls", "checkpoints"}
    assert all(url.startswith("https://") for url in listed["urls"])
    assert all(set(entry) == {"sha256", "bytes", "license"} for entry in listed["checkpoints"].values())
