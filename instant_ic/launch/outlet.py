"""Output that never blocks the launcher.

A terminal stopped with Ctrl-S or a dead ssh connection must not hold up the threads that read the nodes' pipes, or the
nodes would block at their next line.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import Any


class Outlet:
    """Runs calls one after another on a thread of its own.

    Args:
        limit: how many calls may wait before further ones are dropped.
    """

    def __init__(self, limit: int) -> None:
        self.broken: OSError | None = None
        """Set once a call fails because its destination is gone; no further call is run."""
        self._limit = limit
        self._calls: queue.SimpleQueue[tuple[Callable[..., None], tuple[Any, ...]] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="screen", daemon=True)
        self._thread.start()

    def put(self, function: Callable[..., None], *args: Any, always: bool = False) -> bool:
        """Queue a call; return False if too many are waiting already.

        Args:
            function: runs on the outlet's thread.
            *args: its arguments.
            always: queue it even then; for the few calls that matter.
        """
        if self.broken is not None or (self._calls.qsize() >= self._limit and not always):
            return False
        self._calls.put((function, args))
        return True

    def close(self, timeout_s: float = 2.0) -> bool:
        """Wait up to ``timeout_s`` until all calls have run; return whether the thread has ended."""
        self._calls.put(None)
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while (call := self._calls.get()) is not None:
            function, args = call
            try:
                function(*args)
            except OSError as error:  # the terminal or the reader of a pipe is gone; the nodes continue
                self.broken = error
                return
