"""A process pool that leaves no process behind when its block ends, at any stage of start-up."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import wait
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any, TypeVar

T = TypeVar("T")

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


def run_all(
    function: Callable[..., T],
    tasks: Sequence[tuple[Any, ...]],
    jobs: int,
    prepare: Callable[[], None],
    on_result: Callable[[T], None] | None = None,
    timeout_s: float = 7200.0,
) -> list[T]:
    """Call a function for each task's arguments, ``jobs`` at once; with more than one job, each in its own process.

    Args:
        function: of a module, so that other processes find it.
        tasks: positional arguments of each call.
        jobs: calls in parallel.
        prepare: called first in each process.
        on_result: called with each result as it arrives.
        timeout_s: for all calls.

    Returns:
        Results in the order of completion.

    Raises:
        ValueError: ``jobs`` is less than 1.
        TimeoutError: the calls took longer than ``timeout_s``.
        RuntimeError: a process died.
    """
    if jobs < 1:
        raise ValueError(f"jobs must be at least 1 (got {jobs})")
    results: list[T] = []

    def take(result: T) -> None:
        results.append(result)
        if on_result is not None:
            on_result(result)

    def late() -> TimeoutError:
        return TimeoutError(f"it took longer than {timeout_s:.0f} s; {len(results)} of {len(tasks)} are done")

    if jobs == 1 or len(tasks) <= 1:
        began = time.monotonic()
        if tasks:
            prepare()
        for task in tasks:
            if time.monotonic() - began > timeout_s:
                raise late()
            take(function(*task))
        return results
    with process_pool(min(jobs, len(tasks)), prepare) as pool:
        try:
            futures = [pool.submit(function, *task) for task in tasks]
            for future in as_completed(futures, timeout=timeout_s):
                take(future.result())
        except BrokenProcessPool as error:
            raise RuntimeError("a process died (out of memory?); try --jobs 1") from error
        except TimeoutError as error:
            raise late() from error
    return results


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
