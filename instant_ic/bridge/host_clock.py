"""How far another host's clock is from ours: the exchange of NTP (RFC 5905), the shortest round trip wins."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass


@dataclass(frozen=True)
class ClockSample:
    """One exchange; nanoseconds.

    Attributes:
        offset_ns: the other's clock minus ours.
        rtt_ns: time on the way there and back, without the other's time to answer.
        at_ns: our clock when it ended.
    """

    offset_ns: int
    rtt_ns: int
    at_ns: int


class ClockFilter:
    """Offset of a clock out of exchanges of time stamps.

    Of the exchanges of the last ``window_s`` the one with the shortest round trip counts: it waited least in queues,
    and its offset is wrong by half its round trip at most. Both clocks must be of the kind that never steps
    (``CLOCK_MONOTONIC``).

    Args:
        window_s: long enough to meet a quiet moment, short enough that quartz drift (50 ppm) does not matter.
    """

    def __init__(self, window_s: float = 10.0) -> None:
        self.window_ns = int(window_s * 1e9)
        self._samples: deque[ClockSample] = deque(maxlen=400)

    def add(self, sent_ns: int, arrived_ns: int, answered_ns: int, returned_ns: int) -> ClockSample | None:
        """Takes one exchange; None if its stamps cannot be true.

        Args:
            sent_ns, returned_ns: our clock at both ends of it.
            arrived_ns, answered_ns: the other's clock in between.
        """
        rtt = (returned_ns - sent_ns) - (answered_ns - arrived_ns)
        if rtt < 0 or answered_ns < arrived_ns or returned_ns < sent_ns:
            return None
        sample = ClockSample(((arrived_ns - sent_ns) + (answered_ns - returned_ns)) // 2, rtt, returned_ns)
        self._samples.append(sample)
        while self._samples[0].at_ns < returned_ns - self.window_ns:
            self._samples.popleft()
        return sample

    @property
    def ready(self) -> bool:
        """Whether there is an estimate."""
        return bool(self._samples)

    @property
    def best(self) -> ClockSample:
        """The exchange that counts.

        Raises:
            ValueError: there was none yet.
        """
        if not self._samples:
            raise ValueError("no exchange of time stamps yet")
        return min(self._samples, key=lambda sample: sample.rtt_ns)

    @property
    def offset_ns(self) -> int:
        """The other's clock minus ours."""
        return self.best.offset_ns

    @property
    def rtt_ns(self) -> int:
        """Round trip of the newest exchange."""
        return self._samples[-1].rtt_ns if self._samples else 0

    @property
    def min_rtt_ns(self) -> int:
        """Shortest round trip of the window."""
        return self.best.rtt_ns

    @property
    def jitter_ns(self) -> float:
        """Root mean square of the round trips over the shortest one (as RFC 5905 does with offsets)."""
        if not self._samples:
            return 0.0
        least = self.min_rtt_ns
        return math.sqrt(sum((s.rtt_ns - least) ** 2 for s in self._samples) / len(self._samples))
