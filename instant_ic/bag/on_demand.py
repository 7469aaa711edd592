"""Recordings started and stopped on request, one at a time, in one folder."""

from __future__ import annotations

import logging
import shutil
import threading
import time
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

from instant_ic.bag.message import BagError
from instant_ic.bag.recorder import Recorder, dated
from instant_ic.bag.recorder_thread import on_disk
from instant_ic.bus.registry import NodeInfo, TopicInfo

IDLE, ENDING = "idle", "ending"
log = logging.getLogger(__name__)


class OnDemand:
    """Starts and stops recordings; used from the node's thread.

    Args:
        folder: parent of the bags; each bag is a folder ``rec_DATE_TIME_NAME``.
        begin: creates the recorder of one bag; returns it with a function that ends its subscriptions.
    """

    def __init__(self, folder: Path, begin: Callable[[Path], tuple[Recorder, Callable[[], None]]]) -> None:
        self.folder = folder
        self.error = ""
        """Why the last recording could not be completed; empty when it was."""
        self._begin = begin
        self._recorder: Recorder | None = None
        self._drop: Callable[[], None] = lambda: None
        self._began_s = 0.0
        self._ended_s: float | None = None
        self._last: dict[str, Any] = {}
        self._closing: threading.Thread | None = None

    def start(self, name: str = "") -> Path:
        """Start a bag and return its folder.

        Raises:
            ValueError: a recording runs, or the previous one is not fully written.
            BagError: the bag cannot be created.
        """
        if self._recorder is not None:
            raise ValueError(f"{self._recorder.path} is being {'completed' if self._closing else 'recorded'} already")
        path = dated(self.folder, name, "rec_")
        self._recorder, self._drop = self._begin(path)
        self._began_s, self._ended_s, self.error = time.monotonic(), None, ""
        return path

    def stop(self) -> Path:
        """Stop the recording. Queued messages are written in the background (see :meth:`status`).

        Raises:
            ValueError: no recording runs.
        """
        if self._recorder is None or self._closing is not None:
            raise ValueError("nothing is being recorded")
        self._drop()
        self._ended_s = time.monotonic()
        self._closing = threading.Thread(target=self._close, args=(self._recorder,), name="bag closer", daemon=True)
        self._closing.start()
        return self._recorder.path

    def discover(self, topics: Collection[TopicInfo], nodes: Collection[NodeInfo] = ()) -> None:
        """Subscribe to new topics; see :meth:`Recorder.discover`."""
        if self._recorder is not None and self._closing is None:
            self._recorder.discover(topics, nodes)

    def tick(self) -> None:
        """Run periodic work, as :meth:`Recorder.tick`, and detect when a bag is complete."""
        if self._recorder is None:
            return
        if self._closing is None:
            self._recorder.tick()
        elif not self._closing.is_alive():
            self._last = self._state(self._recorder)
            self._recorder = self._closing = None

    def trouble(self) -> str:
        """Return why the current bag is not being written or the last one is incomplete; empty when all is well."""
        if self._recorder is None or self._closing is not None:
            return self.error
        status = self._recorder.status()
        if status["overflow"]:
            return f"{status['path']}: the disk is too slow; dropped: {sum(status['overflow'].values())} messages"
        return self._recorder.error

    def status(self) -> dict[str, Any]:
        """Return the state of the current bag, otherwise of the last one.

        Keys: ``state`` (``idle``, ``ending`` or the recorder's), ``path``, ``seconds``, ``bytes``, ``messages``,
        ``error``, and ``free_bytes`` of the disk, None where that is unknown.
        """
        status = {"state": IDLE, **self._last} if self._recorder is None else self._state(self._recorder)
        try:
            status["free_bytes"] = shutil.disk_usage(on_disk(self.folder)).free
        except OSError:
            status["free_bytes"] = None
        return status

    def close(self) -> None:
        """Complete the bag and wait for it.

        Raises:
            BagError: the bag could not be written completely.
        """
        if self._recorder is not None and self._closing is None:
            self._drop()
            self._close(self._recorder)
        elif self._closing is not None:
            self._closing.join(30.0)
        if self.error:
            raise BagError(self.error)

    def _close(self, recorder: Recorder) -> None:
        try:
            recorder.close()
            if recorder.failed:
                self.error = recorder.error or "the recording is incomplete"
        except BagError as error:
            self.error = str(error)
        if self.error:
            log.error("%s: %s", recorder.path, self.error)

    def _state(self, recorder: Recorder) -> dict[str, Any]:
        status = recorder.status()
        ended = self._closing is not None and not self._closing.is_alive()
        return {
            "state": IDLE if ended else ENDING if self._closing is not None else status["state"],
            "path": status["path"],
            "seconds": round((self._ended_s or time.monotonic()) - self._began_s, 1),
            "bytes": status["bytes"],
            "messages": status["messages"],
            "error": self.error or status["error"],
        }
