"""Worker thread for a node's slow work."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from instant_ic.bus.callbacks import Callbacks


class Worker:
    """Runs slow work on a thread of its own, for the newest item only.

    Args:
        callbacks: callbacks of the node.
        work: function called with each item, on the worker's thread.
        on_result: function called with each result, on the node's thread.
        inline: run the work in :meth:`submit` instead of on a thread, for lockstep.

    Attributes:
        busy: true while an item is waiting or being worked on.
        skipped: number of items that were replaced by newer ones.
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
        """Hand over an item. It replaces an item that is still waiting, which then counts as skipped."""
        if self._thread is None:
            self._do(item)
            return
        with self._condition:
            self.skipped += len(self._item)
            self._item, self.busy = [item], True
            self._condition.notify()

    def stop(self, timeout_s: float = 3.0) -> None:
        """End the thread after the current item, and wait for it at most ``timeout_s``."""
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
        except Exception as error:  # noqa: BLE001 - a bad item must not end the node; the fault is logged with its traceback
            self._callbacks.call_soon(
                self._callbacks.fault, f"background {getattr(self._work, '__name__', 'work')}", error
            )
            return
        if self._on_result is not None:
            self._callbacks.call_soon(self._on_result, result)
