"""A run directory is locked against a second stack."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path
from types import TracebackType

from instant_ic.bus.registry import open_lock


class StackRunningError(RuntimeError):
    """Another stack has the run directory; the message says which and what to do."""


class StackLock:
    """Held while a stack runs; the kernel lets go of it when the launcher dies, however it dies.

    Args:
        run_dir: prepared run directory.
        label: told to whoever comes second.
    """

    def __init__(self, run_dir: Path, label: str) -> None:
        self.path = run_dir / "launch.lock"
        self._label = label
        self._descriptor = -1

    def __enter__(self) -> StackLock:
        """Takes the lock.

        Raises:
            StackRunningError: another stack has it.
            RegistryError: it is no file of this user.
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
        """Lets go of the lock."""
        os.ftruncate(self._descriptor, 0)
        os.close(self._descriptor)
