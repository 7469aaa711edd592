"""CPU that each process of a running stack uses per second of the stack's time, compared with this machine's speed."""

from __future__ import annotations

import contextlib
import statistics
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import psutil

from instant_ic.experiments.stack import processes_of

_LOOPS = 100_000
_REFERENCE_PERIOD_S = 0.5


class ReferenceLoop:
    """CPU time of an empty loop in Python while a stack runs: the speed of this machine under the same load."""

    def __init__(self) -> None:
        self._samples: list[float] = []

    def sample(self) -> None:
        """Time a hundred thousand iterations."""
        began = time.thread_time()
        for _ in range(_LOOPS):
            pass
        self._samples.append(time.thread_time() - began)

    @property
    def million_ms(self) -> float:
        """Milliseconds of CPU for one million iterations: the median of the samples."""
        return 1e3 * statistics.median(self._samples) * 1e6 / _LOOPS


@contextlib.contextmanager
def reference_loop() -> Iterator[ReferenceLoop]:
    """Time the reference loop twice a second on a thread, until the end of the block."""
    loop, ended = ReferenceLoop(), threading.Event()

    def run() -> None:
        loop.sample()
        while not ended.wait(_REFERENCE_PERIOD_S):
            loop.sample()

    thread = threading.Thread(target=run, name="reference loop", daemon=True)
    thread.start()
    try:
        yield loop
    finally:
        ended.set()
        thread.join()


@dataclass(frozen=True)
class Usage:
    """CPU seconds since the start and resident memory by node name, at one moment of the machine's steady clock."""

    monotonic_s: float
    cpu_s: dict[str, float]
    rss_mb: dict[str, float]


def usage(run_dir: Path) -> Usage:
    """Return the usage of all processes that were started with this run directory."""
    cpu_s: dict[str, float] = {}
    rss_mb: dict[str, float] = {}
    now = time.monotonic()
    for process in processes_of(run_dir):
        try:
            line = process.cmdline()
            times, memory = process.cpu_times(), process.memory_info().rss
        except psutil.NoSuchProcess:
            continue
        name = line[line.index("--name") + 1] if "--name" in line else Path(line[-1]).name
        name = "launcher" if "launch" in line else name
        cpu_s[name] = cpu_s.get(name, 0.0) + times.user + times.system
        rss_mb[name] = rss_mb.get(name, 0.0) + memory / 1e6
    return Usage(now, cpu_s, rss_mb)


def cpu_percent(before: Usage, after: Usage, stack_s: float) -> dict[str, float]:
    """Return the CPU of each process between two samples, in percent of one core at the stack's pace.

    Args:
        before: first sample.
        after: second sample.
        stack_s: the stack's time between them, in seconds.
    """
    return {
        name: round(100.0 * (seconds - before.cpu_s.get(name, 0.0)) / stack_s, 1)
        for name, seconds in sorted(after.cpu_s.items())
    }
