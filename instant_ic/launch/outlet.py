"""Output that never blocks the launcher: calls run on a separate thread, and excess output is dropped.

A terminal stopped with Ctrl-S, a dead ssh connection or a hanging disk must not hold up the process that reads the
nodes' pipes, or the nodes would block at their next line.
"""

from __future__ import annotations

import errno
import os
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from io import FileIO
from pathlib import Path
from typing import Any

from instant_ic.util.private import make_folder, open_file


class Outlet:
    """Runs calls one after another on a thread of its own.

    Args:
        name: of the thread.
        limit: how much may wait, in the unit of ``put``'s ``size``.
    """

    def __init__(self, name: str, limit: int) -> None:
        self.broken: OSError | None = None
        """Set once a call fails because its destination is gone; no further call is run."""
        self._limit = limit
        self._calls: deque[tuple[int, Callable[..., None], tuple[Any, ...]]] = deque()
        self._waiting = 0
        self._closed = False
        self._condition = threading.Condition()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def put(self, function: Callable[..., None], *args: Any, size: int = 1, always: bool = False) -> bool:
        """Queue a call; return False if too much is waiting already.

        Args:
            function: runs on the outlet's thread.
            *args: its arguments.
            size: how much it adds to what waits.
            always: queue it even then; for the few calls that matter.
        """
        with self._condition:
            if self.broken is not None or (self._waiting + size > self._limit and not always):
                return False
            self._waiting += size
            self._calls.append((size, function, args))
            self._condition.notify()
            return True

    def close(self, timeout_s: float = 2.0) -> bool:
        """Wait up to ``timeout_s`` until all calls have run; return whether the thread has ended."""
        with self._condition:
            self._closed = True
            self._condition.notify()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._calls or self._closed)
                if not self._calls:
                    return
                size, function, args = self._calls.popleft()
            try:
                function(*args)
            except OSError as error:  # the terminal or the reader of a pipe is gone; the nodes continue
                with self._condition:
                    self.broken = error
                    self._calls.clear()
                return
            finally:
                with self._condition:
                    self._waiting -= size


class NodeLog:
    """A node's log file, mode 0600; the previous run's file is kept. Errors are reported once and never raised.

    Args:
        path: the log file.
        report: called with a text when writing fails and when it works again; runs on the writing thread.
        max_bytes: a larger file is renamed to ``.log.1``, and a new one is started.
    """

    def __init__(self, path: Path, report: Callable[[str], None], max_bytes: int = 64 << 20) -> None:
        self.path = path
        self._report = report
        self._max_bytes = max_bytes
        self._file: FileIO | None = None
        self._size = 0
        self._failed = False
        self._rotate()

    def write(self, data: bytes) -> None:
        """Append to the file."""
        try:
            if self._size + len(data) > self._max_bytes:
                self.close()
                self._rotate()
            if self._file is None:
                self._open()
            self._put(data)
        except OSError as error:
            self.close()
            if not self._failed:
                self._report(f"{self.path} cannot be written ({error.strerror}). Free some space; its lines are lost.")
            self._failed = True
            return
        if self._failed:
            self._failed = False
            self._report(f"{self.path} can be written again; lines are missing in it")

    def close(self) -> None:
        """Close the file; a later write opens it again."""
        if self._file is not None:
            file, self._file = self._file, None
            with suppress(OSError):  # write() has already reported a full disk
                file.close()

    def _put(self, data: bytes) -> None:
        assert self._file is not None
        written = self._file.write(data)
        self._size += written or 0
        if written != len(data):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def _open(self) -> None:
        make_folder(self.path.parent, exist_ok=True)
        self._file = os.fdopen(open_file(self.path, os.O_WRONLY | os.O_APPEND | os.O_CREAT), "ab", buffering=0)
        self._size = self.path.stat().st_size

    def _rotate(self) -> None:
        self._size = 0
        try:
            self.path.replace(self.path.with_suffix(".log.1"))
        except FileNotFoundError:
            pass
        except OSError as error:
            self._report(f"{self.path} cannot be renamed ({error.strerror}); new output is appended to it")
