"""A short run of tests/fuzz_readers.py: every reader, some damaged files."""

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from subprocess import run

import pytest

import fuzz_readers
from fuzz_readers import READERS, failed, fuzz, outcome
from valid_files import Reader

ROOT = Path(__file__).parents[2]
INPUTS = int(os.environ.get("WEARCAP_EXAMPLES", "25"))
"""Inputs of each reader."""


def rows_of(*arguments: str) -> list[dict]:
    """The lines that the program prints, and its total."""
    command = [sys.executable, "tests/fuzz_readers.py", *arguments]
    done = run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.stdout, done.stderr[-3000:]
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_damaged_files_are_read_or_refused(tmp_path):
    *rows, total = rows_of("--inputs", str(INPUTS), "--output", str(tmp_path))
    assert {row["reader"] for row in rows} == set(READERS)
    assert [row for row in rows if failed(row)] == []
    assert total["inputs"] == INPUTS * len(READERS)


def test_every_module_that_reads_is_in_the_table():
    source = ROOT / "src/wearcap/io"
    table = (ROOT / "tests/valid_files.py").read_text()
    reading = {path.stem for path in source.rglob("*.py") if "\ndef read_" in path.read_text()}
    assert {module for module in reading if f"{module}.read_" not in table} == set()


def wrongly(_: Path) -> None:
    raise KeyError("a")


def endlessly(_: Path) -> None:
    while True:
        pass


def hungrily(_: Path) -> None:
    bytearray(FREE + (1 << 24))[::4096] = b"1" * ((FREE + (1 << 24)) // 4096)


def fatally(_: Path) -> None:
    os._exit(3)


FREE = fuzz_readers.FREE_BYTES


@pytest.mark.parametrize(
    ("read", "found"),
    [
        (wrongly, {"KeyError at ?": 3}),
        (endlessly, "slow"),
        (hungrily, "memory"),
        (fatally, {"process ended with 3": 3}),
        (lambda folder: list(folder.iterdir()), None),
    ],
)
def test_a_bad_reader_fails(read: Callable[[Path], None], found, tmp_path, monkeypatch):
    monkeypatch.setattr(fuzz_readers, "ALARM_S", 1.0)

    def reading(folder: Path) -> None:
        """Bad for all but the valid file."""
        if (folder / "a").read_bytes() != b"1 2 3":
            read(folder)

    monkeypatch.setitem(READERS, "planted", Reader(lambda folder: (folder / "a").write_bytes(b"1 2 3"), reading))
    row = fuzz("planted", 3, 0, tmp_path)
    assert failed(row) == (found is not None)
    if isinstance(found, str):
        assert row[found] == 3
    elif found:
        assert row["others"] == found
    assert (found is not None) == any((tmp_path / "planted").glob("*/input_*/a"))


def test_a_lack_of_memory_is_no_refusal():
    def read(_):
        raise MemoryError

    assert outcome(read, Path()) == "memory"
