"""Slow work beside a node's thread."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from instant_ic.bus.callbacks import Callbacks


class Worker:
    """Runs slow work in a thread beside the node's, on the newest item only.

    Args:
        callbacks: those of the node.
        work: called with each item, on the worker's thread.
        on_result: called with each result, on the node's thread.
        inline: work in :meth:`submit` instead of in a thread (lockstep).

    Attributes:
        busy: an item is waiting or being worked on.
        skipped: items that a newer one has replaced.
    """

    def __init__(
        self,
        callbacks: Callbacks,
        work: Callable[[Any], Any],
        on_result: Callable[[Any], None] | None = None,
        inline: bool = False,
    ) -> None:
        self._callbacks = callbacks
        self._work = work
        self._on_result = on_result
        self._condition = threading.Condition()
        self._item: list[Any] = []
        self._stopped = False
        self.busy = False
        self.skipped = 0
        self._thread: threading.Thread | None = None
        if not inline:
            self._thread = threading.Thread(target=self._run, name=getattr(work, "__name__", "work"), daemon=True)
            self._thread.start()

    def submit(self, item: Any) -> None:
        """Hand over an item. It replaces an item that is still waiting, which is counted in ``skipped``."""
        if self._thread is None:
            self._do(item)
            return
        with self._condition:
            self.skipped += len(self._item)
            self._item, self.busy = [item], True
            self._condition.notify()

    def stop(self, timeout_s: float = 3.0) -> None:
        """End the thread after the current item; waits at most ``timeout_s``."""
        with self._condition:
            self._stopped = True
            self._item = []
            self._condition.notify()
        if self._thread is not None:
            self._thread.join(timeout_s)

    def _run(self) -> None:
        while True:
            with self._condition:
                self.busy = False
                while not self._item and not self._stopped:
                    self._condition.wait()
                if self._stopped:
                    return
                item = self._item.pop()
                self.busy = True
            self._do(item)

    def _do(self, item: Any) -> None:
        try:
            result = self._work(item)
        except Exception as error:  # noqa: BLE001 - a node survives a bad item; the fault is logged with its traceback
            self._callbacks.call_soon(
                self._callbacks.fault, f"background {getattr(self._work, '__name__', 'work')}", error
            )
            return
        if self._on_result is not None:
            self._callbacks.call_soon(self._on_result, result)
