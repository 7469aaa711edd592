"""Calls in several processes, none of which is left when they end, at whatever stage of its start-up."""

from __future__ import annotations

import contextlib
import math
import multiprocessing
import os
import signal
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any, Self, TypeVar

T = TypeVar("T")

_GONE_S = 30.0
"""A killed process is normally gone at once; a longer wait means that the kernel holds it (a hung file system)."""

_REST_S = 60.0
"""Longest time from the first byte of a result to the last."""


class LostError(RuntimeError):
    """A call without a result: its process died, or was ended because the call took too long."""


class ProcessPool:
    """Processes that each run one call at a time; all are gone when the block is left.

    They are killed: SIGTERM has no effect on a stopped process, or if this program was started with SIGTERM ignored.

    ``prepare`` is called first in each process.

    Raises:
        RuntimeError: at the end of the block, a process is still there ``30 s`` after it was killed.
    """

    def __init__(self, prepare: Callable[[], None]) -> None:
        self._prepare = prepare
        self._processes: list[SpawnProcess] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Kill the processes."""
        self._end(self._processes)

    def start(self) -> Connection:
        """Start a process; send it (function, arguments), and it sends (result, None) or (None, exception)."""
        ours, theirs = multiprocessing.get_context("spawn").Pipe()
        process = SpawnProcess(target=_serve, args=(theirs, self._prepare), name=f"pipe{ours.fileno()}")
        self._processes.append(process)  # first: an interrupt may come as soon as it has started
        process.start()
        theirs.close()  # so that ours ends when the process does
        return ours

    def receive(self, pipe: Connection) -> tuple[Any, Exception | None]:
        """Result of a call, of which the first bytes have arrived.

        Raises:
            LostError: the process died, or the rest did not arrive within ``60 s``.
        """
        began, killer = time.monotonic(), threading.Timer(_REST_S, self._of(pipe).kill)  # its death ends the wait
        killer.start()
        try:
            answer: tuple[Any, Exception | None] = pipe.recv()
        except (OSError, EOFError):
            if time.monotonic() - began < _REST_S:
                raise LostError("its process died (out of memory?)") from None
            raise LostError(f"the rest of its result did not arrive within {_REST_S:g} s") from None
        finally:
            killer.cancel()
        return answer

    def end(self, pipe: Connection) -> None:
        """Kill the process of a pipe."""
        own = self._of(pipe)
        self._processes.remove(own)
        pipe.close()
        self._end([own])

    def _of(self, pipe: Connection) -> SpawnProcess:
        return next(process for process in self._processes if process.name == f"pipe{pipe.fileno()}")

    @staticmethod
    def _end(processes: Sequence[SpawnProcess]) -> None:
        started = [process for process in processes if process.pid is not None]
        for process in started:
            process.kill()
        left = {process.sentinel: process for process in started}
        deadline = time.monotonic() + _GONE_S
        while left:
            for sentinel in wait(list(left), max(0.0, deadline - time.monotonic())):
                del left[sentinel]  # type: ignore[arg-type]
            if left and time.monotonic() > deadline:
                pids = ", ".join(str(process.pid) for process in left.values())
                raise RuntimeError(f"process {pids} was killed but is still there after {_GONE_S:g} s; end it by hand")


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

    With more than one job, or a time limit for each call, the calls run in processes of their own.

    Args:
        function: of a module, so that other processes find it.
        tasks: positional arguments of each call.
        prepare: called first in each process.
        timeout_s: for all calls.
        call_timeout_s: for one call; its process is then killed.
        on_lost: gives the result of a call whose process died or was killed, from the task's number; None: raise.

    Returns:
        Results in the order of completion.

    Raises:
        ValueError: ``jobs`` is less than 1.
        TimeoutError: the calls took longer than ``timeout_s``.
        LostError: a process died or was killed, and there is no ``on_lost``.
    """
    if jobs < 1:
        raise ValueError(f"jobs must be at least 1 (got {jobs})")
    results: list[T] = []
    began = time.monotonic()

    def take(result: T) -> None:
        results.append(result)
        if on_result is not None:
            on_result(result)

    def left_s() -> float:
        left = timeout_s - (time.monotonic() - began)
        if left < 0:
            raise TimeoutError(f"it took longer than {timeout_s:.0f} s; {len(results)} of {len(tasks)} are done")
        return left

    if math.isinf(call_timeout_s) and (jobs == 1 or len(tasks) <= 1):
        if tasks:
            prepare()
        for task in tasks:
            left_s()
            take(function(*task))
        return results
    waiting = list(reversed(range(len(tasks))))
    idle: list[Connection] = []
    busy: dict[Connection, tuple[int, float]] = {}  # task and the time at which it must be done
    with ProcessPool(prepare) as pool:
        while waiting or busy:
            while waiting and len(busy) < jobs:
                pipe, number = idle.pop() if idle else pool.start(), waiting.pop()
                busy[pipe] = number, time.monotonic() + call_timeout_s
                with contextlib.suppress(OSError):  # it has died: reading from it says so
                    pipe.send((function, tasks[number]))
            next_s = min(due for _, due in busy.values()) - time.monotonic()
            ready = wait(list(busy), max(0.0, min(left_s(), next_s)))
            for pipe, (number, due) in list(busy.items()):
                answer: tuple[Any, Exception | None]
                try:
                    if pipe in ready:
                        answer = pool.receive(pipe)
                        idle.append(pipe)
                    elif time.monotonic() > due:
                        raise LostError(f"it took longer than {call_timeout_s:.0f} s and was ended")
                    else:
                        continue
                except LostError as lost:
                    pool.end(pipe)
                    if on_lost is None:
                        raise LostError(f"task {number}: {lost}; try --jobs 1") from None
                    answer = on_lost(number, lost), None
                del busy[pipe]
                result, error = answer
                if error is not None:
                    raise error
                take(result)
    return results


def _serve(pipe: Connection, prepare: Callable[[], None]) -> None:
    """Run the calls that come over a pipe, until the parent ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes: the collecting one stops the others
    threading.Thread(target=_end_with_parent, daemon=True).start()
    prepare()
    while True:
        function, arguments = pipe.recv()
        answer: tuple[Any, Exception | None]
        try:
            answer = function(*arguments), None
        except Exception as error:  # noqa: BLE001 - the parent raises it again
            error.add_note(traceback.format_exc())
            answer = None, error
        pipe.send(answer)


def _end_with_parent() -> None:
    """Exit when the parent dies, because a killed parent cannot stop its children."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
