"""Timers of a node, ordered by the time at which they are due."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass


@dataclass(eq=False)
class Timer:
    """A callback that runs once per period."""

    period_ns: int
    due_ns: int
    callback: Callable[[], None]
    cancelled: bool = False

    def cancel(self) -> None:
        """Stop the timer for good."""
        self.cancelled = True


class Timers:
    """The timers of one node. The caller supplies the time."""

    def __init__(self) -> None:
        self._heap: list[tuple[int, int, Timer]] = []
        self._orders = itertools.count()

    def add(self, timer: Timer) -> None:
        """Add a timer, or one that is due again."""
        heapq.heappush(self._heap, (timer.due_ns, next(self._orders), timer))

    def next_ns(self) -> int | None:
        """Return the time at which the next timer is due; None without a timer."""
        while self._heap and self._heap[0][2].cancelled:
            heapq.heappop(self._heap)
        return self._heap[0][0] if self._heap else None

    def due(self, now_ns: int) -> Iterator[Timer]:
        """Yield the timers that are due, each once.

        Timers stay on a fixed grid of periods, so they do not drift, and a pause does not cause a burst.
        """
        while (at_ns := self.next_ns()) is not None and at_ns <= now_ns:
            timer = heapq.heappop(self._heap)[2]
            timer.due_ns += timer.period_ns * ((now_ns - timer.due_ns) // timer.period_ns + 1)
            self.add(timer)
            yield timer

    def restart(self, now_ns: int) -> None:
        """Start every period again from now."""
        timers = [timer for _, _, timer in sorted(self._heap, key=lambda entry: entry[1])]
        self._heap.clear()
        for timer in timers:
            timer.due_ns = now_ns + timer.period_ns
            self.add(timer)
