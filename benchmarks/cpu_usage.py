"""CPU that each process of a running stack uses per second of the stack's time, compared with this machine's speed."""

from __future__ import annotations

import statistics
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import psutil

from instant_ic.experiments.stack import processes_of
from instant_ic.util.closing import Closing

_LOOPS = 100_000
_PERIOD_S = 0.5


class ReferenceLoop(Closing):
    """CPU time of an empty loop in Python, timed twice a second: the speed of this machine under the same load."""

    def __init__(self) -> None:
        self._samples: list[float] = []
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="reference loop", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while True:
            began = time.thread_time()
            for _ in range(_LOOPS):
                pass
            self._samples.append(time.thread_time() - began)
            if self._ended.wait(_PERIOD_S):
                return

    def close(self) -> None:
        self._ended.set()
        self._thread.join()

    @property
    def million_ms(self) -> float:
        """Milliseconds of CPU for one million iterations: the median of the samples."""
        return 1e3 * statistics.median(self._samples) * 1e6 / _LOOPS


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
