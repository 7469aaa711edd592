"""The diagnoses of a node, and the log of their changes."""

from __future__ import annotations

import logging
import time
from typing import Any

from instant_ic.util.safe_text import masked

OK, WARN, ERROR, STALE = 0, 1, 2, 3
"""Levels of a diagnosis, as in diagnostic_msgs/DiagnosticStatus."""

_START_GRACE_S = 15.0  # time after its start for which a node may wait for others without a warning in the log


class Diagnostics:
    """Named states of one node.

    Args:
        log: the node's log.
        lockstep: log each diagnosis at its own level from the start, because no other node is still starting.
    """

    def __init__(self, log: logging.Logger, lockstep: bool) -> None:
        self.present: dict[str, tuple[int, str, dict[str, Any]]] = {}
        """Level, text and values by name."""
        self._log = log
        self._calm_until_s = 0.0 if lockstep else time.monotonic() + _START_GRACE_S
        self._well: set[str] = set()  # diagnoses that have been OK at least once
        self._waiting: set[str] = set()  # diagnoses that have never been OK and are logged as information only

    @property
    def worst(self) -> tuple[int, str, dict[str, Any]]:
        """The diagnosis with the highest level: level, text, values."""
        return max(self.present.values(), default=(OK, "", {}), key=lambda diagnosis: diagnosis[0])

    def set(self, name: str, level: int, text: str, **values: Any) -> None:
        """Set a named diagnosis and log it when its level changes."""
        before = self.present.get(name)
        text = masked(text)
        self.present[name] = (level, text, values)
        if level >= WARN and (before is None or before[0] != level):
            self._log_problem(name, level, text)
        elif level == OK:
            self._well.add(name)
            self._waiting.discard(name)
            if before is not None and before[0] >= WARN:
                self._log.info("%s: %s", name, text or "fine again")

    def fault(self, name: str, error: Exception, count: int) -> None:
        """Log an exception with its traceback and set it as a diagnosis.

        Args:
            name: name of the diagnosis.
            error: the exception.
            count: number of exceptions of the node so far.
        """
        self._log.error("%s: %s: %s", name, type(error).__name__, error, exc_info=error)
        self.present[name] = (ERROR, masked(f"{type(error).__name__}: {error}"), {"faults": count})

    def end_start_grace(self) -> None:
        """After the start-up grace period, log the remaining problems at their own levels."""
        for name in sorted(self._waiting) if time.monotonic() >= self._calm_until_s else ():
            self._waiting.discard(name)
            level, text, _ = self.present[name]
            self._log_problem(name, level, text)

    def _log_problem(self, name: str, level: int, text: str) -> None:
        """Log a problem. One that has never been OK is logged once as information during the start-up grace period."""
        if name not in self._well and time.monotonic() < self._calm_until_s:
            if name not in self._waiting:
                self._waiting.add(name)
                self._log.info("%s: %s", name, text)
            return
        self._log.log(logging.WARNING if level == WARN else logging.ERROR, "%s: %s", name, text)
