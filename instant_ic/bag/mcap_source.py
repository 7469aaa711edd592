"""Reads complete MCAP files of any writer, as storage for the readers of `rosbags`.

1. ``_index``: use the file's index, if summary, message indexes and statistics agree on every message.
2. ``_scan``: otherwise read the whole file once. The format makes every index optional, and messages may lie beside
   chunks.
3. ``messages``: read the spans that an index lists, merged by stamp. A span that does not hold what was counted is an
   error.
"""

from __future__ import annotations

import heapq
import struct
import zlib
from collections import Counter
from collections.abc import Collection, Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, ChunkIndex
from mcap.summary import Summary
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition, MessageDefinitionFormat
from rosbags.rosbag2 import ReaderError
from rosbags.rosbag2.metadata import ReaderMetadata

from instant_ic.bag.mcap_records import MESSAGE_HEAD, Definitions, chunk_content, mapped, records_of
from instant_ic.bag.mcap_writer import CHUNK_BYTES, MAGIC
from instant_ic.bag.metadata import profiles_of

SCHEMALESS = "__schemaless__"
"""Type of a topic that has none; the name that `rosbags` uses."""
_FORMATS = {
    "ros2msg": MessageDefinitionFormat.MSG,
    "ros2idl": MessageDefinitionFormat.IDL,
    "omgidl": MessageDefinitionFormat.IDL,
}
_FOOTER = struct.Struct("<BQQQI")
_ENTRY_BYTES = 16  # of a message index


@dataclass(frozen=True)
class Span:
    """A chunk, or neighbouring messages outside chunks: place in the file, stamps, messages by channel."""

    at: int
    end: int
    start_ns: int
    end_ns: int
    counts: Counter[int]
    compression: str = ""
    is_chunk: bool = True


class McapSource:
    """One complete file; the interface is that of a storage plugin of `rosbags`.

    Attributes:
        chunks: the spans that hold messages, in file order.
        connections: its topics.
        metadata: stamps and number of messages.
        definitions: its schemas, channels and metadata records.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._data = memoryview(b"")
        self._clear()

    def open(self) -> None:
        """Read the index, or build one.

        Raises:
            BagError: the file cannot be opened, or is not an MCAP file.
            ReaderError: it is truncated, damaged, or contradicts itself.
        """
        self._data = mapped(self.path)
        try:
            summary = self._summary()
            if summary is None or not self._index(summary):
                self._scan(summary)
            self._describe()
        except (ValueError, struct.error) as error:
            self.close()
            raise ReaderError(str(error)) from None
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Forget the file."""
        self._data = memoryview(b"")
        self._clear()

    def messages(
        self, connections: Collection[Connection], start: int | None = None, stop: int | None = None
    ) -> Generator[tuple[Connection, int, bytes], None, None]:
        """Yield topic, stamp and payload in stamp order.

        Args:
            connections: topics to read.
            start: first stamp, inclusive.
            stop: last stamp, exclusive.

        Raises:
            ReaderError: the file is damaged, or holds more or fewer messages than it counts.
        """
        wanted = {connection.id: connection for connection in connections}
        first, last = 0 if start is None else start, 1 << 64 if stop is None else stop
        streams = [
            self._messages_of(span, wanted, first, last)
            for span in self.chunks
            if span.end_ns >= first and span.start_ns < last and wanted.keys() & span.counts.keys()
        ]
        for stamp_ns, connection, payload in heapq.merge(*streams, key=lambda entry: entry[0]):
            if connection is not None:
                yield connection, stamp_ns, bytes(payload)

    # -- internals -------------------------------------------------------------------------------

    def _clear(self) -> None:
        self.definitions = Definitions()
        self.chunks: list[Span] = []
        self.connections: list[Connection] = []
        self.metadata = ReaderMetadata(0, (1 << 63) - 1, 0, 0, None, None, None, None)

    def _summary(self) -> Summary | None:
        """Return the summary section; None in a file without one."""
        data = self._data
        footer_at = len(data) - len(MAGIC) - _FOOTER.size
        if footer_at < len(MAGIC) or data[-len(MAGIC) :] != MAGIC:
            raise ReaderError("its end is missing")
        opcode, length, start, _, crc = _FOOTER.unpack_from(data, footer_at)
        if opcode != Opcode.FOOTER or length != _FOOTER.size - 9 or (start and not len(MAGIC) <= start <= footer_at):
            raise ReaderError("its footer is damaged")
        if not start:
            return None
        if crc and zlib.crc32(data[start : len(data) - len(MAGIC) - 4]) != crc:
            raise ReaderError("wrong checksum of its summary")
        with self.path.open("rb") as file:
            return make_reader(file).get_summary()

    def _index(self, summary: Summary) -> bool:
        """Take the summary's index; return whether it is complete."""
        statistics = summary.statistics
        if statistics is None or len(summary.chunk_indexes) != statistics.chunk_count:
            return False
        total: Counter[int] = Counter()
        spans = []
        for index in summary.chunk_indexes:
            counts = self._counts(index)
            end = index.chunk_start_offset + index.chunk_length
            times = index.message_start_time, index.message_end_time
            spans.append(Span(index.chunk_start_offset, end, *times, counts, index.compression))
            total.update(counts)
        schemas = summary.schemas.keys() | {0}
        complete = (
            total.total() == statistics.message_count
            and statistics.channel_count == len(summary.channels)
            and statistics.metadata_count == len(summary.metadata_indexes)
            and (not statistics.channel_message_counts or total == Counter(statistics.channel_message_counts))
            and total.keys() <= summary.channels.keys()
            and all(channel.schema_id in schemas for channel in summary.channels.values())
        )
        if not complete:
            return False
        self.definitions.schemas, self.definitions.channels = summary.schemas, summary.channels
        for entry in summary.metadata_indexes:
            _, opcode, body, _ = next(records_of(self._data, entry.offset, len(self._data)))
            self.definitions.take(opcode, body)
        self.chunks = [span for span in spans if span.counts]
        return True

    def _counts(self, index: ChunkIndex) -> Counter[int]:
        """Messages of a chunk, by channel, as far as it has a message index."""
        counts: Counter[int] = Counter()
        for channel, at in index.message_index_offsets.items():
            opcode, _, number, size = struct.unpack_from("<BQHI", self._data, at)
            if (opcode, number) == (Opcode.MESSAGE_INDEX, channel):
                counts[channel] += size // _ENTRY_BYTES
        return +counts

    def _scan(self, summary: Summary | None) -> None:
        """Build the index from the data section."""
        self.chunks = [span for span in self._spans() if span.counts]
        count = sum(span.counts.total() for span in self.chunks)
        if summary is not None and summary.statistics is not None and summary.statistics.message_count != count:
            raise ReaderError(f"it counts {summary.statistics.message_count} messages and contains {count}")
        for channel in {channel for span in self.chunks for channel in span.counts}:
            if channel not in self.definitions.channels:
                raise ReaderError(f"a message has channel {channel}, which it does not define")

    def _spans(self) -> Iterator[Span]:
        data, begin = self._data, 0  # of the messages outside chunks that are next to each other
        for at, opcode, body in _complete(data, len(MAGIC), len(data) - len(MAGIC)):
            if begin and (opcode != Opcode.MESSAGE or at - begin > CHUNK_BYTES):
                yield self._span(begin, at, data[begin:at], "", False)
                begin = 0
            if opcode == Opcode.CHUNK:
                compression, content = chunk_content(body)
                yield self._span(at, at + 9 + len(body), content, compression, True)
            elif opcode == Opcode.MESSAGE:
                begin = begin or at
            elif opcode == Opcode.DATA_END:
                return
            else:
                self.definitions.take(opcode, body)
        raise ReaderError("the end of its data is missing")

    def _span(self, at: int, end: int, content: memoryview, compression: str, is_chunk: bool) -> Span:
        counts: Counter[int] = Counter()
        stamps: list[int] = []
        for _, opcode, body in _complete(content, 0, len(content)):
            if opcode == Opcode.MESSAGE:
                channel, _, stamp_ns, _ = MESSAGE_HEAD.unpack_from(body)
                counts[channel] += 1
                stamps.append(stamp_ns)
            else:
                self.definitions.take(opcode, body)
        return Span(at, end, min(stamps, default=0), max(stamps, default=0), counts, compression, is_chunk)

    def _messages_of(
        self, span: Span, wanted: dict[int, Connection], first_ns: int, last_ns: int
    ) -> Iterator[tuple[int, Connection | None, memoryview]]:
        yield span.start_ns, None, memoryview(b"")  # the span is read once this is due
        content = self._data[span.at : span.end]
        if span.is_chunk:
            try:
                _, content = chunk_content(content[9:])
            except ValueError as error:
                raise ReaderError(f"the chunk at byte {span.at}: {error}") from None
        counts: Counter[int] = Counter()
        found: list[tuple[int, Connection, memoryview]] = []
        for _, opcode, body in _complete(content, 0, len(content)):
            if opcode == Opcode.MESSAGE:
                channel, _, stamp_ns, _ = MESSAGE_HEAD.unpack_from(body)
                counts[channel] += 1
                if not span.start_ns <= stamp_ns <= span.end_ns:
                    raise ReaderError(f"a message at byte {span.at} has a stamp outside those that its index gives")
                if channel in wanted and first_ns <= stamp_ns < last_ns:
                    found.append((stamp_ns, wanted[channel], body[MESSAGE_HEAD.size :]))
        if counts != span.counts:
            counted = span.counts.total()
            raise ReaderError(f"the index counts {counted} messages at byte {span.at}, there are {counts.total()}")
        yield from sorted(found, key=lambda entry: entry[0])

    def _describe(self) -> None:
        """Derive topics and metadata from the index."""
        total: Counter[int] = Counter()
        for span in self.chunks:
            total.update(span.counts)
        self.connections = [self._connection(channel, total) for channel in self.definitions.channels.values()]
        if self.chunks:
            start_ns = min(span.start_ns for span in self.chunks)
            end_ns = max(span.end_ns for span in self.chunks) + 1
            self.metadata = ReaderMetadata(end_ns - start_ns, start_ns, end_ns, total.total(), None, None, None, None)

    def _connection(self, channel: Channel, total: Counter[int]) -> Connection:
        schema = self.definitions.schema_of(channel)
        definition = MessageDefinition(_FORMATS.get(schema.encoding, MessageDefinitionFormat.NONE), schema.text)
        profiles = profiles_of(channel.metadata.get("offered_qos_profiles", ""))
        owner: Any = self
        return Connection(
            channel.id,
            channel.topic,
            schema.name or SCHEMALESS,
            definition,
            "",
            total[channel.id],
            ConnectionExtRosbag2(channel.message_encoding, profiles),
            owner,
        )


def _complete(data: memoryview, at: int, end: int) -> Iterator[tuple[int, int, memoryview]]:
    """Yield place, opcode and body of each record in ``data[at:end]``.

    Raises:
        ReaderError: one is damaged.
    """
    for place, opcode, body, complete in records_of(data, at, end):
        if not (complete and opcode):
            raise ReaderError(f"the record at byte {place} is damaged")
        yield place, opcode, body
