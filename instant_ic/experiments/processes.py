"""A process pool that leaves no process behind when its block ends, at any stage of start-up."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing.connection import wait
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any

_GONE_S = 30.0
"""A killed process is normally gone at once; a longer wait means that the kernel holds it (a hung file system)."""


class _Spawned(SpawnContext):
    """Spawns processes and keeps track of each, including one whose start was interrupted."""

    def __init__(self) -> None:
        super().__init__()
        self.processes: list[SpawnProcess] = []

    def Process(self, *args: Any, **options: Any) -> SpawnProcess:  # type: ignore[override]
        self.processes.append(SpawnProcess(*args, **options))
        return self.processes[-1]


@contextlib.contextmanager
def process_pool(count: int, prepare: Callable[[], None]) -> Iterator[ProcessPoolExecutor]:
    """Yield a pool of ``count`` processes that call ``prepare`` first; all are gone when the block is left.

    The processes are killed: SIGTERM has no effect on a stopped process, or if this program was started with SIGTERM
    ignored. The sentinel shows that a process is gone: the pool's own thread may have collected the exit status first,
    and ``exitcode`` is then None for a moment.

    Raises:
        RuntimeError: at the end of the block, a process is still there ``30 s`` after it was killed.
    """
    context = _Spawned()
    pool = ProcessPoolExecutor(count, mp_context=context, initializer=_begin, initargs=(prepare,))
    # If this end stayed open, the pool's thread would wait for ever for the rest of a killed process's partial result.
    results = pool._result_queue._writer  # type: ignore[attr-defined]
    try:
        yield pool
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        started = [process for process in context.processes if process.pid is not None]
        for process in started:
            process.kill()
        results.close()
        _wait_until_gone(started)


def _wait_until_gone(processes: list[SpawnProcess]) -> None:
    left = {process.sentinel: process for process in processes}
    deadline = time.monotonic() + _GONE_S
    while left:
        for sentinel in wait(list(left), max(0.0, deadline - time.monotonic())):
            del left[sentinel]  # type: ignore[arg-type]
        if left and time.monotonic() > deadline:
            pids = ", ".join(str(process.pid) for process in left.values())
            raise RuntimeError(f"process {pids} was killed but is still there after {_GONE_S:g} s; end it by hand")


def _begin(prepare: Callable[[], None]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes: the collecting one stops the others
    threading.Thread(target=_end_with_parent, daemon=True).start()
    prepare()


def _end_with_parent() -> None:
    """Exit when the parent dies, because a killed parent cannot stop its children."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
