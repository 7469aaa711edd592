"""Calls in several processes; a call that hangs or whose process dies does not end the others.

joblib's ``Parallel`` gives up all calls when one times out or dies. Here each of ``jobs`` threads has a loky executor
of its own, whose one process is killed and replaced alone.
"""

from __future__ import annotations

import os
import queue
import signal
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from joblib.externals.loky import ProcessPoolExecutor


class LostError(RuntimeError):
    """A call without a result: its process died, or was ended because the call took too long.

    ``number`` is that of the call's task.
    """

    number = -1


def run_all(
    function: Callable[..., Any],
    tasks: Sequence[tuple[Any, ...]],
    jobs: int,
    prepare: Callable[[], None],
    timeout_s: float = 7200.0,
    call_timeout_s: float | None = None,
) -> Iterator[Any]:
    """Call a function for each task's arguments, ``jobs`` at once; yield the results in the order of completion.

    Args:
        function: function of a module, so that other processes find it.
        tasks: positional arguments of each call.
        jobs: number of processes; one, without ``call_timeout_s``: this process.
        prepare: called first in each process.
        timeout_s: time limit for all calls.
        call_timeout_s: time limit for one call, whose process is then killed. With this limit, a lost call yields its
            error as its result.

    Raises:
        ValueError: ``jobs`` is less than 1.
        TimeoutError: the calls took longer than ``timeout_s``.
        LostError: a process died, and ``call_timeout_s`` is None.
    """
    if jobs < 1:
        raise ValueError(f"jobs must be at least 1 (got {jobs})")
    deadline, late = (
        time.monotonic() + timeout_s,
        f"the time limit of {timeout_s:.0f} s has passed; {{}} of {len(tasks)} are done",
    )
    if call_timeout_s is None and (jobs == 1 or len(tasks) <= 1):
        if tasks:
            prepare()
        for number, task in enumerate(tasks):
            if time.monotonic() > deadline:
                raise TimeoutError(late.format(number))
            yield function(*task)
        return
    waiting, ended = deque(enumerate(tasks)), queue.SimpleQueue[tuple[Any, BaseException | None]]()
    workers = [_Worker(function, waiting, ended, prepare, call_timeout_s) for _ in range(min(jobs, len(tasks)))]
    try:
        for done in range(len(tasks)):
            try:
                result, error = ended.get(timeout=max(0.0, deadline - time.monotonic()))
            except queue.Empty:
                raise TimeoutError(late.format(done)) from None
            if error is not None and (call_timeout_s is None or not isinstance(error, LostError)):
                raise error
            yield result if error is None else error
    finally:
        for worker in workers:
            worker.kill()


class _Worker(threading.Thread):
    """Takes tasks one by one to a process of its own, which is killed and replaced if a call is lost."""

    def __init__(
        self,
        function: Callable[..., Any],
        waiting: deque[tuple[int, tuple[Any, ...]]],
        ended: queue.SimpleQueue[tuple[Any, BaseException | None]],
        prepare: Callable[[], None],
        call_timeout_s: float | None,
    ) -> None:
        super().__init__(daemon=True)
        warnings.filterwarnings("ignore", message="A worker stopped while")  # loky renews a process that has grown
        self._function, self._waiting, self._ended = function, waiting, ended
        self._prepare, self._call_timeout_s = prepare, call_timeout_s
        self._executor: ProcessPoolExecutor | None = None
        self._lock = threading.Lock()
        self.start()

    def run(self) -> None:
        while True:
            with self._lock:
                try:
                    number, task = self._waiting.popleft()
                except IndexError:
                    return
                if self._executor is None:
                    self._executor = ProcessPoolExecutor(1, initializer=_prepare, initargs=(self._prepare, os.getpid()))
                call = self._executor.submit(self._function, *task)
            wait([call], self._call_timeout_s)
            error = (
                call.exception()
                if call.done()
                else LostError(f"it took longer than {self._call_timeout_s:.0f} s and was ended")
            )
            if isinstance(error, BrokenProcessPool):
                error = LostError("its process died (out of memory?)")
            if isinstance(error, LostError):
                error.number = number
                with self._lock:
                    self._executor.shutdown(kill_workers=True)
                    self._executor = None
            self._ended.put((None if error else call.result(), error))

    def kill(self) -> None:
        """Kill the process, and take no more tasks."""
        with self._lock:
            self._waiting.clear()
            if self._executor is not None:
                self._executor.shutdown(kill_workers=True)


def _prepare(prepare: Callable[[], None], parent: int) -> None:
    """Prepare a process: it ignores Ctrl-C, which its parent handles, and ends when its parent is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, args=(parent,), daemon=True).start()
    prepare()


def _end_with_parent(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)
