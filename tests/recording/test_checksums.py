"""Damaged and replaced recordings are noticed by whatever opens them, at the cost of one hash per file."""

import os
import time
from pathlib import Path

import pytest

from command_line import exit_code
from wearcap import files
from wearcap.errors import WearcapError
from wearcap.recording import RecordingStore
from wearcap.recording.store import RecordingFile
from wearcap_testing import small_dataset


@pytest.fixture
def memory(tmp_path, monkeypatch):
    """What is remembered lies in a folder of the test; `forget` is a new process."""
    monkeypatch.setenv("WEARCAP_CACHE", str(tmp_path / "cache"))
    forget = files._ledger.cache_clear
    forget()
    yield forget
    forget()


@pytest.fixture
def dataset(tmp_path) -> Path:
    return small_dataset(tmp_path / "data").root


def flip(path: Path, at: int = -5) -> None:
    """Change one bit of a file, and neither its size nor its name."""
    content = bytearray(path.read_bytes())
    content[at] ^= 4
    path.write_bytes(content)


@pytest.mark.parametrize("verb", ["doctor", "capture", "render", "train"])
def test_a_flipped_bit_is_one_error(verb, dataset, memory, tmp_path, capsys):
    for path in RecordingStore.open(dataset).root.glob("recordings/*"):
        flip(path)
    arguments = {
        "doctor": ["doctor", str(dataset / "r4")],
        "capture": [
            "capture",
            "pipeline=hmd2",
            "checkpoint=hmd2",
            f"recording={dataset}/r4",
            f"hydra.run.dir={tmp_path}/c",
        ],
        "render": ["render", str(dataset / "r4"), "--out", str(tmp_path / "x.png")],
        "train": [
            "train",
            "debug=fast",
            f"data.sources.simulated.root={dataset}",
            "trainer.accelerator=cpu",
            "data.dataset.window=60",
            "callbacks.progress=null",
            f"paths.outputs={tmp_path}/o",
            f"hydra.run.dir={tmp_path}/r",
        ],
    }[verb]
    assert exit_code(arguments) == (1 if verb == "doctor" else 2)
    printed = capsys.readouterr()
    assert "checksum differs from the manifest's" in " ".join((printed.out + printed.err).split())


def test_a_hash_of_the_manifest_that_is_wrong_is_noticed(dataset, memory):
    manifest = dataset / "manifest.json"
    digest = RecordingStore.open(dataset).entries["r1"].sha256
    manifest.write_text(manifest.read_text().replace(digest, "0" * 64))
    with pytest.raises(WearcapError, match=r"r1\.safetensors: its checksum differs"):
        RecordingStore.open(dataset).load("r1")
    RecordingStore.open(dataset).load("r2")


def test_a_file_is_hashed_once_and_again_when_it_changes(dataset, memory, monkeypatch):
    path, counted = RecordingStore.open(dataset).path_of("r1"), []
    old = time.time() - 60
    os.utime(path, (old, old))
    honest = files.sha256_of
    monkeypatch.setattr(files, "sha256_of", lambda file: counted.append(file) or honest(file))
    for _ in range(3):
        RecordingFile(path)
        memory()
    assert len(counted) == 1
    flip(path)
    with pytest.raises(WearcapError, match="checksum"):
        RecordingFile(path)
    flip(path)
    RecordingFile(path)
    assert len(counted) == 3, "a file that has just changed is hashed, and not remembered yet"


def test_doctor_hashes_what_is_remembered_too(dataset, memory):
    """A disk that changes bytes does not change times."""
    path = RecordingStore.open(dataset).path_of("r1")
    old = time.time() - 60
    os.utime(path, (old, old))
    RecordingFile(path)
    stamp = path.stat()
    flip(path)
    os.utime(path, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
    assert exit_code(["doctor", str(dataset / "r1")]) == 1


def test_without_a_folder_to_remember_in_everything_works(dataset, memory, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("WEARCAP_CACHE", str(tmp_path / "file"))
    RecordingFile(RecordingStore.open(dataset).path_of("r1"))


def test_a_damaged_memory_counts_for_nothing(dataset, memory, tmp_path):
    (tmp_path / "cache").mkdir()
    (tmp_path / "cache/sha256.jsonl").write_bytes(b'["a"]\n{\n[1,2,3,4,5]\n\xff\n')
    RecordingFile(RecordingStore.open(dataset).path_of("r1"))
