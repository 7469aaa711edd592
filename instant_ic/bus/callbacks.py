"""Execution of a node's callbacks, one after another. A callback that raises does not end the node."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Any

from instant_ic.bus.diagnostics import ERROR, OK, Diagnostics
from instant_ic.bus.flow_report import RECENT_S


class NodeError(RuntimeError):
    """A fault that its message explains in full. Raised in ``setup``, it ends the process without a traceback."""


class Callbacks:
    """Callbacks of one node.

    Args:
        diagnostics: takes the diagnoses of exceptions.
        wake: function that ends the node's wait for messages.
        lockstep: raise an exception again after it has been reported.

    Attributes:
        soon: functions passed to :meth:`call_soon` that have not run yet, with their arguments.
    """

    def __init__(self, diagnostics: Diagnostics, wake: Callable[[], None], lockstep: bool) -> None:
        self._diagnostics = diagnostics
        self._wake = wake
        self._lockstep = lockstep
        self.soon: deque[tuple[Callable[..., None], tuple[Any, ...]]] = deque()
        self._failed_at: dict[str, float] = {}  # callback or timer -> monotonic time of its newest exception
        self._running: tuple[str, float] | None = None
        self._faults = 0

    def call_soon(self, function: Callable[..., None], *args: Any) -> None:
        """Run a function on the node's thread. Any thread may call this."""
        self.soon.append((function, args))
        self._wake()

    def run_soon(self) -> bool:
        """Run the functions passed to :meth:`call_soon`. Return whether there were any."""
        ran = False
        while self.soon:
            function, args = self.soon.popleft()
            label = getattr(function, "__qualname__", "callback")
            self.run(label, function, *args)
            # The function runs only once, so a later success under its label must not clear the diagnosis.
            self._failed_at.pop(label, None)
            ran = True
        return ran

    def run(self, what: str, function: Callable[..., None], *args: Any) -> None:
        """Run a function. An exception becomes the diagnosis ``what``, which clears after some time without one."""
        self._running = (what, started_s := time.monotonic())
        try:
            function(*args)
            if what in self._failed_at and started_s > self._failed_at[what] + RECENT_S:
                del self._failed_at[what]
                self._diagnostics.set(what, OK, f"no exception in the last {RECENT_S:g} s", faults=self._faults)
        except NodeError as error:
            self._faults += 1
            self._failed_at[what] = time.monotonic()
            self._diagnostics.set(what, ERROR, str(error))
        except Exception as error:  # noqa: BLE001 - one bad message must not end a node that moves a robot
            self.fault(what, error)
        finally:
            self._running = None

    def run_setup(self, setup: Callable[[], None]) -> None:
        """Run a node's ``setup`` and pass its exceptions on."""
        self._running = ("setup", time.monotonic())
        setup()
        self._running = None

    def fault(self, what: str, error: Exception) -> None:
        """Log an exception with its traceback, and count it."""
        self._faults += 1
        self._failed_at[what] = time.monotonic()
        self._diagnostics.fault(what, error, self._faults)
        if self._lockstep:
            raise error

    def activity(self) -> tuple[str, float]:
        """Return the running callback and its running time in seconds, or ("", 0) if the node is idle."""
        running = self._running
        return ("", 0.0) if running is None else (running[0], time.monotonic() - running[1])
