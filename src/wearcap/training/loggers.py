"""Loggers of a training run."""

import csv
import io
import os
from pathlib import Path

from lightning.fabric.loggers.logger import rank_zero_experiment
from lightning.pytorch.loggers import CSVLogger
from lightning.pytorch.loggers.csv_logs import ExperimentWriter

from wearcap.boundary.opening import understood
from wearcap.files import write_text

Row = dict[str, float | str]


class RunCSVLogger(CSVLogger):
    """`metrics.csv` of a run. A resumed run keeps the rows before its first step; one from scratch keeps the old file
    as `metrics.previous.csv`. Lightning's own logger deletes the file before there are new rows."""

    def __init__(self, save_dir: str, resume: str | None = None, flush_logs_every_n_steps: int = 10):
        super().__init__(save_dir, name="", version="", flush_logs_every_n_steps=flush_logs_every_n_steps)
        self._resumed = resume is not None

    @property
    @rank_zero_experiment
    def experiment(self) -> ExperimentWriter:
        if not isinstance(self._experiment, _MetricsFile):
            self._experiment = _MetricsFile(self.log_dir, self._resumed)
        return self._experiment


class _MetricsFile(ExperimentWriter):
    """Appends rows to `metrics.csv`; whatever else has to change in it is written as a new file and renamed."""

    def __init__(self, log_dir: str, resumed: bool):
        super().__init__(log_dir)
        self.path, self._resumed, self._begun = Path(self.metrics_file_path), resumed, False

    def _check_log_dir_exists(self) -> None:
        """Does nothing: an existing file stays until there are rows to write."""

    def save(self) -> None:
        """Write the rows logged since the last time."""
        if not self.metrics:
            return
        new: list[Row] = [dict(row) for row in self.metrics]
        if not self._begun:
            first = min(int(row["step"]) for row in new)
            before = [row for row in read_metrics(self.path) if int(row["step"]) < first]
            if not self._resumed and self.path.is_file():
                os.replace(self.path, self.path.with_name("metrics.previous.csv"))
            rows = [*before, *new] if self._resumed else new
            self._write(rows)
        elif set().union(*new) <= set(self.metrics_keys):
            with open(self.path, "a", newline="", encoding="utf-8") as file:
                file.write(self._lines(new, header=False))
        else:
            self._write([*read_metrics(self.path), *new])
        self._begun, self.metrics = True, []

    def _write(self, rows: list[Row]) -> None:
        self.metrics_keys = sorted(set().union(*rows))
        write_text(self.path, self._lines(rows, header=True))

    def _lines(self, rows: list[Row], header: bool) -> str:
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, self.metrics_keys, lineterminator="\n")
        if header:
            writer.writeheader()
        writer.writerows(rows)
        return text.getvalue()


def read_metrics(path: Path) -> list[Row]:
    """Rows of a `metrics.csv` without empty values and without an incomplete last line; none without a file.

    Raises WearcapError for a file that is no table.
    """
    if not path.is_file():
        return []
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines(keepends=True)
    if lines and not lines[-1].endswith("\n"):
        lines.pop()
    with understood("not a table of metrics", path, errors=csv.Error):
        rows = [{key: value for key, value in row.items() if key and value} for row in csv.DictReader(lines)]
    return [dict(row) for row in rows if str(row.get("step", "")).isdecimal()]
