"""Waits between attempts to connect to a device."""

from __future__ import annotations

STARTS_S = 15.0
"""A device that was never connected may still be starting for this long, so the waits do not grow yet."""


class Backoff:
    """A wait that doubles with every failure, from the first one on that is not part of the start.

    Args:
        min_s: first wait.
        max_s: longest wait.
    """

    def __init__(self, min_s: float, max_s: float) -> None:
        self._min_s, self._max_s = min_s, max_s
        self._began_s: float | None = None
        self._connected = False
        self.wait_s = min_s
        """Wait before the next attempt."""

    def fail(self, now_s: float) -> float:
        """Return the wait before the next attempt, and double the one after it.

        Args:
            now_s: any steady clock.
        """
        if self._began_s is None:
            self._began_s = now_s
        wait_s = self.wait_s
        if self._connected or now_s - self._began_s >= STARTS_S:
            self.wait_s = min(2.0 * wait_s, self._max_s)
        return wait_s

    def succeed(self) -> None:
        """Start again with the shortest wait: the connection works."""
        self._connected = True
        self.wait_s = self._min_s
