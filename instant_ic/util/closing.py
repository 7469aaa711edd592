"""Context managers: objects that close at the end of a block, and signal handlers."""

from __future__ import annotations

import signal
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Self


class Closing(ABC):
    """Base class of objects that close at the end of a ``with`` block, even after an error."""

    @abstractmethod
    def close(self) -> None: ...

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@contextmanager
def on_end_signal(handler: Callable[..., Any]) -> Iterator[None]:
    """Handle SIGINT, SIGTERM and SIGHUP inside the block.

    A command started with ``&`` in a script inherits SIGINT as ignored, but SIGINT is handled here anyway. A SIGHUP
    that ``nohup`` ignores stays ignored. Outside the main thread, where Python has no handlers, nothing is done.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    hangup = () if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN else (signal.SIGHUP,)
    before = [(number, signal.signal(number, handler)) for number in (signal.SIGINT, signal.SIGTERM, *hangup)]
    try:
        yield
    finally:
        for number, earlier in before:
            signal.signal(number, earlier)
