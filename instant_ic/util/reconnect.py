"""Waits between attempts to connect to a device."""

from __future__ import annotations

STARTS_S = 15.0
"""Time from the first failure during which waits do not grow, because the device may still be starting."""


class Backoff:
    """Wait between attempts that doubles with every failure, except while the device may still be starting.

    Args:
        min_s: first wait in seconds.
        max_s: longest wait in seconds.
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
            now_s: time now on any steady clock, in seconds.
        """
        if self._began_s is None:
            self._began_s = now_s
        wait_s = self.wait_s
        if self._connected or now_s - self._began_s >= STARTS_S:
            self.wait_s = min(2.0 * wait_s, self._max_s)
        return wait_s

    def succeed(self) -> None:
        """Start again with the shortest wait, because the connection works."""
        self._connected = True
        self.wait_s = self._min_s
