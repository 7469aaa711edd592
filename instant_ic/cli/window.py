"""Statistics over the newest values, for ``ic topic hz``, ``bw`` and ``delay``."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from statistics import fmean, pstdev


class Window:
    """Sliding window over the newest values."""

    def __init__(self, size: int) -> None:
        self.values: deque[float] = deque(maxlen=size)
        self.count = 0

    def add(self, value: float) -> None:
        """Add a value; drop the oldest when the window is full."""
        self.values.append(value)
        self.count += 1

    def spread(self) -> str:
        """Text with minimum, maximum and standard deviation of values in seconds, and their number."""
        values = self.values
        return f"min: {min(values):.4f}s max: {max(values):.4f}s std dev: {pstdev(values):.5f}s window: {len(values)}"


class Rate:
    """Rate of a topic from the arrival times of its messages."""

    def __init__(self, size: int) -> None:
        self.gaps = Window(size)
        self.count = 0
        self._last_ns: int | None = None

    def add(self, received_ns: int) -> None:
        """Add the arrival of one message; restart the count when time jumps back (a bag that loops)."""
        self.count += 1
        if self._last_ns is not None and received_ns < self._last_ns:
            self.gaps.values.clear()
        elif self._last_ns is not None:
            self.gaps.add((received_ns - self._last_ns) / 1e9)
        self._last_ns = received_ns

    def line(self, lost_by: Mapping[str, int]) -> str:
        if self.gaps.values:
            mean = fmean(self.gaps.values)
            rate = f"average rate: {1 / mean if mean > 0 else float('inf'):.3f}  {self.gaps.spread()}"
        else:
            rate = "no rate yet: only one message" if self.count else "no message yet"
        return f"{rate}  lost: {losses(lost_by)}"


def losses(lost_by: Mapping[str, int]) -> str:
    """Number of lost messages, by publisher: ``3 (vlp16_driver 3)``."""
    by = ", ".join(f"{publisher} {count}" for publisher, count in sorted(lost_by.items()))
    return f"{sum(lost_by.values())} ({by})" if by else "0"


def size_words(size: float) -> str:
    """Number of bytes with a unit: ``1.25 MB``."""
    for factor, unit in ((1e9, "GB"), (1e6, "MB"), (1e3, "kB")):
        if size >= factor:
            return f"{size / factor:.2f} {unit}"
    return f"{size:.0f} B"
