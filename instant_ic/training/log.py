"""Training log: lines or a progress bar, a CSV file, and TensorBoard if it is installed."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

COLUMNS = (
    "step", "minutes", "loss", "learning_rate", "panoramas_per_s", "mre", "mae_m", "rmse_m", "delta1", "delta2",
    "delta3", "scale_error_median",
)  # fmt: skip


class TrainingLog:
    """Rows of numbers by step, beside the checkpoint: ``NAME.csv`` and the folder ``NAME.tensorboard``.

    ``step`` is the first of this run; rows after the last checkpoint of an interrupted run are dropped. ``report``
    receives human-readable lines.
    """

    def __init__(self, checkpoint: Path, step: int, report: Callable[[str], None]) -> None:
        self.path = checkpoint.with_suffix(".csv")
        self._report = report
        self.path.parent.mkdir(parents=True, exist_ok=True)
        kept: list[dict[str, str]] = []
        if step and self.path.is_file():
            with self.path.open(newline="", encoding="utf-8") as file:
                kept = [row for row in csv.DictReader(file) if int(row["step"]) <= step]
        self._file = self.path.open("w", newline="", encoding="utf-8")
        self._rows = csv.DictWriter(self._file, COLUMNS, restval="", extrasaction="ignore")
        self._rows.writeheader()
        self._rows.writerows(kept)
        self._board = _tensorboard(checkpoint.with_suffix(".tensorboard"), step)

    def row(self, values: dict[str, Any], line: str) -> None:
        """Write one row (keys of :data:`COLUMNS`; others are ignored) and report ``line``."""
        self._rows.writerow(values)
        self._file.flush()
        if self._board is not None:
            for key in COLUMNS[2:]:
                if values.get(key) is not None:
                    self._board.add_scalar(key, values[key], values["step"])
            self._board.flush()
        self._report(line)

    def close(self) -> None:
        self._file.close()
        if self._board is not None:
            self._board.close()


def _tensorboard(folder: Path, step: int) -> Any:
    """Create a writer; None if the package ``tensorboard`` is not installed."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ModuleNotFoundError:
        return None
    return SummaryWriter(str(folder), purge_step=step or None)
