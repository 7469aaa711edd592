"""Calls in several processes; a call that hangs or whose process dies does not end the others.

joblib's ``Parallel`` gives up all calls when one times out or dies. Each process is therefore a loky executor of its
own, with one worker, which can be killed and replaced alone.
"""

from __future__ import annotations

import math
import os
import signal
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeVar

from joblib.externals.loky import ProcessPoolExecutor

T = TypeVar("T")


class LostError(RuntimeError):
    """A call without a result: its process died, or was ended because the call took too long."""


def run_all(
    function: Callable[..., T],
    tasks: Sequence[tuple[Any, ...]],
    jobs: int,
    prepare: Callable[[], None],
    on_result: Callable[[T], None] | None = None,
    timeout_s: float = 7200.0,
    call_timeout_s: float = math.inf,
    on_lost: Callable[[int, LostError], T] | None = None,
) -> list[T]:
    """Call a function for each task's arguments, ``jobs`` at once.

    Args:
        function: function of a module, so that other processes find it.
        tasks: positional arguments of each call.
        jobs: number of processes; one, without ``call_timeout_s``: this process.
        prepare: called first in each process.
        on_result: called with each result as it arrives.
        timeout_s: time limit for all calls.
        call_timeout_s: time limit for one call; its process is then killed.
        on_lost: returns the result of a lost call from the task's number and the error; None: raise.

    Returns:
        Results in the order of completion.

    Raises:
        ValueError: ``jobs`` is less than 1.
        TimeoutError: the calls took longer than ``timeout_s``.
        LostError: a process died or was killed, and there is no ``on_lost``.
    """
    if jobs < 1:
        raise ValueError(f"jobs must be at least 1 (got {jobs})")
    deadline = time.monotonic() + timeout_s
    results: list[T] = []

    def check_time() -> None:
        if time.monotonic() > deadline:
            raise TimeoutError(f"it took longer than {timeout_s:.0f} s; {len(results)} of {len(tasks)} are done")

    def take(result: T) -> None:
        results.append(result)
        if on_result is not None:
            on_result(result)

    if math.isinf(call_timeout_s) and (jobs == 1 or len(tasks) <= 1):
        _run_here(function, tasks, prepare, take, check_time)
        return results
    workers = _Workers(function, tasks, prepare, call_timeout_s)
    try:
        while workers.start(jobs):
            check_time()
            for number, call in workers.ended(deadline):
                lost = call.exception()
                if on_lost is not None and isinstance(lost, LostError):
                    take(on_lost(number, lost))
                else:
                    take(call.result())
    finally:
        workers.kill()
    return results


def _run_here(
    function: Callable[..., T],
    tasks: Sequence[tuple[Any, ...]],
    prepare: Callable[[], None],
    take: Callable[[T], None],
    check_time: Callable[[], None],
) -> None:
    if tasks:
        prepare()
    for task in tasks:
        check_time()
        take(function(*task))


class _Workers:
    """Processes that each run one call at a time."""

    def __init__(
        self,
        function: Callable[..., Any],
        tasks: Sequence[tuple[Any, ...]],
        prepare: Callable[[], None],
        call_timeout_s: float,
    ) -> None:
        warnings.filterwarnings("ignore", message="A worker stopped while")  # loky renews a process that has grown
        self._function, self._tasks, self._prepare, self._call_timeout_s = function, tasks, prepare, call_timeout_s
        self._waiting = deque(range(len(tasks)))
        self._all: list[ProcessPoolExecutor] = []
        self._idle: list[ProcessPoolExecutor] = []
        self._busy: dict[Future[Any], tuple[int, ProcessPoolExecutor, float]] = {}
        """Task's number, process, and time at which the call must be done."""

    def start(self, jobs: int) -> bool:
        """Start waiting calls while fewer than ``jobs`` run; return whether any runs."""
        while self._waiting and len(self._busy) < jobs:
            if not self._idle:
                self._all.append(ProcessPoolExecutor(1, initializer=_prepare, initargs=(self._prepare, os.getpid())))
                self._idle.append(self._all[-1])
            number, executor = self._waiting.popleft(), self._idle.pop()
            call = executor.submit(self._function, *self._tasks[number])
            self._busy[call] = number, executor, time.monotonic() + self._call_timeout_s
        return bool(self._busy)

    def ended(self, deadline: float) -> list[tuple[int, Future[Any]]]:
        """Wait until a call ends, its limit or ``deadline`` is over; return the calls that ended, with their tasks.

        A call whose process died or was killed has a ``LostError``.
        """
        next_s = min(deadline, *(due for _, _, due in self._busy.values())) - time.monotonic()
        wait(self._busy, max(0.0, next_s), FIRST_COMPLETED)
        found = []
        for call, (number, executor, due) in list(self._busy.items()):
            if call.done():
                lost = "its process died (out of memory?)" if isinstance(call.exception(), BrokenProcessPool) else ""
            elif time.monotonic() > due:
                lost = f"it took longer than {self._call_timeout_s:.0f} s and was ended"
            else:
                continue
            del self._busy[call]
            if lost:
                executor.shutdown(kill_workers=True)
                call = Future()
                call.set_exception(LostError(lost))
            else:
                self._idle.append(executor)
            found.append((number, call))
        return found

    def kill(self) -> None:
        """Kill all processes."""
        for executor in self._all:
            executor.shutdown(kill_workers=True)


def _prepare(prepare: Callable[[], None], parent: int) -> None:
    """Prepare a process; it ignores Ctrl-C, which also reaches its parent, and ends when its parent is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, args=(parent,), daemon=True).start()
    prepare()


def _end_with_parent(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)
