"""Lock that reserves a run directory for one stack."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from instant_ic.bus.registry import open_lock


class StackRunningError(RuntimeError):
    """Another stack uses the run directory; the message names it and says what to do."""


@contextmanager
def stack_lock(run_dir: Path, label: str) -> Iterator[None]:
    """Hold the lock while a stack runs. The kernel releases it when the launcher dies for any reason.

    Args:
        run_dir: the run directory.
        label: name of this stack in the error of a second stack that tries to start.

    Raises:
        StackRunningError: another stack holds the lock.
        RegistryError: the lock file does not belong to this user.
    """
    descriptor = open_lock(run_dir / "launch.lock", create=True)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.read(descriptor, 500).decode(errors="replace").strip() or "unknown"
            raise StackRunningError(
                f"a stack already runs in {run_dir} ({holder}): stop it, or set INSTANT_IC_RUN_DIR"
            ) from None
        os.ftruncate(descriptor, 0)
        os.write(descriptor, f"pid {os.getpid()}, {label}\n".encode())
        try:
            yield
        finally:
            os.ftruncate(descriptor, 0)
    finally:
        os.close(descriptor)
