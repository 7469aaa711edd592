"""CPU that each process of a running stack uses per second of the stack's time, compared with this machine's speed."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

from instant_ic.experiments.stack import processes_of

_REFERENCE_LOOPS = 1_000_000


def reference_loop_s() -> float:
    """CPU seconds of one million empty loops in Python: the measure of a machine's speed. The best of five."""
    best = float("inf")
    for _ in range(5):
        began = time.thread_time()
        for _ in range(_REFERENCE_LOOPS):
            pass
        best = min(best, time.thread_time() - began)
    return best


@dataclass(frozen=True)
class Usage:
    """CPU seconds and resident memory of each process of a stack, at one moment of the machine's steady clock.

    Attributes:
        monotonic_s: the moment.
        cpu_s: CPU seconds since the start, user and system, by node name.
        rss_mb: resident memory in megabytes, by node name.
    """

    monotonic_s: float
    cpu_s: dict[str, float]
    rss_mb: dict[str, float]


def usage(run_dir: Path) -> Usage:
    """The usage of all processes that were started with this run directory."""
    import psutil

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
    """CPU of each process between two samples, in percent of one core of a machine that runs at the stack's pace.

    Args:
        before, after: the samples.
        stack_s: seconds of the stack's time between them.
    """
    return {
        name: round(100.0 * (seconds - before.cpu_s.get(name, 0.0)) / stack_s, 1)
        for name, seconds in sorted(after.cpu_s.items())
    }
