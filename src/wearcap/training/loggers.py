"""What a run writes about itself while it trains."""

import csv
from pathlib import Path

from lightning.pytorch.loggers import CSVLogger


class RunCSVLogger(CSVLogger):
    """`metrics.csv` of a run. A resumed run goes on with the rows before its first step, which Lightning would delete."""

    def __init__(self, save_dir: str, resume: str | None = None, flush_logs_every_n_steps: int = 100):
        super().__init__(save_dir, name="", version="", flush_logs_every_n_steps=flush_logs_every_n_steps)
        file = Path(self.log_dir) / "metrics.csv"
        self._before: list[dict[str, str]] = []
        if resume is not None and file.is_file():
            with file.open(newline="") as lines:
                self._before = list(csv.DictReader(lines))

    def save(self) -> None:
        """Write the rows logged since the last time."""
        if self._before and (new := self.experiment.metrics):
            first = min(row["step"] for row in new)
            kept = [row for row in self._before if int(row["step"]) < first]
            self.experiment.metrics, self._before = kept + new, []
        super().save()
