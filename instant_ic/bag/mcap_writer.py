"""Writes one MCAP file (https://mcap.dev/spec) by the `mcap` package; a full disk leaves a readable file.

The package's writer cannot go on after a failed write. Then the file is cut back to its last complete chunk and ended
without an index.
"""

from __future__ import annotations

import os
import struct
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC as MAGIC
from mcap.writer import CompressionType, Writer

from instant_ic.bag.message import Topic
from instant_ic.bag.metadata import Topics, channel_metadata
from instant_ic.util.private import open_file

CHUNK_BYTES = 1 << 20
"""A chunk is closed once it is larger than this."""

_END = struct.pack("<BQI", Opcode.DATA_END, 4, 0) + struct.pack("<BQQQI", Opcode.FOOTER, 20, 0, 0, 0) + MAGIC
"""End of a file without an index, as the format allows."""

Buffer = bytes | memoryview


class _File:
    """Unbuffered stream of a new file that only its owner can read."""

    def __init__(self, path: Path) -> None:
        self.fd = open_file(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL)
        self.offset = 0

    def write(self, data: Buffer) -> None:
        view = memoryview(data)
        while view:
            written = os.write(self.fd, view)
            self.offset += written
            view = view[written:]

    def tell(self) -> int:
        return self.offset

    def flush(self) -> None:
        """Do nothing: nothing is buffered."""

    def cut_back(self, offset: int) -> None:
        os.ftruncate(self.fd, offset)
        os.lseek(self.fd, offset, os.SEEK_SET)
        self.offset = offset


class McapWriter:
    """One MCAP file of CDR messages; not thread-safe. After an error only :meth:`finish` may be called.

    Args:
        path: the file, which must not exist; only its owner can read it.
        topics: QoS and type of each topic; may grow.
        compressed: compress chunks with zstd.

    Attributes:
        given: messages passed to :meth:`write`, by topic.
        counts: messages in complete chunks on the disk, by topic.
        first_ns: stamp of the first message; None before it.
        span_ns: first and last stamp in complete chunks; (0, 0) if there are none.

    Raises:
        OSError: the file cannot be created.
    """

    def __init__(self, path: Path, topics: Topics, compressed: bool = False) -> None:
        self.path = path
        self._topics = topics
        self.given: Counter[Topic] = Counter()
        self.counts: Counter[Topic] = Counter()
        self.first_ns: int | None = None
        self.span_ns = (0, 0)
        self._schemas: dict[str, int] = {}
        self._channels: dict[Topic, int] = {}
        self._file = _File(path)
        self._complete = 0  # end of the last complete chunk
        self._failure: OSError | None = None
        self._open: list[tuple[Topic, int]] = []  # topic and stamp of each message in the open chunk
        self._open_bytes = 0
        compression = CompressionType.ZSTD if compressed else CompressionType.NONE
        self._writer = Writer(self._file, CHUNK_BYTES, compression)
        try:
            self._put(self._writer.start, "ros2", "instant_ic")
        except OSError:
            os.close(self._file.fd)
            path.unlink(missing_ok=True)
            raise

    @property
    def size(self) -> int:
        """Bytes so far; the open chunk counts uncompressed."""
        return self._file.offset + self._open_bytes

    @property
    def lost(self) -> Counter[str]:
        """Messages by topic outside complete chunks; after :meth:`finish`, those that did not reach the disk."""
        lost: Counter[str] = Counter()
        for (name, _), count in (self.given - self.counts).items():
            lost[name] += count
        return lost

    def add_topic(self, topic: Topic) -> int:
        """Add a topic with its type, once; return its number in this file.

        Raises:
            OSError: the disk is full.
        """
        if topic not in self._channels:
            qos, schema = self._topics[topic]
            if schema.name not in self._schemas:
                self._open_bytes += len(schema.text)
                definition = (schema.name, schema.encoding, schema.text.encode())
                self._schemas[schema.name] = self._put(self._writer.register_schema, *definition)
            channel = (topic[0], "cdr", self._schemas[schema.name], channel_metadata(qos))
            self._channels[topic] = self._put(self._writer.register_channel, *channel)
        return self._channels[topic]

    def write(self, topic: Topic, stamp_ns: int, payload: Buffer) -> None:
        """Append one message.

        Raises:
            OSError: the disk is full; the file then ends with the last complete chunk.
        """
        self.given[topic] += 1
        if self.first_ns is None:
            self.first_ns = stamp_ns
        channel = self.add_topic(topic)
        self._open.append((topic, stamp_ns))
        self._open_bytes += len(payload)
        self._put(self._writer.add_message, channel, stamp_ns, payload, stamp_ns)

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write a metadata record before the open chunk.

        Raises:
            OSError: the disk is full.
        """
        opened, self._open = self._open, []  # this completes no chunk
        self._put(self._writer.add_metadata, name, dict(values))
        self._open = opened

    def flush(self) -> None:
        """Write the open chunk. Its messages then survive the end of this process.

        Raises:
            OSError: the disk is full; the chunk is lost and the file ends with the previous chunk.
        """
        self._put(self._writer.flush)

    def sync(self) -> None:
        """Wait until all complete chunks are on the disk itself.

        Raises:
            OSError: the disk failed.
        """
        os.fdatasync(self._file.fd)

    def finish(self) -> OSError | None:
        """Write index and footer, to the disk itself, and close the file.

        Returns:
            The error after which the file ends early and has no index; None if everything was written.

        Raises:
            OSError: not even the end could be written; the file is closed and can be recovered.
        """
        try:
            if self._failure is None:
                try:
                    self.flush()
                    self._put(self._writer.finish)
                except OSError as error:
                    self._failure = error
            if self._failure is not None:
                self._file.write(_END)
            os.fsync(self._file.fd)
            return self._failure
        finally:
            os.close(self._file.fd)

    def _put(self, step: Callable[..., Any], *values: Any) -> Any:
        """Call the package's writer; if it fails, cut the file back to the last complete chunk."""
        if self._failure is not None:
            raise self._failure
        before = self._file.offset
        try:
            result = step(*values)
        except OSError as error:
            self._failure = error
            self._file.cut_back(self._complete)
            raise
        if self._file.offset > before:
            self._complete = self._file.offset
            self._note_chunk()
        return result

    def _note_chunk(self) -> None:
        """Count the messages of the open chunk, which is now complete."""
        if not self._open:
            return
        stamps = [stamp_ns for _, stamp_ns in self._open]
        first, last = min(stamps), max(stamps)
        self.span_ns = (min(first, self.span_ns[0]), max(last, self.span_ns[1])) if self.counts else (first, last)
        self.counts.update(topic for topic, _ in self._open)
        self._open, self._open_bytes = [], 0
