"""Lock that reserves a run directory for one stack."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path
from types import TracebackType

from instant_ic.bus.registry import open_lock


class StackRunningError(RuntimeError):
    """Another stack uses the run directory; the message says which one and what to do."""


class StackLock:
    """Lock held while a stack runs; the kernel releases it when the launcher dies, however it dies.

    Args:
        run_dir: prepared run directory.
        label: shown to a second stack that tries to start.
    """

    def __init__(self, run_dir: Path, label: str) -> None:
        self.path = run_dir / "launch.lock"
        self._label = label
        self._descriptor = -1

    def __enter__(self) -> StackLock:
        """Take the lock.

        Raises:
            StackRunningError: another stack holds it.
            RegistryError: the lock file does not belong to this user.
        """
        descriptor = open_lock(self.path, create=True)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.read(descriptor, 500).decode(errors="replace").strip() or "unknown"
            os.close(descriptor)
            raise StackRunningError(
                f"a stack already runs in {self.path.parent} ({holder}): stop it, or set INSTANT_IC_RUN_DIR"
            ) from None
        os.ftruncate(descriptor, 0)
        os.write(descriptor, f"pid {os.getpid()}, {self._label}\n".encode())
        self._descriptor = descriptor
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.ftruncate(self._descriptor, 0)
        os.close(self._descriptor)
