"""The thread that writes a recording: the node never waits for the disk."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from instant_ic.bag.message import BagError, BagMessage, DiskFullError
from instant_ic.bag.writer import BagWriter

FLUSH_S = 1.0
"""Longest time of the recording that a killed recorder loses."""

SYNC_S = 5.0
"""Longest time of the recording that a power failure loses, beside what the disk itself holds back."""

SPACE_S = 1.0
"""Seconds between two looks at the free space of the disk."""

RECORDING, PAUSED, DISK_FULL, FAILED, ENDED = "recording", "paused", "disk full", "failed", "ended"


_MB = 1_000_000
_KEEP_CUSTOM_S = 10.0
_ROOM_AGAIN = 64_000_000  # free space above the reserve before recording restarts

log = logging.getLogger(__name__)


class RecorderQueue:
    """Messages and calls queued for the writing thread, bounded by the bytes of the messages."""

    def __init__(self, max_bytes: int) -> None:
        self.max_bytes = max_bytes
        self.bytes = self.messages = 0  # including those in the thread's hands
        self._items: deque[BagMessage | Callable[[], None]] = deque()
        self._condition = threading.Condition()

    def put(self, item: BagMessage | Callable[[], None]) -> bool:
        """Queue an item; return False if a message does not fit. Latched messages and calls always fit."""
        size = len(item.payload) if isinstance(item, BagMessage) else 0
        with self._condition:
            if isinstance(item, BagMessage) and not item.qos.latched and self.bytes + size > self.max_bytes:
                return False
            self._items.append(item)
            self.bytes += size
            self.messages += isinstance(item, BagMessage)
            self._condition.notify()
        return True

    def take(self, timeout_s: float) -> BagMessage | Callable[[], None] | None:
        """Return the next item, or None after `timeout_s`."""
        with self._condition:
            if not self._items and not self._condition.wait_for(lambda: bool(self._items), timeout_s):
                return None
            return self._items.popleft()

    def done(self, item: BagMessage) -> None:
        """Release the bytes of a message that has been written."""
        with self._condition:
            self.bytes -= len(item.payload)
            self.messages -= 1


class RecorderThread:
    """Writes queued messages, watches the free space, and completes the bag.

    Args:
        path: the bag's folder, or the parent folder of snapshots.
        writer: the bag; None writes snapshots only.
        custom: returns the losses and parameters to store with the bag, by name.
        queue_mb: size of the queue, MB.
        min_free_mb: reserve of free space on the disk, MB.
        free_bytes: free space on the disk of a folder.

    Attributes:
        queue: messages and calls to run, in order.
        state: ``recording``, ``disk full``, ``failed`` or ``ended``.
        error: why recording failed or waits.
        failed: whether an error occurred since the start.
        not_written: latched messages that found no room.
    """

    def __init__(
        self,
        path: Path,
        writer: BagWriter | None,
        custom: Callable[[], Mapping[str, Any]],
        queue_mb: int,
        min_free_mb: int,
        free_bytes: Callable[[Path], int],
    ) -> None:
        self.path = path
        self.writer = writer
        self.queue = RecorderQueue(queue_mb * _MB)
        self.state = RECORDING
        self.error = ""
        self.failed = False
        self.not_written: deque[BagMessage] = deque()
        self._custom = custom
        self._reserve = min_free_mb * _MB
        self._free_bytes = free_bytes
        self._skipped: Counter[str] = Counter()
        self._counting = threading.Lock()  # two threads skip messages
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="bag writer", daemon=True)

    def start(self) -> None:
        """Start writing."""
        self._thread.start()

    def skip(self, message: BagMessage) -> None:
        """Count a message as lost because the disk takes none."""
        with self._counting:
            self._skipped[message.topic] += 1
        if message.qos.latched:
            self.not_written.append(message)

    def lost(self) -> Counter[str]:
        """Return the messages by topic that were lost because the disk was full, or failed."""
        with self._counting:
            return self._skipped + (self.writer.lost if self.writer is not None else Counter())

    def close(self, timeout_s: float) -> None:
        """Write what is queued and complete the bag.

        Raises:
            BagError: the bag could not be written completely.
        """
        self._ending.set()
        self.queue.put(lambda: None)  # wakes the thread
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            raise BagError(
                f"bag {self.path}: the disk did not take the last {self.queue.messages} messages "
                f"({self.queue.bytes / 1e6:.1f} MB) within {timeout_s:g} s; ic bag recover {self.path}"
            )
        if self.state == FAILED:
            raise BagError(self.error)

    def set_custom(self, writer: BagWriter) -> None:
        """Store losses and parameters with a bag."""
        for key, value in self._custom().items():
            text = value if isinstance(value, str) else json.dumps(value, sort_keys=True)
            writer.set_custom(f"instant_ic.{key}", text)

    def _run(self) -> None:
        next_flush = next_space = 0.0
        next_custom, next_sync = time.monotonic() + _KEEP_CUSTOM_S, time.monotonic() + SYNC_S
        while True:
            item = self.queue.take(0.0 if self._ending.is_set() else SPACE_S)
            if item is None and self._ending.is_set():
                break
            try:
                if isinstance(item, BagMessage):
                    self._write(item)
                elif item is not None:
                    item()
                now = time.monotonic()
                if now >= next_space:
                    next_space = now + SPACE_S
                    self._look_for_space()
                if self.writer is None or self.state != RECORDING:
                    continue
                if now >= next_flush:
                    next_flush = now + FLUSH_S
                    self.writer.flush()
                if now >= next_custom:
                    next_custom = now + _KEEP_CUSTOM_S
                    self.set_custom(self.writer)
                    self.writer.keep_custom()
                if now >= next_sync:
                    next_sync = now + SYNC_S
                    self.writer.sync()
            except DiskFullError as error:
                self._stop(DISK_FULL, str(error))
            except BagError as error:
                self._stop(FAILED, str(error))
            except Exception as error:  # a bug here must not leave a recorder that only appears to record
                log.exception("bag writer")
                self._stop(FAILED, f"{type(error).__name__}: {error}")
        self._finish()

    def _write(self, entry: BagMessage) -> None:
        try:
            if self.writer is None or self.state != RECORDING:
                self.skip(entry)
                return
            self.writer.write(
                entry.topic, entry.type_name, entry.payload, entry.stamp_ns, entry.qos, publisher=entry.publisher
            )
        finally:
            self.queue.done(entry)

    def _look_for_space(self) -> None:
        if self.state == FAILED:
            return
        try:
            # Without a snapshot so far, the folder for snapshots need not exist.
            free = self._free_bytes(self.path if self.writer is not None else on_disk(self.path))
        except OSError as error:
            self._stop(FAILED, f"bag {self.path}: {error.strerror}: its folder was removed")
            return
        if self.state == RECORDING and free < self._reserve:
            words = f"only {free / 1e6:.0f} MB are free for {self.path}, {self._reserve / 1e6:.0f} MB are the reserve"
            if self.writer is not None:
                self.set_custom(self.writer)
                self.writer.end_file()
            self._stop(DISK_FULL, f"{words}: not recording; the bag is complete up to here")
        elif self.state == DISK_FULL and free >= self._reserve + _ROOM_AGAIN:
            log.warning(
                "%s: space is available again; recording continues in a new file. Not recorded so far: %s",
                self.path,
                counts_text(self.lost()) or "nothing",
            )
            self.state, self.error = RECORDING, ""

    def _stop(self, state: str, words: str) -> None:
        self.state, self.error, self.failed = state, words, True
        log.debug("%s", words)  # reported by the node's diagnostics and by close()

    def _finish(self) -> None:
        if self.writer is None:
            self.state = ENDED
            return
        for step in (self.writer.end_file, self.writer.close):  # the second writes what the first has lost
            self.set_custom(self.writer)
            try:
                step()
            except BagError as error:
                if self.state != FAILED:  # otherwise keep the first reason
                    self._stop(FAILED, str(error))
        if self.state != FAILED:
            self.state = ENDED
        if self.error and (gone := self.lost()):
            self.error += f"; not recorded: {counts_text(gone)}"


def on_disk(path: Path) -> Path:
    """Return the path, or the nearest one above it that exists."""
    return next(above for above in (path, *path.absolute().parents) if above.exists())


def counts_text(counts: Mapping[str, int]) -> str:
    """Return counts by topic as text."""
    return ", ".join(f"{topic} {number}" for topic, number in sorted(counts.items()))
