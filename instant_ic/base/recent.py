"""How often something happened lately."""

from collections import deque


class RecentCount:
    """Events of the last ``window_s`` seconds; the clock is the caller's."""

    def __init__(self, window_s: float) -> None:
        """Nothing has happened yet."""
        self.window_s = window_s
        self._events: deque[tuple[int, int]] = deque()

    def add(self, events: int, now_ns: int) -> None:
        """Note events that happened now; zero is no event."""
        if events > 0:
            self._events.append((now_ns, events))

    def count(self, now_ns: int) -> int:
        """Events of the window that ends now."""
        oldest_ns = now_ns - int(self.window_s * 1e9)
        while self._events and self._events[0][0] <= oldest_ns:
            self._events.popleft()
        return sum(events for _, events in self._events)
