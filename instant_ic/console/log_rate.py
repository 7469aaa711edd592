"""Rate limit for log messages that network clients can cause: one a second for each place in the code."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable

NOISY = ("instant_ic.console", "asyncio", "aiohttp.server", "aiohttp.web", "aiohttp.websocket", "aiohttp.internal")
PERIOD_S = 1.0


class LogRate(logging.Filter):
    """Passes one record of each place in the code every ``PERIOD_S``; the next one states how many were dropped.

    Args:
        clock: monotonic time in seconds; tests pass their own.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._clock = clock
        self._last: dict[tuple[str, int], float] = {}
        self._left_out: dict[tuple[str, int], int] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether the record is logged."""
        place, now = (record.pathname, record.lineno), self._clock()
        if now - self._last.get(place, -math.inf) < PERIOD_S:
            self._left_out[place] = self._left_out.get(place, 0) + 1
            return False
        self._last[place] = now
        if left_out := self._left_out.pop(place, 0):
            record.msg, record.args = f"{record.getMessage()} ({left_out} similar messages dropped)", ()
        return True


_FILTER = LogRate()


def limit_logs() -> None:
    """Limit the loggers of the console, asyncio and aiohttp's server. Further calls change nothing."""
    for name in NOISY:
        logging.getLogger(name).addFilter(_FILTER)
