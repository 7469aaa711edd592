"""Sequential reading of an MCAP file without its index, as far as a truncated or damaged file allows.

The readers of `mcap` and `rosbags` stop at a truncated end, or return a value that is too short. Here each record is
first cut out by its length, then parsed by the `mcap` package. Chunks are decompressed within the limits of
``bounded.py``.
"""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC as MAGIC

from instant_ic.bag.bounded import decompress
from instant_ic.bag.message import BagError, Schema

_MOST_DAMAGED = 1000
"""Limit of the list of damaged records, because a hostile file may contain nothing else."""
_HEAD = struct.Struct("<BQ")
_KINDS: dict[int, Any] = {
    Opcode.SCHEMA: records.Schema,
    Opcode.CHANNEL: records.Channel,
    Opcode.METADATA: records.Metadata,
}


@dataclass(frozen=True)
class ScannedMessage:
    """A message in an MCAP file.

    Attributes:
        channel: topic, encoding (``cdr`` in ROS 2 bags) and metadata, in which rosbag2 stores the QoS.
        stamp_ns: log time.
    """

    channel: records.Channel
    schema: Schema
    stamp_ns: int
    payload: bytes


class McapScan:
    """One pass over a file. The attributes are complete once :meth:`messages` is exhausted.

    Raises:
        BagError: the file cannot be opened, or is not an MCAP file.

    Attributes:
        stopped_by: reason why reading stopped before the end of the file; empty if the file was read to its end.
        damaged: descriptions of damaged chunks and records that were skipped.
        metadata: metadata records, name → values; the last record of each name.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.stopped_by = ""
        self.damaged: list[str] = []
        self.metadata: dict[str, dict[str, str]] = {}
        self._channels: dict[int, records.Channel] = {}
        self._schemas: dict[int, records.Schema] = {}
        self._data = _mapped(path)

    def messages(self) -> Iterator[ScannedMessage]:
        """Yield every readable message, in file order."""
        data, at, complete = self._data, 0, True
        for at, opcode, body, complete in _records(data, len(MAGIC)):
            if opcode == Opcode.DATA_END:
                if not complete or data[-len(MAGIC) :] != MAGIC:
                    self._stop(at, "the index after the messages is truncated")
                return
            if opcode == Opcode.CHUNK:
                yield from self._chunk(body, at, complete)
            elif complete and (message := self._record(opcode, body, f"record at byte {at}")):
                yield message
        if complete:
            self._stop(len(data), "the file ends without an index")
        else:
            self._stop(at, "the file ends inside a record")

    def _stop(self, at: int, why: str) -> None:
        self.stopped_by = f"{self.path.name}, byte {at}: {why}"

    def _damage(self, place: str, error: Exception) -> None:
        if len(self.damaged) < _MOST_DAMAGED:
            self.damaged.append(f"{place}: {error or 'a value is missing'}")

    def _chunk(self, body: memoryview, at: int, complete: bool) -> Iterator[ScannedMessage]:
        """Yield the messages of a chunk, or the complete messages at the start of an incomplete chunk."""
        try:
            content = _chunk_content(body, complete)
        except Exception as error:  # noqa: BLE001 - the parser may raise anything on damaged bytes
            if complete:
                self._damage(f"chunk at byte {at}", error)
            return
        for _, opcode, record, record_complete in _records(content, 0):
            if not record_complete:
                return
            if message := self._record(opcode, record, f"record in the chunk at byte {at}"):
                yield message

    def _record(self, opcode: int, body: memoryview, place: str) -> ScannedMessage | None:
        """Return a message, or store a definition. Unknown records of later format versions are ignored."""
        stream = _RecordBody(BytesIO(body))
        try:
            if opcode == Opcode.MESSAGE:
                return self._message(records.Message.read(stream, len(body)))
            if opcode in _KINDS:
                self._define(_KINDS[opcode].read(stream))
        except Exception as error:  # noqa: BLE001 - the parser may raise anything on damaged bytes
            self._damage(place, error)
        return None

    def _define(self, record: records.Schema | records.Channel | records.Metadata) -> None:
        if isinstance(record, records.Schema):
            self._schemas[record.id] = record
        elif isinstance(record, records.Channel):
            self._channels[record.id] = record
        else:
            self.metadata[record.name] = record.metadata

    def _message(self, message: records.Message) -> ScannedMessage:
        """Return a message with its definition. A definition in an encoding other than ROS 2's is left empty.

        Raises:
            ValueError: the message's topic is unknown, or its definition is not text.
        """
        channel = self._channels.get(message.channel_id)
        if channel is None:
            raise ValueError(f"a message of unknown channel {message.channel_id} (its definition was damaged)")
        found = self._schemas.get(channel.schema_id)
        schema = Schema(found.name if found is not None else "", "", "", "")
        if found is not None and found.encoding in ("ros2msg", "ros2idl", "omgidl"):
            schema = Schema(found.name, found.encoding, str(found.data, "utf-8"), "")
        return ScannedMessage(channel, schema, message.log_time, message.data)


class _RecordBody(ReadDataStream):
    """The body of a record. Reading a value that is longer than the body is an error."""

    def read(self, length: int) -> bytes:
        data = super().read(length) if length else b""
        if len(data) < length:
            raise ValueError("a value is longer than its record")
        return data


def _mapped(path: Path) -> memoryview:
    """Return the bytes of a file.

    Raises:
        BagError: the file cannot be opened, or does not begin like an MCAP file.
    """
    try:
        with path.open("rb") as file:
            # An empty file cannot be memory-mapped.
            size = path.stat().st_size
            data = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) if size else b"")
    except OSError as error:
        raise BagError(f"{path} cannot be read: {error.strerror}") from None
    if bytes(data[: len(MAGIC)]) != MAGIC[: len(data)]:
        raise BagError(f"{path} is not an MCAP file")
    return data


def _records(data: memoryview, at: int) -> Iterator[tuple[int, int, memoryview, bool]]:
    """Yield offset, opcode, body and completeness of each record. Only the last record may be incomplete."""
    while at < len(data):
        opcode, length = _HEAD.unpack_from(data, at) if at + _HEAD.size <= len(data) else (0, len(data))
        begin, end = at + _HEAD.size, at + _HEAD.size + length
        yield at, opcode, data[begin:end], end <= len(data)
        at = end


def _chunk_content(body: memoryview, complete: bool) -> memoryview:
    """Return the records of a chunk, or the readable part of an incomplete chunk.

    Raises:
        Exception: the chunk is damaged, or larger than declared or allowed.
    """
    chunk = records.Chunk.read(ReadDataStream(BytesIO(body)))
    content = decompress(chunk.data, chunk.compression, chunk.uncompressed_size)
    checksum = chunk.uncompressed_crc
    if complete and (len(content) != chunk.uncompressed_size or (checksum and zlib.crc32(content) != checksum)):
        raise ValueError("wrong checksum")
    return memoryview(content)
