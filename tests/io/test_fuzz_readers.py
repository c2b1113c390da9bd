"""A short run of benchmarks/fuzz_readers.py: every reader, some dozens of damaged files."""

import sys
import tempfile
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))
from fuzz_files import READERS  # noqa: E402
from fuzz_readers import Fuzzed, outcome  # noqa: E402

sys.path.remove(str(BENCHMARKS))
INPUTS, OF_LOGS = 24, 200
LOGS = "trajectory", "headset", "x_imu", "watch_calibration", "tum", "euroc"


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", READERS)
def test_damaged_files_are_read_or_refused(name):
    with tempfile.TemporaryDirectory() as folder:
        fuzzed = Fuzzed(name, 0, Path(folder))
        assert outcome(fuzzed.reader.read, fuzzed.folder) == "fine"
        found = {number: fuzzed.run(number) for number in range(OF_LOGS if name.startswith(LOGS) else INPUTS)}
    assert {number: one for number, one in found.items() if one not in ("fine", "refused")} == {}


def test_every_module_that_reads_is_in_the_table():
    source = Path(__file__).parents[2] / "src/wearcap/io"
    table = (BENCHMARKS / "fuzz_files.py").read_text()
    reading = {path.stem for path in source.glob("*.py") if "\ndef read_" in path.read_text()}
    assert {module for module in reading if f"{module}.read_" not in table} <= {"aria_vrs", "bounded"}


def test_failures_are_distinguished():
    def slowly(_):
        raise MemoryError

    def wrongly(_):
        raise KeyError("a")

    assert outcome(slowly, Path()) == "memory"
    assert outcome(wrongly, Path()).startswith("KeyError")
