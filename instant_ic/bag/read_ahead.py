"""Reads a bag ahead of the player, so that no message waits for the disk or for decompression."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator

from instant_ic.bag.message import BagMessage
from instant_ic.util.closing import Closing

_MOST_BYTES = 64_000_000


class ReadAhead(Closing):
    """Iterates over messages that a separate thread reads; a context manager.

    Args:
        messages: messages to read; only that thread uses them until :meth:`close`.
        stop: ends the iteration, even while the disk does not respond.
    """

    def __init__(self, messages: Iterator[BagMessage], stop: threading.Event) -> None:
        self._messages = messages
        self._stop = stop
        self._ready: deque[BagMessage] = deque()
        self._bytes = 0
        self._ended = False
        self._closed = False
        self._error: Exception | None = None
        self._condition = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="read ahead", daemon=True)
        self._thread.start()

    def close(self, timeout_s: float = 5.0) -> None:
        """End the thread and drop the buffered messages."""
        with self._condition:
            self._closed = True
            self._condition.notify_all()
        self._thread.join(timeout_s)

    def __iter__(self) -> Iterator[BagMessage]:
        """Yield the messages in order; re-raise errors of the reading thread."""
        while True:
            with self._condition:
                while not self._condition.wait_for(lambda: self._ready or self._ended or self._closed, 0.5):
                    if self._stop.is_set():
                        return
                if not self._ready:
                    if self._error is not None:
                        raise self._error
                    return
                message = self._ready.popleft()
                self._bytes -= len(message.payload)
                self._condition.notify_all()
            yield message

    def _run(self) -> None:
        try:
            for message in self._messages:
                with self._condition:
                    # Wait until a message is taken. In a pause that never happens, and close() ends the wait.
                    self._condition.wait_for(lambda: self._bytes < _MOST_BYTES or self._closed)
                    if self._closed:
                        return
                    self._ready.append(message)
                    self._bytes += len(message.payload)
                    self._condition.notify_all()
        except Exception as error:  # noqa: BLE001 - re-raised to the iterating thread
            self._error = error
        finally:
            with self._condition:
                self._ended = True
                self._condition.notify_all()
