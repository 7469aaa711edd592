"""Log file of a node."""

from __future__ import annotations

import errno
import os
import threading
from collections.abc import Callable
from contextlib import suppress
from io import FileIO
from pathlib import Path

from instant_ic.util.private import make_folder, open_file


class NodeLog:
    """A node's log file, mode 0600. The previous run's file is kept. Errors are reported once and never raised.

    Args:
        path: the log file.
        report: function called with a text when writing fails, on the writing thread.
        max_bytes: size above which the file is renamed to ``.log.1`` and a new one is started.
    """

    def __init__(self, path: Path, report: Callable[[str], None], max_bytes: int = 64 << 20) -> None:
        self.path = path
        self._report = report
        self._max_bytes = max_bytes
        self._file: FileIO | None = None
        self._size = 0
        self._failed = False
        # A process that outlives its node may hold the pipe: then the threads of two runs use this log.
        self._lock = threading.RLock()
        self._rotate()

    def write(self, data: bytes) -> None:
        """Append to the file."""
        with self._lock:
            self._write(data)

    def _write(self, data: bytes) -> None:
        try:
            if self._size + len(data) > self._max_bytes:
                self.close()
                self._rotate()
            if self._file is None:
                self._open()
            assert self._file is not None
            self._size += len(data)
            if self._file.write(data) != len(data):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            self._failed = False
        except OSError as error:
            self.close()
            if not self._failed:
                self._report(f"{self.path} cannot be written ({error.strerror}). Lines are lost; free some space.")
            self._failed = True

    def close(self) -> None:
        """Close the file. A later write opens it again."""
        with self._lock:
            if self._file is not None:
                file, self._file = self._file, None
                with suppress(OSError):  # write() has already reported a full disk
                    file.close()

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
