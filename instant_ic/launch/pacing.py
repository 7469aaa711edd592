"""Choice of a simulated stack's pace (:mod:`instant_ic.util.pace`) by the speed and load of the machine."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import psutil

from instant_ic.launch.health import HealthMonitor
from instant_ic.util.pace import SLOWEST_CHOSEN as SLOWEST
from instant_ic.util.pace import PaceFiles, describe

_ENOUGH_PER_S = 50e6
"""Iterations of an empty loop per second on the kind of core that ``_NEEDED_CORES`` counts."""
_NEEDED_CORES = 1.2
"""Number of cores that a whole stack needs in real time while it drives, with some margin."""
_MEASURE_S = 0.03
_PERIOD_S = 0.25


@dataclass(frozen=True)
class PaceSample:
    """State of a stack and its machine at one time.

    Attributes:
        now_s: the machine's steady clock.
        late: largest delay of the simulated devices since the last sample, as a share of the acceptable delay; None if
            no report has arrived since then.
        stale: true while the arbiter waits for a source that was fresh before.
        idle_cores: mean number of unused cores since the last sample.
        stack_cores: mean number of cores that the stack used.
    """

    now_s: float
    late: float | None = None
    stale: bool = False
    idle_cores: float = 0.0
    stack_cores: float = 1.0


class PaceChooser:
    """Control of the pace: it falls at once when the stack is late, and rises in small steps while it is punctual.

    After a fall the pace is held. Each fall that follows soon after a rise doubles the next hold, so that a constant
    load leads to a constant pace.
    """

    STEP = 0.05
    """Largest rise."""
    RISE_S = 1.0
    """Time between two rises while cores are idle."""
    PROBE_S = 4.0
    """Time between two rises while no core is idle; then only a trial shows whether the stack stays punctual."""
    PUNCTUAL = 0.5
    """Largest share of the acceptable delay at which the pace may rise."""
    SILENCE_S = 1.0
    """Longest time without a report, in the stack's seconds, for which the stack counts as punctual."""
    HOLD_S, LONGEST_HOLD_S = 3.0, 120.0
    AGAIN_S = 30.0
    """A fall within this time plus twice the last hold means that the last rise was too much."""
    OTHERS_CORES = 0.5
    """If other processes use this many cores less than at the fall, the cause of the fall is gone."""
    FAULT_S = 3.0
    """A source that is stale for longer has a fault that a lower pace does not cure."""
    BUSY_CORES = 0.3
    """With more idle cores than this, a stale source is not caused by the machine's load."""

    def __init__(self, pace: float) -> None:
        self.pace = min(1.0, max(SLOWEST, pace))
        self._hold_s = 0.0
        self._fell_s = self._changed_s = -math.inf
        self._punctual_s: float | None = None  # time since which the stack has been punctual
        self._heard_s = -math.inf
        self._available_cores = math.inf  # idle cores and those of the stack at the last fall
        self._fresh_s = -math.inf  # last time at which no source was stale

    def step(self, sample: PaceSample) -> float:
        now_s = sample.now_s
        if not sample.stale:
            self._fresh_s = now_s
        machine = sample.stale and sample.idle_cores < self.BUSY_CORES and now_s - self._fresh_s < self.FAULT_S
        late = max(sample.late or 0.0, 1.4 if machine else 0.0)
        if sample.late is not None:
            self._heard_s = now_s
        if late > self.PUNCTUAL or now_s - self._heard_s > self.SILENCE_S / self.pace:
            self._punctual_s = None
        elif self._punctual_s is None:
            self._punctual_s = now_s
        if late > 1.0:
            self._fall(sample, late)
        elif self._punctual_s is not None:
            self._rise(sample, self._punctual_s)
        return self.pace

    def _fall(self, sample: PaceSample, late: float) -> None:
        now_s = sample.now_s
        # The effect of a fall shows only in the next images, and a slower pace delays these.
        if self.pace <= SLOWEST or now_s - self._fell_s < 0.25 + 0.4 / self.pace:
            return
        if self._changed_s > self._fell_s or not self._hold_s:  # risen since; else this continues the last fall
            again = now_s - self._fell_s < 2.0 * self._hold_s + self.AGAIN_S
            self._hold_s = min(2.0 * self._hold_s, self.LONGEST_HOLD_S) if again else self.HOLD_S
        self._fell_s = self._changed_s = now_s
        self._available_cores = sample.idle_cores + sample.stack_cores
        self.pace = max(SLOWEST, self.pace * min(0.9, max(0.6, 1.0 / late)))

    def _rise(self, sample: PaceSample, punctual_s: float) -> None:
        now_s = sample.now_s
        if sample.idle_cores + sample.stack_cores > self._available_cores + self.OTHERS_CORES:
            self._hold_s = min(self._hold_s, self.HOLD_S)
        free = self.pace * 0.7 * sample.idle_cores / max(sample.stack_cores, 0.1)  # rise for which idle cores suffice
        wait_s = self.RISE_S if free >= self.STEP else self.PROBE_S
        since_s = max(self._changed_s, punctual_s, self._fell_s + self._hold_s - wait_s)
        if self.pace < 1.0 and now_s - since_s >= wait_s:
            self._changed_s = now_s
            self.pace = min(1.0, self.pace + self.STEP)


def machine_pace() -> float:
    """Measure the pace that this machine can hold now, by its cores, their speed and their load; takes 30 ms."""
    began_s, count = time.thread_time(), 0
    while (cpu_s := time.thread_time() - began_s) < _MEASURE_S:
        for _ in range(10_000):
            pass
        count += 10_000
    return pace_of(len(os.sched_getaffinity(0)), count / cpu_s, os.getloadavg()[0])


def pace_of(cores: int, loops_per_s: float, load: float) -> float:
    """Return the pace that a stack can hold beside other processes.

    Args:
        cores: number of cores.
        loops_per_s: iterations of an empty loop per second on one core.
        load: mean number of processes that already run.
    """
    share = cores / (1.0 + load / cores)
    return min(1.0, max(SLOWEST, share / _NEEDED_CORES * loops_per_s / _ENOUGH_PER_S))


def idle_cores() -> float:
    """Return the mean number of idle cores since the last call."""
    times = psutil.cpu_times_percent()
    return float(times.idle + times.iowait) / 100.0 * (os.cpu_count() or 1)  # iowait: idle, and waiting for a disk


class Pacing:
    """Adaptation of a running stack's pace, with reports of changes that an operator notices."""

    REPORT_STEP = 0.1
    REPORT_S = 10.0

    def __init__(self, folders: Iterable[Path], report: Callable[[str], None]) -> None:
        self._chooser = PaceChooser(machine_pace())
        self._files = PaceFiles(folders, self._chooser.pace, adapts=True)
        self._report = report
        self._reported = 1.0
        self._sample_s = self._report_s = -math.inf
        self._tell(time.monotonic())

    @property
    def text(self) -> str:
        """The present pace for the operator; empty in real time."""
        return describe(self._files.factor, adapts=True)

    def step(self, stack: HealthMonitor) -> None:
        """Adapt the pace, at most four times a second."""
        now_s = time.monotonic()
        if now_s - self._sample_s < _PERIOD_S:
            return
        self._sample_s = now_s
        pace = self._chooser.step(PaceSample(now_s, *stack.take_late(), idle_cores(), stack.cpu_cores))
        if pace != self._files.factor:
            self._files.change(pace)
        self._tell(now_s)

    def _tell(self, now_s: float) -> None:
        pace = self._files.factor
        noticed = abs(pace - self._reported) >= self.REPORT_STEP or (pace == 1.0) != (self._reported == 1.0)
        if noticed and now_s - self._report_s >= self.REPORT_S:
            self._reported, self._report_s = pace, now_s
            self._report(self.text or "simulation in real time")
