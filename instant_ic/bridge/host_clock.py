"""Estimates another host's clock offset by NTP's exchange (RFC 5905), using the shortest round trip."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass


@dataclass(frozen=True)
class ClockSample:
    """One exchange of time stamps; nanoseconds.

    Attributes:
        offset_ns: the other clock minus ours.
        rtt_ns: round-trip time, without the other host's processing time.
        at_ns: our clock at the end of the exchange.
    """

    offset_ns: int
    rtt_ns: int
    at_ns: int


class ClockFilter:
    """Clock offset from exchanges of time stamps.

    The estimate uses the exchange with the shortest round trip in the last ``window_s``: it waited least in queues, and
    its offset is wrong by at most half its round trip. Neither clock may ever step (``CLOCK_MONOTONIC``).

    Args:
        window_s: long enough to include an idle moment, short enough that quartz drift (50 ppm) does not matter.
    """

    def __init__(self, window_s: float = 10.0) -> None:
        self.window_ns = int(window_s * 1e9)
        self._samples: deque[ClockSample] = deque(maxlen=400)

    def add(self, sent_ns: int, arrived_ns: int, answered_ns: int, returned_ns: int) -> ClockSample | None:
        """Add one exchange; return None if its stamps are inconsistent.

        Args:
            sent_ns: our clock when the request left.
            arrived_ns: the other clock when the request arrived.
            answered_ns: the other clock when the answer left.
            returned_ns: our clock when the answer arrived.
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
        return bool(self._samples)

    @property
    def best(self) -> ClockSample:
        """The exchange with the shortest round trip.

        Raises:
            ValueError: there was no exchange yet.
        """
        if not self._samples:
            raise ValueError("no exchange of time stamps yet")
        return min(self._samples, key=lambda sample: sample.rtt_ns)

    @property
    def offset_ns(self) -> int:
        return self.best.offset_ns

    @property
    def min_rtt_ns(self) -> int:
        """Shortest round trip of the window."""
        return self.best.rtt_ns

    @property
    def jitter_ns(self) -> float:
        """Root mean square of the round trips above the shortest one (RFC 5905 does the same with offsets)."""
        if not self._samples:
            return 0.0
        least = self.min_rtt_ns
        return math.sqrt(sum((s.rtt_ns - least) ** 2 for s in self._samples) / len(self._samples))
