"""Writes one MCAP file (https://mcap.dev/spec) in chunks, without copying the payloads.

Each chunk is one gathered write, so the file always ends with a complete chunk. On a full disk the writer truncates
the file to the last complete chunk. The index at the end is built from memory.
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

from instant_ic.private import open_file

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(0x01, 0x09)
STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = 0x0B, 0x0C, 0x0D, 0x0E, 0x0F

CHUNK_BYTES = 1 << 20
"""A chunk is closed once it is larger than this."""

_LIBRARY = "instant_ic"
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
    """Index entry of a chunk, written at the end of the file."""

    start_ns: int
    end_ns: int
    offset: int
    length: int
    end_offset: int
    index_offsets: dict[int, int]
    compressed_size: int
    size: int
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
        self._compressor: Any = None
        if compressed:
            import zstandard

            self._compressor = zstandard.ZstdCompressor(level=level)
        self._fd = open_file(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL)
        self._offset = 0
        self._schemas: dict[int, bytes] = {}
        self._channels: dict[int, tuple[int, bytes]] = {}
        self._chunks: list[_Chunk] = []
        self._metadata: list[tuple[int, int, str]] = []
        self._clear()
        try:
            self._put([MAGIC, *_record(HEADER, _string("ros2") + _string(_LIBRARY))])
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
        body = struct.pack("<H", number) + _string(schema.name) + _string(schema.encoding) + _string(schema.text)
        self._schemas[number] = b"".join(_record(SCHEMA, body))
        self._append(self._schemas[number])
        return number

    def add_channel(self, topic: str, schema: int, metadata: Mapping[str, str]) -> int:
        """Add a topic with its type and return its number in this file."""
        number = len(self._channels) + 1
        body = struct.pack("<HH", number, schema) + _string(topic) + _string("cdr") + _string_map(metadata)
        self._channels[number] = (schema, b"".join(_record(CHANNEL, body)))
        self._append(self._channels[number][1])
        return number

    def write(self, channel: int, stamp_ns: int, payload: Buffer, publish_ns: int | None = None) -> None:
        """Append one message; ``payload`` must not change until its chunk is written.

        Raises:
            OSError: the disk is full; the file then ends with the last complete chunk.
        """
        self._index.setdefault(channel, []).append((stamp_ns, self._chunk_bytes))
        publish = stamp_ns if publish_ns is None else publish_ns
        self._append(struct.pack("<BQHIQQ", MESSAGE, 22 + len(payload), channel, 0, stamp_ns, publish))
        self._append(payload)
        if self._chunk_bytes > CHUNK_BYTES or len(self._parts) > 100_000:
            self.flush()

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write a metadata record before the open chunk.

        Raises:
            OSError: the disk is full.
        """
        record = b"".join(_record(METADATA, _string(name) + _string_map(values)))
        self._metadata.append((self._offset, len(record), name))
        try:
            self._put([record])
        except OSError:
            self._metadata.pop()
            raise

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
        kind = _string("zstd" if self.compressed else "")
        head = struct.pack("<QQQI", start_ns, end_ns, size, crc) + kind + struct.pack("<Q", stored_size)
        length = 9 + len(head) + stored_size
        tail, offsets, at = [], {}, self._offset + length
        for channel, entries in index.items():
            flat = [number for entry in entries for number in entry]
            body = struct.pack(f"<HI{len(flat)}Q", channel, 8 * len(flat), *flat)
            offsets[channel] = at
            tail.append(b"".join(_record(MESSAGE_INDEX, body)))
            at += len(tail[-1])
        counts = {channel: len(entries) for channel, entries in index.items()}
        chunk = _Chunk(start_ns, end_ns, self._offset, length, at, offsets, stored_size, size, counts)
        self._put([struct.pack("<BQ", CHUNK, len(head) + stored_size), head, *stored, *tail])
        self._chunks.append(chunk)

    def finish(self) -> OSError | None:
        """Write index and footer and close the file. On a full disk, drop the last chunks to make room for them.

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
                    return full
                except OSError as error:
                    full = _if_full(error)
                    if not self._chunks:
                        raise
                    self._cut_back(self._chunks.pop().offset)
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
        return sum(sum(chunk.counts.values()) for chunk in self._chunks)

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last stamp in complete chunks; (0, 0) if there are none."""
        if not self._chunks:
            return 0, 0
        return min(c.start_ns for c in self._chunks), max(c.end_ns for c in self._chunks)

    @property
    def counts(self) -> dict[int, int]:
        """Messages in complete chunks, by channel."""
        counts = dict.fromkeys(self._channels, 0)
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
        self._metadata = [entry for entry in self._metadata if entry[0] < offset]

    def _summary(self) -> list[bytes]:
        """Return everything after the last chunk: data end, schemas, channels, indexes, statistics, footer."""
        data_end = b"".join(_record(DATA_END, struct.pack("<I", 0)))
        summary_start = self._offset + len(data_end)
        used = self.counts
        channels = [record for _, record in self._channels.values()]
        start_ns, end_ns = self.span_ns
        statistics = struct.pack(
            "<QHIIIIQQI",
            sum(used.values()),
            len(self._schemas),
            len(self._channels),
            0,
            len(self._metadata),
            len(self._chunks),
            start_ns,
            end_ns,
            10 * len(used),
        ) + b"".join(struct.pack("<HQ", channel, count) for channel, count in used.items())
        groups = [
            (SCHEMA, list(self._schemas.values())),
            (CHANNEL, channels),
            (CHUNK_INDEX, [b"".join(_record(CHUNK_INDEX, self._chunk_index(chunk))) for chunk in self._chunks]),
            (METADATA_INDEX, [b"".join(_record(METADATA_INDEX, struct.pack("<QQ", at, size) + _string(name)))
                              for at, size, name in self._metadata]),
            (STATISTICS, [b"".join(_record(STATISTICS, statistics))]),
        ]  # fmt: skip
        records: list[bytes] = []
        offsets: list[bytes] = []
        at = summary_start
        for opcode, group in groups:
            size = sum(len(record) for record in group)
            if group:
                offsets.append(b"".join(_record(SUMMARY_OFFSET, struct.pack("<BQQ", opcode, at, size))))
            records += group
            at += size
        footer = struct.pack("<BQQQ", FOOTER, 20, summary_start, at)
        crc = 0
        for part in (*records, *offsets, footer):
            crc = zlib.crc32(part, crc)
        return [data_end, *records, *offsets, footer, struct.pack("<I", crc), MAGIC]

    def _chunk_index(self, chunk: _Chunk) -> bytes:
        offsets = b"".join(struct.pack("<HQ", channel, at) for channel, at in chunk.index_offsets.items())
        index_length = chunk.end_offset - chunk.offset - chunk.length
        return (
            struct.pack("<QQQQI", chunk.start_ns, chunk.end_ns, chunk.offset, chunk.length, len(offsets))
            + offsets
            + struct.pack("<Q", index_length)
            + _string("zstd" if self.compressed else "")
            + struct.pack("<QQ", chunk.compressed_size, chunk.size)
        )


def _if_full(error: OSError) -> OSError:
    """Return a disk-full error; raise any other."""
    if error.errno not in (errno.ENOSPC, errno.EDQUOT):
        raise error
    return error


def _record(opcode: int, body: bytes) -> tuple[bytes, bytes]:
    return struct.pack("<BQ", opcode, len(body)), body


def _string(text: str) -> bytes:
    data = text.encode()
    return struct.pack("<I", len(data)) + data


def _string_map(values: Mapping[str, str]) -> bytes:
    body = b"".join(_string(key) + _string(value) for key, value in values.items())
    return struct.pack("<I", len(body)) + body
