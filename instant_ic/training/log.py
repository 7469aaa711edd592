"""Training log: lines or a progress bar, and a CSV file."""

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
    """Rows of numbers by step, in ``NAME.csv`` beside the checkpoint.

    ``step`` is the first of this run; rows after the last checkpoint of an interrupted run are dropped. ``report``
    receives human-readable lines.
    """

    def __init__(self, checkpoint: Path, step: int, report: Callable[[str], None]) -> None:
        path = checkpoint.with_suffix(".csv")
        self._report = report
        path.parent.mkdir(parents=True, exist_ok=True)
        kept: list[dict[str, str]] = []
        if step and path.is_file():
            with path.open(newline="", encoding="utf-8") as file:
                kept = [row for row in csv.DictReader(file) if int(row["step"]) <= step]
        self._file = path.open("w", newline="", encoding="utf-8")
        self._rows = csv.DictWriter(self._file, COLUMNS, restval="", extrasaction="ignore")
        self._rows.writeheader()
        self._rows.writerows(kept)

    def row(self, values: dict[str, Any], line: str) -> None:
        """Write one row (keys of :data:`COLUMNS`; others are ignored) and report ``line``."""
        self._rows.writerow(values)
        self._file.flush()
        self._report(line)

    def close(self) -> None:
        self._file.close()
