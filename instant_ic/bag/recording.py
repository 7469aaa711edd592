"""Writing of one bag by its own thread, so that the node never waits for the disk.

Messages enter a queue of limited size in bytes. The thread writes them, watches the disk's free space and completes the
bag. Lost messages are counted by topic: in ``overflow`` if the queue was full, in ``not_written`` if the disk was full
or failed.
"""

from __future__ import annotations

import json
import logging
import math
import shutil
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

from instant_ic.bag.message import BagError, BagMessage, DiskFullError
from instant_ic.bag.writer import BagWriter
from instant_ic.config.ranges import Checked, NotNegative, NotNegativeInt, Positive, PositiveInt, Range

FLUSH_S = 1.0
"""Largest part of the recording, in seconds, that is lost if the recorder is killed."""

SYNC_S = 5.0
"""Largest part of the recording, in seconds, that a power failure loses, apart from data in the disk's own cache."""

SPACE_S = 1.0
"""Seconds between two checks of the disk's free space."""

RECORDING, DISK_FULL, FAILED, ENDING, ENDED = "recording", "disk full", "failed", "ending", "ended"

_MB = 1_000_000
_KEEP_CUSTOM_S = 10.0
_ROOM_AGAIN = 64_000_000  # free bytes above the reserve before recording restarts

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class BagRecorderConfig(Checked):
    """Parameters of ``bag_recorder``.

    Attributes:
        compressed: compress with zstd.
        max_bag_size: size in bytes at which the next file begins; 0 writes one file.
        max_bag_duration: length in seconds at which the next file begins; 0 writes one file.
        queue_mb: size of the queue in front of the disk, MB; messages that do not fit are dropped and counted.
        min_free_mb: free space of the disk below which recording stops, MB.
        snapshot: keep the last seconds in memory and write only on request (``ic bag snapshot``, emergency stop).
            Between the commands ``record`` and ``stop`` (the page's button) a separate bag is recorded.
        snapshot_seconds: seconds before the request that a snapshot holds.
        max_cache_mb: memory for the last seconds, MB; heavy traffic makes the snapshot shorter.
        path: folder of the bag, which must not exist; empty creates ``runs/bag_DATE_TIME`` in the working directory. In
            snapshot mode, the folder for the snapshots.
        topics: names or patterns of the topics to record; empty records everything.
        exclude: names or patterns of the topics to leave out.
        discovery_period_s: seconds between searches for new topics.
        duration_s: seconds after which recording ends; 0 records until stopped.
        snapshot_after_s: seconds after the request that a snapshot also holds.
    """

    compressed: bool = False
    max_bag_size: NotNegativeInt = 0
    max_bag_duration: NotNegative = 0.0
    queue_mb: PositiveInt = 256
    min_free_mb: NotNegativeInt = 100
    snapshot: bool = False
    snapshot_seconds: Positive = 30.0
    max_cache_mb: PositiveInt = 256
    path: str = ""
    topics: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()
    discovery_period_s: Annotated[float, Range(0.01, 10.0)] = 0.2
    duration_s: NotNegative = 0.0
    snapshot_after_s: NotNegative = 2.0

    def folder(self) -> Path:
        if self.path:
            return Path(self.path).expanduser()
        return Path("runs") / f"{'snapshots' if self.snapshot else 'bag'}_{datetime.now():%Y%m%d_%H%M%S}"


class Recording:
    """A bag that is being written. Only the node's thread may call its methods.

    Args:
        path: folder of the bag, which must not exist.
        custom: returns the values to store with the bag, by name.
        content: past messages with which the bag begins, oldest first. If there are any, the thread creates the bag and
            :attr:`error` reports a failure.
        until_s: time at which :meth:`tick` ends the bag, by the monotonic clock.
        free_bytes: returns the free space on the disk of a folder; replaced in tests.

    Attributes:
        overflow: messages by topic that did not fit into the queue.
        failed: True if an error has occurred since the start.

    Raises:
        BagError: the bag cannot be created.
    """

    def __init__(
        self,
        path: Path,
        options: BagRecorderConfig,
        custom: Callable[[], Mapping[str, Any]],
        content: Collection[BagMessage] = (),
        until_s: float = math.inf,
        free_bytes: Callable[[Path], int] = lambda path: shutil.disk_usage(path).free,
    ) -> None:
        self.path = path
        self.overflow: Counter[str] = Counter()
        self.failed = False
        self._state = RECORDING
        self._custom = custom
        self._free_bytes = free_bytes
        self._until_s = until_s
        self._reserve = options.min_free_mb * _MB
        limits = (options.max_bag_size, options.max_bag_duration)
        self._writer = BagWriter(path, options.compressed, *limits, create=not content)
        self._begun_s, self._ended_s = time.monotonic(), 0.0
        self._report = True
        self._begun_ns = min((message.stamp_ns for message in content), default=0)
        self._held: list[BagMessage] = []
        self._error = ""
        self._skipped: Counter[str] = Counter()  # replaced, never changed: another thread reads it
        self._queue = deque(content)
        self._pending = len(content)  # queued, or being written
        self._pending_bytes = sum(len(message.payload) for message in content)
        self._max_bytes = options.queue_mb * _MB + self._pending_bytes
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="bag writer", daemon=True)
        self._thread.start()

    # -- the node's thread -------------------------------------------------------------------------

    @property
    def state(self) -> str:
        """The bag's state: ``recording``, ``disk full``, ``failed``, ``ending`` or ``ended``."""
        return ENDING if self._ended_s and not self.done else self._state

    @property
    def done(self) -> bool:
        """True once the bag is complete, or given up."""
        return not self._thread.is_alive()

    @property
    def not_written(self) -> Counter[str]:
        """Messages by topic that were lost because the disk was full or failed."""
        return self._skipped + self._writer.lost

    @property
    def error(self) -> str:
        """Reason why recording failed or waits, with the lost messages; empty while recording works."""
        gone = self.not_written if self._error else None
        return f"{self._error}; not recorded: {counts_text(gone)}" if gone else self._error

    def put(self, message: BagMessage, old: bool = False) -> None:
        """Queue a message without waiting.

        Latched values may be minutes old when a bag begins. They are held until another message arrives, or a second
        value from the same publisher, and then get its stamp.

        Args:
            message: the message.
            old: the message is a latched value from before the bag.
        """
        if self._ended_s:
            return
        if not self._begun_ns:
            source = (message.topic, message.publisher)
            if old or (message.qos.latched and source not in {(held.topic, held.publisher) for held in self._held}):
                self._held.append(message)
                return
            self._begin(message.stamp_ns)
        self._enqueue(message)

    def tick(self) -> None:
        """End the bag if ``until_s`` has passed."""
        if time.monotonic() >= self._until_s:
            self.finish()

    def finish(self, report: bool = True) -> None:
        """Accept no more messages. The thread writes the queue and completes the bag.

        Args:
            report: log the end.
        """
        if self._ended_s:
            return
        if self._held:
            self._begin(max(message.stamp_ns for message in self._held))
        self._report = report
        with self._changed:
            self._ended_s = time.monotonic()
            self._changed.notify()

    def close(self, timeout_s: float = 30.0) -> None:
        """Complete the bag, and wait until it is complete.

        Raises:
            BagError: the bag could not be written completely.
        """
        self.finish(report=False)
        self._thread.join(timeout_s)
        if not self.done:
            raise BagError(
                f"bag {self.path}: the disk did not take the last {self._pending} messages "
                f"({self._pending_bytes / 1e6:.1f} MB) within {timeout_s:g} s; run ic bag recover {self.path}"
            )
        if self._state == FAILED:
            raise BagError(self.error)

    def status(self) -> dict[str, Any]:
        """Return the values that ``ic bag control status`` shows."""
        return {
            "path": str(self.path),
            "state": self.state,
            "error": self.error,
            "seconds": round((self._ended_s or time.monotonic()) - self._begun_s, 1),
            "messages": self._writer.count,
            "bytes": self._writer.bytes,
            "files": self._writer.files,
            "queued_bytes": self._pending_bytes,
            "overflow": dict(self.overflow),
            "disk_full": dict(self.not_written),
        }

    def _begin(self, stamp_ns: int) -> None:
        self._begun_ns = stamp_ns
        held, self._held = self._held, []
        for message in held:
            self._enqueue(message)

    def _enqueue(self, message: BagMessage) -> None:
        """Queue a message, or count it as overflow if the queue is full. Latched messages are always queued."""
        if message.qos.latched:
            message = replace(message, stamp_ns=max(message.stamp_ns, self._begun_ns))
        size = len(message.payload)
        with self._changed:
            if not message.qos.latched and self._pending_bytes + size > self._max_bytes:
                self.overflow[message.topic] += 1
                return
            self._queue.append(message)
            self._pending_bytes += size
            self._pending += 1
            self._changed.notify()

    # -- the writing thread ------------------------------------------------------------------------

    def _run(self) -> None:
        with self._noting_failures():
            if not self._writer.files:
                self._writer.create()
        now = time.monotonic()
        due_s = {"space": now, "flush": now, "custom": now + _KEEP_CUSTOM_S, "sync": now + SYNC_S}
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._queue or self._ended_s, SPACE_S)
                message = self._queue.popleft() if self._queue else None
            if message is None and self._ended_s:
                break
            with self._noting_failures():
                self._work(due_s)
            if message is not None:
                with self._noting_failures():  # even after a failure above, because the message must be counted
                    self._write(message)
                with self._changed:
                    self._pending -= 1
                    self._pending_bytes -= len(message.payload)
        self._complete()

    @contextmanager
    def _noting_failures(self) -> Iterator[None]:
        try:
            yield
        except DiskFullError as error:
            self._fail(DISK_FULL, str(error))
        except BagError as error:
            self._fail(FAILED, str(error))
        except Exception as error:  # a bug here must not leave a recorder that only appears to record
            log.exception("bag writer")
            self._fail(FAILED, f"{type(error).__name__}: {error}")

    def _write(self, message: BagMessage) -> None:
        if self._state != RECORDING:
            self._skipped = self._skipped + Counter([message.topic])
            if message.qos.latched:
                self._writer.remember(message)
            return
        stamp_ns, qos = message.stamp_ns, message.qos
        self._writer.write(
            message.topic, message.type_name, message.payload, stamp_ns, qos, publisher=message.publisher
        )

    def _work(self, due_s: dict[str, float]) -> None:
        """Do the periodic work that is due.

        Raises:
            BagError: the disk is full, or failed.
        """
        now = time.monotonic()
        if now >= due_s["space"]:
            due_s["space"] = now + SPACE_S
            self._look_for_space()
        if self._state != RECORDING:
            return
        if now >= due_s["flush"]:
            due_s["flush"] = now + FLUSH_S
            self._writer.flush()
        if now >= due_s["custom"]:
            due_s["custom"] = now + _KEEP_CUSTOM_S
            self._set_custom()
            self._writer.keep_custom()
        if now >= due_s["sync"]:
            due_s["sync"] = now + SYNC_S
            self._writer.sync()

    def _look_for_space(self) -> None:
        """End the file when the disk has less free space than the reserve; continue when there is space again.

        Raises:
            BagError: the folder was removed, or the file cannot be completed.
        """
        if self._state == FAILED:
            return
        try:
            free = self._free_bytes(self.path)
        except OSError as error:
            raise BagError(f"bag {self.path}: {error.strerror}; its folder was removed") from None
        if self._state == RECORDING and free < self._reserve:
            self._set_custom()
            self._writer.end_file()
            self._fail(DISK_FULL, f"{low_text(self.path, free, self._reserve)}: the bag is complete up to here")
        elif self._state == DISK_FULL and free >= self._reserve + _ROOM_AGAIN:
            gone = counts_text(self.not_written) or "nothing"
            log.warning("%s: space is available again; not recorded so far: %s", self.path, gone)
            self._state, self._error = RECORDING, ""

    def _fail(self, state: str, text: str) -> None:
        self._state, self._error, self.failed = state, text, True

    def _set_custom(self) -> None:
        losses = {"overflow": dict(self.overflow), "disk_full": dict(self.not_written)}
        for key, value in {**self._custom(), **losses}.items():
            self._writer.set_custom(f"instant_ic.{key}", json.dumps(value, sort_keys=True))

    def _complete(self) -> None:
        for step in (self._writer.end_file, self._writer.close):  # the second step stores the losses of the first
            self._set_custom()
            try:
                step()
            except BagError as error:
                if self._state != FAILED:  # otherwise keep the first reason
                    self._fail(FAILED, str(error))
        if self._state != FAILED:
            self._state = ENDED
        if self._report and self.error:
            log.error("%s: %s", self.path, self.error)
        elif self._report:
            log.info("%s: %d messages", self.path, self._writer.count)


def low_text(path: Path, free: int, reserve: int) -> str:
    """Return the text for a disk that has less free space than the reserve."""
    return f"only {free / 1e6:.0f} MB are free for {path} (reserve: {reserve / 1e6:.0f} MB): not recording"


def counts_text(counts: Mapping[str, int]) -> str:
    """Return counts by topic as text."""
    return ", ".join(f"{topic} {number}" for topic, number in sorted(counts.items()))
