"""Writing of one MCAP file (https://mcap.dev/spec) with the `mcap` package.

The package's writer cannot continue after a failed write. The file is then cut back to its last complete chunk and
closed, and ``ic bag recover`` can read it.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer

from instant_ic.bag.message import Topic
from instant_ic.bag.metadata import Topics, channel_metadata
from instant_ic.util.private import open_file

CHUNK_BYTES = 1 << 20
"""Size at which a chunk is closed."""

Buffer = bytes | memoryview


class _File:
    """An unbuffered stream of a new file that only its owner can read."""

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
        """Do nothing, because nothing is buffered."""

    def close(self) -> None:
        """Write the file to the disk itself and close it."""
        try:
            os.fsync(self.fd)
        finally:
            os.close(self.fd)


class McapWriter:
    """One MCAP file of CDR messages; not thread-safe. A failed write closes it.

    Args:
        path: the file, which must not exist; only its owner can read it.
        topics: QoS and type of each topic; may grow.
        compressed: compress chunks with zstd.

    Attributes:
        given: messages passed to :meth:`write`, by topic.
        counts: messages in complete chunks on the disk, by topic.
        first_ns: stamp of the first message; None if there is none yet.
        span_ns: first and last stamp in complete chunks; (0, 0) if there are none.

    Raises:
        OSError: in all methods: the disk is full, or failed. The file then ends with its last complete chunk.
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
        self._open: list[tuple[Topic, int]] = []  # topic and stamp of each message in the open chunk
        self._open_bytes = 0
        compression = CompressionType.ZSTD if compressed else CompressionType.NONE
        self._writer = Writer(self._file, CHUNK_BYTES, compression)
        try:
            self._put(self._writer.start, "ros2", "instant_ic")
        except OSError:
            path.unlink(missing_ok=True)
            raise

    @property
    def size(self) -> int:
        """Size in bytes so far, in which the open chunk counts uncompressed."""
        return self._file.offset + self._open_bytes

    @property
    def lost(self) -> Counter[str]:
        """Messages by topic that are in no complete chunk. They are lost when the file is closed after an error."""
        lost: Counter[str] = Counter()
        for (name, _), count in (self.given - self.counts).items():
            lost[name] += count
        return lost

    def add_topic(self, topic: Topic) -> int:
        """Add a topic with its type, unless the file has it, and return its number in this file."""
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
        """Append one message."""
        self.given[topic] += 1
        if self.first_ns is None:
            self.first_ns = stamp_ns
        channel = self.add_topic(topic)
        self._open.append((topic, stamp_ns))
        self._open_bytes += len(payload)
        self._put(self._writer.add_message, channel, stamp_ns, payload, stamp_ns)

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write a metadata record before the open chunk."""
        opened, self._open = self._open, []  # a metadata record completes no chunk
        self._put(self._writer.add_metadata, name, dict(values))
        self._open = opened

    def flush(self) -> None:
        """Write the open chunk. Its messages then survive the end of this process."""
        self._put(self._writer.flush)

    def sync(self) -> None:
        """Wait until all complete chunks are on the disk itself."""
        self._put(os.fdatasync, self._file.fd)

    def finish(self) -> None:
        """Write the open chunk, index and footer to the disk itself, and close the file."""
        self.flush()
        self._put(self._writer.finish)
        self._file.close()

    def _put(self, step: Callable[..., Any], *values: Any) -> Any:
        """Call the package's writer; if it fails, cut the file back to the last complete chunk and close it."""
        before = self._file.offset
        try:
            result = step(*values)
        except OSError:
            with suppress(OSError):
                os.ftruncate(self._file.fd, self._complete)
            with suppress(OSError):
                self._file.close()
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
