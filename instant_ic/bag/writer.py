"""Writes rosbag2 folders of one or more MCAP files; each file is self-contained and starts with the latched values."""

from __future__ import annotations

import errno
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from instant_ic.bag.latched import LatchedValues
from instant_ic.bag.mcap_writer import Buffer, McapWriter, Schema
from instant_ic.bag.message import BagError, BagMessage, DiskFullError
from instant_ic.bag.metadata import PartInfo, Topic, channel_metadata, schema_or_unknown, write_metadata
from instant_ic.bus.qos import SENSOR, QoS
from instant_ic.util.closing import Closing
from instant_ic.util.private import make_folder, sync_folder

_FULL = (errno.ENOSPC, errno.EDQUOT)

CUSTOM_RECORD = "instant_ic"
"""Name of the metadata record that holds ``custom_data`` in a file while the bag is being written."""


@dataclass
class _Part:
    """The current file."""

    file: McapWriter
    info: PartInfo
    schemas: dict[str, int] = field(default_factory=dict)
    channels: dict[Topic, int] = field(default_factory=dict)
    first_ns: int | None = None
    given: Counter[str] = field(default_factory=Counter)  # messages by topic, without repetitions


class BagWriter(Closing):
    """Writes a bag folder; a context manager; not thread-safe.

    Each completed file is listed in ``metadata.yaml`` immediately. A killed recorder leaves a bag that opens, and
    one file to recover.

    Args:
        path: the folder, which must not exist; only its owner can read it.
        compressed: compress chunks with zstd, for archiving or sending; halves the size of point packets.
        max_bytes: file size at which a new file starts; 0 sets no limit.
        max_duration_s: duration by message stamps after which a new file starts; 0 sets no limit.

    Raises:
        BagError: the folder exists, or cannot be created.
    """

    def __init__(
        self,
        path: Path,
        compressed: bool = False,
        max_bytes: int = 0,
        max_duration_s: float = 0.0,
    ) -> None:
        self.path = path
        self.compressed = compressed
        self.max_bytes = max_bytes
        self.max_duration_ns = int(max_duration_s * 1e9)
        self.bytes = 0
        self.unknown_types: dict[str, str] = {}
        """Type → topic recorded without a definition because the type is unknown."""
        self.lost: Counter[str] = Counter()
        """Messages by topic that were given to :meth:`write` and did not reach the disk; replaced, never changed."""
        self._topics: dict[Topic, tuple[QoS, Schema]] = {}
        self._latched = LatchedValues()
        self._unsure = False
        self._custom: dict[str, str] = {}
        self._done: list[PartInfo] = []
        self._part: _Part | None = None
        self._closed = False
        try:
            make_folder(path)
        except FileExistsError:
            raise BagError(f"bag {path} cannot be created: {path} already exists") from None
        except OSError as error:
            raise BagError(f"bag {path} cannot be created: {error.strerror or error}") from None
        self._open_part()

    @property
    def count(self) -> int:
        """Messages so far, without those that a file only repeats."""
        done = sum(part.count - sum(part.repeated.values()) for part in self._done)
        return done + (self._part.given.total() if self._part is not None else 0)

    @property
    def parts(self) -> int:
        """Number of files so far."""
        return len(self._done) + (self._part is not None)

    def write(
        self,
        topic: str,
        type_name: str,
        payload: Buffer,
        stamp_ns: int,
        qos: QoS = SENSOR,
        schema: Schema | None = None,
        publisher: str = "",
    ) -> None:
        """Append one message.

        Args:
            topic: name of the topic.
            type_name: type of the topic.
            payload: CDR bytes; copied.
            stamp_ns: nanoseconds since the epoch.
            qos: QoS of the topic; used the first time that the topic appears.
            schema: definition of the type; default ours. Without one, the bytes are still recorded.
            publisher: name of the publisher; each publisher of a latched topic has its own current value.

        Raises:
            DiskFullError: lost messages are in ``lost``; the file has no index. The bag can be closed, or continued
                in another file once there is room.
            BagError: the file cannot be written; lost messages are in ``lost``.
        """
        if self._closed:
            raise BagError(f"bag {self.path} is closed")
        stamp = max(0, stamp_ns)
        part = self._part_for(topic, stamp)
        part.given[topic] += 1
        if (topic, type_name) not in self._topics:
            self.add_topic(topic, type_name, qos, schema)
        qos = self._topics[topic, type_name][0]
        value = BagMessage(topic, type_name, bytes(payload), stamp, qos, publisher) if qos.latched else None
        try:
            if part.first_ns is None:
                part.first_ns = stamp
                self._repeat(stamp, value)
            self._put(topic, type_name, payload, stamp, stamp)
        except OSError as error:
            raise self._failed(error, topic) from error
        if value is not None:
            self._latched.put(value)
        self.bytes += len(payload)

    def add_topic(self, topic: str, type_name: str, qos: QoS, schema: Schema | None = None) -> None:
        """Add a topic that may never carry a message."""
        if (topic, type_name) in self._topics:
            return
        schema = schema or schema_or_unknown(type_name)
        if not schema.encoding:
            self.unknown_types[type_name] = topic
        self._topics[topic, type_name] = (qos, schema)
        if self._part is not None:
            self._channel(self._part, (topic, type_name))

    def set_custom(self, key: str, value: str) -> None:
        self._custom[key] = value

    def keep_custom(self) -> None:
        """Write the current ``custom_data`` into the file itself, for a recovery to read.

        Raises:
            BagError: the disk is full.
        """
        if self._part is not None and self._part.given:
            try:
                self._part.file.add_metadata(CUSTOM_RECORD, self._custom)
            except OSError as error:
                raise self._failed(error, "metadata") from error

    def flush(self) -> None:
        """Pass all messages so far to the operating system. They then survive the end of this process.

        Raises:
            BagError: the disk is full.
        """
        if self._part is not None:
            try:
                self._part.file.flush()
            except OSError as error:
                raise self._failed(error, "flush") from error

    def sync(self) -> None:
        """Write all flushed messages to the disk itself. They then survive a power failure.

        Raises:
            BagError: the disk failed.
        """
        if self._part is not None:
            try:
                self._part.file.sync()
                sync_folder(self.path)
            except OSError as error:
                raise self._failed(error, "sync") from error

    def end_part(self) -> None:
        """Complete the current file and list it in ``metadata.yaml``; the next message starts another.

        Raises:
            BagError: the file cannot be completed.
        """
        part, self._part = self._part, None
        if part is not None:
            try:
                with suppress(OSError):  # no room; metadata.yaml holds the same values
                    part.file.add_metadata(CUSTOM_RECORD, self._custom)
                full = part.file.finish()
            except OSError as error:
                self._count_lost(part)
                raise BagError(
                    f"bag {self.path} cannot be completed: {error.strerror}; try ic bag recover {self.path}"
                ) from error
            if not part.file.path.exists():
                self.lost = self.lost + part.given
                raise BagError(f"bag {self.path}: {part.info.path} was removed while it was being recorded")
            self._note(part)
            if full is not None:
                self._write_metadata()
                raise self._full_or_failed(full, f"bag {self.path}")
        self._write_metadata()

    def close(self) -> None:
        """Write index and metadata. Idempotent.

        Raises:
            DiskFullError: the last messages did not fit; the bag is complete without them.
            BagError: the bag cannot be completed.
        """
        if not self._closed:
            self._closed = True
            self.end_part()

    # -- internals -------------------------------------------------------------------------------

    def _part_for(self, topic: str, stamp_ns: int) -> _Part:
        """Return the file for a message; starts the next one if necessary."""
        try:
            if self._part is not None and self._is_full(self._part, stamp_ns):
                self.end_part()
            if self._part is None:
                self._open_part()
        except BagError:
            self.lost = self.lost + Counter([topic])
            raise
        assert self._part is not None
        return self._part

    def _is_full(self, part: _Part, stamp_ns: int) -> bool:
        if part.first_ns is None:
            return False
        if self.max_bytes and part.file.size >= self.max_bytes:
            return True
        # A step of the clock ends a file in either direction.
        return 0 < self.max_duration_ns <= abs(stamp_ns - part.first_ns)

    def _open_part(self) -> None:
        number = len(self._done)
        numbered = number > 0 or self.max_bytes > 0 or self.max_duration_ns > 0
        name = f"{self.path.name}_{number}.mcap" if numbered else f"{self.path.name}.mcap"
        try:
            file = McapWriter(self.path / name, self.compressed)
        except OSError as error:
            if error.errno in _FULL:
                raise DiskFullError(f"bag {self.path}: {error.strerror}") from error
            raise BagError(f"bag {self.path} cannot be created: {error.strerror or error}") from None
        self._part = _Part(file, PartInfo(name))

    def _repeat(self, stamp_ns: int, but: BagMessage | None) -> None:
        if not self._done:
            return
        assert self._part is not None
        for value in self._latched.values(but):
            if self._unsure:  # a full disk may have dropped it: better twice than never
                self._part.given[value.topic] += 1
                self._put(value.topic, value.type_name, value.payload, stamp_ns, stamp_ns)
                continue
            self._put(value.topic, value.type_name, value.payload, stamp_ns, value.stamp_ns)
            repeated, self._part.info.repeated_ns = self._part.info.repeated, stamp_ns
            repeated[value.topic] = repeated.get(value.topic, 0) + 1
        self._unsure = False

    def _put(self, topic: str, type_name: str, payload: Buffer, stamp_ns: int, publish_ns: int) -> None:
        assert self._part is not None
        channel = self._channel(self._part, (topic, type_name))
        self._part.file.write(channel, stamp_ns, payload, publish_ns)

    def _channel(self, part: _Part, topic: Topic) -> int:
        if topic not in part.channels:
            qos, schema = self._topics[topic]
            if schema.name not in part.schemas:
                part.schemas[schema.name] = part.file.add_schema(schema)
            part.channels[topic] = part.file.add_channel(topic[0], part.schemas[schema.name], channel_metadata(qos))
        return part.channels[topic]

    def _failed(self, error: OSError, what: str) -> BagError:
        """End the file at its last complete chunk and return the error to raise."""
        words = f"bag {self.path}, {what}"
        try:
            self.end_part()
        except DiskFullError:
            pass
        except BagError as worse:
            return worse
        return self._full_or_failed(error, words)

    def _full_or_failed(self, error: OSError, words: str) -> BagError:
        text = f"{words}: {error.strerror}; run ic bag recover {self.path}"
        return DiskFullError(text) if error.errno in _FULL else BagError(text)

    def _note(self, part: _Part) -> None:
        part.info.counts = self._count_lost(part)
        part.info.start_ns, part.info.end_ns = part.file.span_ns
        self._done.append(part.info)

    def _count_lost(self, part: _Part) -> dict[Topic, int]:
        """Return the messages that are on the disk; count the others as lost."""
        counts = {topic: part.file.counts[channel] for topic, channel in part.channels.items()}
        by_topic: Counter[str] = Counter()
        for (name, _), count in counts.items():
            by_topic[name] += count
        repeated = Counter(part.info.repeated)  # they come first in the file
        if part.given + repeated - by_topic:
            part.info.repeated = dict(repeated & by_topic)
            self.lost = self.lost + (part.given - (by_topic - repeated))
            self._unsure = True
        return counts

    def _write_metadata(self) -> None:
        try:
            write_metadata(self.path, self._done, self._topics, self._custom)
        except OSError as error:
            hint = f"; make room, then ic bag recover {self.path}" if error.errno in _FULL else ""
            raise BagError(f"bag {self.path}: metadata.yaml cannot be written: {error.strerror}{hint}") from error
