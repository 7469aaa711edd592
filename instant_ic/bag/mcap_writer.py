"""Writes one MCAP file (https://mcap.dev/spec) in chunks, without copying the payloads.

The `mcap` package encodes all records except messages and chunks. Its writer cannot pass on an open chunk, copies each
payload, and leaves a broken file on a full disk. Here each chunk is one gathered write, so the file always ends with a
complete chunk. On a full disk the writer truncates the file to it and builds the index from memory.
"""

from __future__ import annotations

import errno
import os
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC as MAGIC

from instant_ic.util.private import open_file

CHUNK_BYTES = 1 << 20
"""A chunk is closed once it is larger than this."""

LIBRARY = "instant_ic"
_IOV_MOST = 1000  # IOV_MAX limits a gathered write to 1024 parts

Buffer = bytes | memoryview


@dataclass(frozen=True)
class Schema:
    """Definition of a message type in a bag.

    Attributes:
        name: type name, for example ``sensor_msgs/msg/Image``.
        encoding: ``ros2msg`` or ``ros2idl``; empty where the definition is unknown.
        text: the definition, including those of nested types.
        type_hash: RIHS01 hash; empty where it is unknown.
    """

    name: str
    encoding: str
    text: str
    type_hash: str


@dataclass(frozen=True)
class _Chunk:
    """Index entry of a chunk, and its number of messages by channel."""

    index: records.ChunkIndex
    counts: dict[int, int]


class McapWriter:
    """One MCAP file of CDR messages; not thread-safe.

    Args:
        path: the file, which must not exist; only its owner can read it.
        compressed: compress chunks with zstd.
        level: zstd level, from 1 (fastest) to 19 (smallest).

    Raises:
        OSError: the file cannot be created.
    """

    def __init__(self, path: Path, compressed: bool = False, level: int = 3) -> None:
        self.path = path
        self.compressed = compressed
        self._compression = "zstd" if compressed else ""
        self._compressor: Any = None
        if compressed:
            import zstandard

            self._compressor = zstandard.ZstdCompressor(level=level)
        self._fd = open_file(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL)
        self._offset = 0
        self._schemas: list[records.Schema] = []
        self._channels: list[records.Channel] = []
        self._chunks: list[_Chunk] = []
        self._metadata: list[records.MetadataIndex] = []
        self._clear()
        try:
            self._put([MAGIC, _encode(records.Header(profile="ros2", library=LIBRARY))])
        except OSError:
            os.close(self._fd)
            path.unlink(missing_ok=True)
            raise

    @property
    def size(self) -> int:
        """Bytes so far; the open chunk counts uncompressed."""
        return self._offset + self._chunk_bytes

    def add_schema(self, schema: Schema) -> int:
        """Add a message type and return its number in this file."""
        number = len(self._schemas) + 1
        record = records.Schema(id=number, name=schema.name, encoding=schema.encoding, data=schema.text.encode())
        self._schemas.append(record)
        self._append(_encode(record))
        return number

    def add_channel(self, topic: str, schema: int, metadata: Mapping[str, str]) -> int:
        """Add a topic with its type and return its number in this file."""
        number = len(self._channels) + 1
        record = records.Channel(
            id=number, schema_id=schema, topic=topic, message_encoding="cdr", metadata=dict(metadata)
        )
        self._channels.append(record)
        self._append(_encode(record))
        return number

    def write(self, channel: int, stamp_ns: int, payload: Buffer, publish_ns: int | None = None) -> None:
        """Append one message; ``payload`` must not change until its chunk is written.

        Raises:
            OSError: the disk is full; the file then ends with the last complete chunk.
        """
        self._index.setdefault(channel, []).append((stamp_ns, self._chunk_bytes))
        publish = stamp_ns if publish_ns is None else publish_ns
        self._append(struct.pack("<BQHIQQ", Opcode.MESSAGE, 22 + len(payload), channel, 0, stamp_ns, publish))
        self._append(payload)
        if self._chunk_bytes > CHUNK_BYTES or len(self._parts) > 100_000:
            self.flush()

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write a metadata record before the open chunk.

        Raises:
            OSError: the disk is full.
        """
        record, offset = _encode(records.Metadata(name=name, metadata=dict(values))), self._offset
        self._put([record])
        self._metadata.append(records.MetadataIndex(offset=offset, length=len(record), name=name))

    def flush(self) -> None:
        """Write the open chunk. Its messages then survive the end of this process.

        Raises:
            OSError: the disk is full; the chunk is lost and the file ends with the previous chunk.
        """
        if not self._parts:
            return
        parts, index, size = self._parts, self._index, self._chunk_bytes
        if not index:  # only schemas and channels: they go out with the next messages
            return
        self._clear()
        crc = 0
        for part in parts:
            crc = zlib.crc32(part, crc)
        stored: Sequence[Buffer] = parts
        stored_size = size
        if self._compressor is not None:
            stored = [self._compressed(parts, size)]
            stored_size = len(stored[0])
        start_ns = min(stamp for entries in index.values() for stamp, _ in entries)
        end_ns = max(stamp for entries in index.values() for stamp, _ in entries)
        kind = self._compression.encode()
        head = struct.pack(f"<QQQII{len(kind)}sQ", start_ns, end_ns, size, crc, len(kind), kind, stored_size)
        length = 9 + len(head) + stored_size
        tail, offsets, at = [], {}, self._offset + length
        for channel, entries in index.items():
            offsets[channel] = at
            tail.append(_encode(records.MessageIndex(channel, entries)))
            at += len(tail[-1])
        entry = records.ChunkIndex(
            chunk_start_offset=self._offset,
            chunk_length=length,
            compression=self._compression,
            compressed_size=stored_size,
            uncompressed_size=size,
            message_start_time=start_ns,
            message_end_time=end_ns,
            message_index_length=at - self._offset - length,
            message_index_offsets=offsets,
        )
        self._put([struct.pack("<BQ", Opcode.CHUNK, len(head) + stored_size), head, *stored, *tail])
        self._chunks.append(_Chunk(entry, {channel: len(entries) for channel, entries in index.items()}))

    def sync(self) -> None:
        """Wait until all complete chunks are on the disk itself.

        Raises:
            OSError: the disk failed.
        """
        os.fdatasync(self._fd)

    def finish(self) -> OSError | None:
        """Write index and footer, to the disk itself, and close the file. A full disk drops the last chunks for them.

        Returns:
            The disk-full error if messages were dropped; None if everything was written.

        Raises:
            OSError: dropping chunks was not enough, or the disk failed; the file is closed and can be recovered.
        """
        full = None
        try:
            try:
                self.flush()
            except OSError as error:
                full = _if_full(error)
            while True:
                try:
                    self._put(self._summary())
                    break
                except OSError as error:
                    full = _if_full(error)
                    if not self._chunks:
                        raise
                    self._cut_back(self._chunks.pop().index.chunk_start_offset)
            os.fsync(self._fd)
            return full
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close the file without an index. Idempotent."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1
        self._clear()

    @property
    def count(self) -> int:
        """Messages in complete chunks on the disk."""
        return sum(self.counts.values())

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last stamp in complete chunks; (0, 0) if there are none."""
        if not self._chunks:
            return 0, 0
        indexes = [chunk.index for chunk in self._chunks]
        return min(i.message_start_time for i in indexes), max(i.message_end_time for i in indexes)

    @property
    def counts(self) -> dict[int, int]:
        """Messages in complete chunks, by channel."""
        counts = {channel.id: 0 for channel in self._channels}
        for chunk in self._chunks:
            for channel, count in chunk.counts.items():
                counts[channel] += count
        return counts

    def _append(self, part: Buffer) -> None:
        self._parts.append(part)
        self._chunk_bytes += len(part)

    def _clear(self) -> None:
        self._parts: list[Buffer] = []
        self._chunk_bytes = 0
        self._index: dict[int, list[tuple[int, int]]] = {}

    def _compressed(self, parts: Sequence[Buffer], size: int) -> bytes:
        stream = self._compressor.compressobj(size=size)
        return b"".join([*(stream.compress(part) for part in parts), stream.flush()])

    def _put(self, parts: Sequence[Buffer]) -> None:
        """Write all parts or none."""
        if self._fd < 0:
            raise ValueError(f"{self.path} is closed")
        begin = self._offset
        views = [memoryview(part).cast("B") for part in parts if len(part)]
        first = 0
        try:
            while first < len(views):
                written = os.writev(self._fd, views[first : first + _IOV_MOST])
                self._offset += written
                while first < len(views) and written >= len(views[first]):
                    written -= len(views[first])
                    first += 1
                if written:
                    views[first] = views[first][written:]
        except OSError:
            self._cut_back(begin)
            raise

    def _cut_back(self, offset: int) -> None:
        os.ftruncate(self._fd, offset)
        os.lseek(self._fd, offset, os.SEEK_SET)
        self._offset = offset
        self._metadata = [entry for entry in self._metadata if entry.offset < offset]

    def _summary(self) -> list[bytes]:
        """Return everything after the last chunk: data end, schemas, channels, indexes, statistics, footer."""
        data_end = _encode(records.DataEnd(0))
        start_ns, end_ns = self.span_ns
        statistics = records.Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=self.counts,
            chunk_count=len(self._chunks),
            message_count=self.count,
            message_start_time=start_ns,
            message_end_time=end_ns,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
        groups: dict[Opcode, Sequence[records.McapRecord]] = {
            Opcode.SCHEMA: self._schemas,
            Opcode.CHANNEL: self._channels,
            Opcode.CHUNK_INDEX: [chunk.index for chunk in self._chunks],
            Opcode.METADATA_INDEX: self._metadata,
            Opcode.STATISTICS: [statistics],
        }
        start = self._offset + len(data_end)
        summary = RecordBuilder()
        offsets: list[records.SummaryOffset] = []
        for opcode, group in groups.items():
            begin = summary.count
            for record in group:
                record.write(summary)
            if group:
                offsets.append(records.SummaryOffset(opcode, start + begin, summary.count - begin))
        offsets_start = start + summary.count
        for offset in offsets:
            offset.write(summary)
        data = summary.end()
        unsigned = _encode(records.Footer(start, offsets_start, 0))[:-4]
        crc = zlib.crc32(unsigned, zlib.crc32(data))
        return [data_end, data, unsigned, struct.pack("<I", crc), MAGIC]


def _if_full(error: OSError) -> OSError:
    """Return a disk-full error; raise any other."""
    if error.errno not in (errno.ENOSPC, errno.EDQUOT):
        raise error
    return error


def _encode(record: records.McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()
