"""Reads an MCAP file from its beginning, without its index, as far as possible: complete, truncated or damaged.

The readers of `mcap` and `rosbags` stop at a truncated end, or return a value that is too short. Here each record is
cut out by its length first, then parsed by the `mcap` package; chunks are decompressed within the limits of
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

from instant_ic.bag.bounded import decompress
from instant_ic.bag.mcap_writer import LIBRARY, MAGIC, Schema
from instant_ic.bag.message import BagError

_MOST_DAMAGED = 1000
"""Damaged records that are listed; a hostile file may contain nothing else."""
_HEAD = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQII")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
"""Channel, sequence, log time and publish time; the payload follows."""
_KINDS: dict[int, Any] = {
    Opcode.HEADER: records.Header,
    Opcode.SCHEMA: records.Schema,
    Opcode.CHANNEL: records.Channel,
    Opcode.METADATA: records.Metadata,
}


@dataclass(frozen=True)
class ScannedMessage:
    """A message in an MCAP file.

    Attributes:
        encoding: encoding of the payload; ``cdr`` in ROS 2 bags.
        metadata: metadata of its topic, where rosbag2 stores the QoS.
        stamp_ns: log time.
        repeated: whether it repeats a latched value of an earlier file of the bag.
    """

    topic: str
    schema: Schema
    encoding: str
    metadata: dict[str, str]
    stamp_ns: int
    payload: bytes
    repeated: bool


class McapScan:
    """One pass over a file. The attributes are complete once :meth:`messages` is exhausted.

    Raises:
        BagError: the file cannot be opened, or is not an MCAP file.

    Attributes:
        whole: whether the end of the file is intact.
        stopped_by: reason why reading stopped before the end of the file; empty when it did not.
        damaged: descriptions of damaged chunks that were skipped.
        library: the writer that the header names.
        metadata: metadata records, name → values; the last record of each name.
        channels: topics by number.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.whole = False
        self.stopped_by = ""
        self.damaged: list[str] = []
        self.library = ""
        self.metadata: dict[str, dict[str, str]] = {}
        self.channels: dict[int, records.Channel] = {}
        self._schemas: dict[int, records.Schema] = {}
        self._data = _mapped(path)

    def messages(self) -> Iterator[ScannedMessage]:
        """Yield every readable message, in file order."""
        data = self._data
        for at, opcode, body, complete in _records(data, len(MAGIC), len(data)):
            if not opcode:
                self._stop(at, "no valid record begins here")
                return
            if opcode == Opcode.CHUNK:
                yield from self._chunk(body, at, complete)
            elif opcode == Opcode.DATA_END:
                self.whole = complete and data[-len(MAGIC) :] == MAGIC
                if not self.whole:
                    self._stop(at, "the index after the messages is truncated")
                return
            elif complete:
                yield from self._record(opcode, body, f"record at byte {at}")
            if not complete:
                self._stop(at, "the file ends inside a record")
                return
        self._stop(len(data), "the file ends without an index")

    def schema_of(self, channel: records.Channel) -> Schema:
        """Return the definition of a channel's type; without text where it is in no encoding of ROS 2.

        Raises:
            UnicodeDecodeError: the definition is no text.
        """
        schema = self._schemas.get(channel.schema_id)
        if schema is None:
            return Schema("", "", "", "")
        if schema.encoding not in ("ros2msg", "ros2idl", "omgidl"):
            return Schema(schema.name, "", "", "")
        return Schema(schema.name, schema.encoding, str(schema.data, "utf-8"), "")

    def _damage(self, text: str) -> None:
        if len(self.damaged) < _MOST_DAMAGED:
            self.damaged.append(text)

    def _stop(self, at: int, why: str) -> None:
        self.stopped_by = f"{self.path.name}, byte {at}: {why}"

    def _chunk(self, body: memoryview, at: int, complete: bool) -> Iterator[ScannedMessage]:
        try:
            content = _chunk_content(body, complete)
        except ValueError as error:
            if complete:
                self._damage(f"chunk at byte {at}: {error}")
            return
        for _, opcode, record, record_complete in _records(content, 0, len(content)):
            if not (opcode and record_complete):
                return
            yield from self._record(opcode, record, f"record in the chunk at byte {at}")

    def _record(self, opcode: int, body: memoryview, place: str) -> Iterator[ScannedMessage]:
        try:
            if opcode != Opcode.MESSAGE:
                self._define(opcode, body)
                return
            number, _, stamp_ns, publish_ns = _MESSAGE_HEAD.unpack_from(body)
            if number not in self.channels:
                raise ValueError(f"a message of unknown channel {number} (its definition was damaged)")
            channel = self.channels[number]
            schema = self.schema_of(channel)
        except (struct.error, ValueError) as error:  # UnicodeDecodeError is a ValueError
            self._damage(f"{place}: {error}")
            return
        repeated = self.library == LIBRARY and publish_ns != stamp_ns
        payload = bytes(body[_MESSAGE_HEAD.size :])
        yield ScannedMessage(
            channel.topic, schema, channel.message_encoding, channel.metadata, stamp_ns, payload, repeated
        )

    def _define(self, opcode: int, body: memoryview) -> None:
        """Store a record that is no message; unknown kinds, as of later versions of the format, are ignored.

        Raises:
            ValueError: it is damaged.
        """
        if opcode not in _KINDS:
            return
        try:
            record = _KINDS[opcode].read(_RecordBody(BytesIO(body)))
        except Exception as error:  # noqa: BLE001 - the parser may raise anything on damaged bytes
            raise ValueError(str(error) or "a value is missing") from None
        if isinstance(record, records.Schema):
            self._schemas[record.id] = record
        elif isinstance(record, records.Channel):
            self.channels[record.id] = record
        elif isinstance(record, records.Metadata):
            self.metadata[record.name] = record.metadata
        else:
            self.library = record.library


class _RecordBody(ReadDataStream):
    """The body of a record; a value that is longer than the body is an error."""

    def read(self, length: int) -> bytes:
        data = super().read(length) if length else b""
        if len(data) < length:
            raise ValueError("a value is longer than its record")
        return data


def _mapped(path: Path) -> memoryview:
    """Return the bytes of a file.

    Raises:
        BagError: it cannot be opened, or does not begin as an MCAP file.
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


def _records(data: memoryview, at: int, end: int) -> Iterator[tuple[int, int, memoryview, bool]]:
    """Yield place, opcode and body of each record in ``data[at:end]``, and whether it is complete.

    Only the last one may be incomplete; its opcode is 0 if not even its head is there.
    """
    while at < end:
        opcode, length = _HEAD.unpack_from(data, at) if at + _HEAD.size <= end else (0, end)
        begin, at_next = at + _HEAD.size, at + _HEAD.size + length
        yield at, opcode, data[begin : min(at_next, end)], at_next <= end
        at = at_next


def _chunk_content(body: memoryview, complete: bool) -> memoryview:
    """Return the records of a chunk; those of an incomplete chunk end where it ends.

    Raises:
        ValueError: it is damaged, or larger than declared or allowed.
    """
    try:
        _, _, size, crc, length = _CHUNK_HEAD.unpack_from(body)
        at = _CHUNK_HEAD.size + length
        compression = str(body[_CHUNK_HEAD.size : at], "utf-8")
        (stored_size,) = struct.unpack_from("<Q", body, at)
    except struct.error as error:
        raise ValueError(str(error)) from None
    stored = body[at + 8 : at + 8 + stored_size]
    content = stored if compression == "" else memoryview(decompress(stored, compression, size))
    if complete and (len(content) != size or (crc and zlib.crc32(content) != crc)):
        raise ValueError("wrong checksum")
    return content
