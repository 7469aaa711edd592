"""Count of recent events."""

from collections import deque


class RecentCount:
    """Counts the events of the last ``window_s`` seconds; the caller supplies the time."""

    def __init__(self, window_s: float) -> None:
        self.window_s = window_s
        self._events: deque[tuple[int, int]] = deque()

    def add(self, events: int, now_ns: int) -> None:
        """Add events at ``now_ns``; zero adds none."""
        if events > 0:
            self._events.append((now_ns, events))

    def count(self, now_ns: int) -> int:
        """Number of events in the window that ends at ``now_ns``."""
        oldest_ns = now_ns - int(self.window_s * 1e9)
        while self._events and self._events[0][0] <= oldest_ns:
            self._events.popleft()
        return sum(events for _, events in self._events)
