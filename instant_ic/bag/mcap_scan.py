"""Reads an MCAP file sequentially, without its index, as far as possible: complete, truncated or damaged."""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from mcap.opcode import Opcode

from instant_ic.bag.bounded import decompress
from instant_ic.bag.errors import BagError
from instant_ic.bag.mcap_writer import LIBRARY, MAGIC, Schema

_KNOWN_OPCODES = range(0x01, 0x10)  # opcodes from 0x80 on are private
_MOST_DAMAGED = 1000
"""Damaged records that are listed; a hostile file may contain nothing else."""
_UNREADABLE = (struct.error, IndexError, ValueError)  # UnicodeDecodeError is a ValueError


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
        metadata: metadata records, name → values; the last record of each name.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.whole = False
        self.stopped_by = ""
        self.damaged: list[str] = []
        self.metadata: dict[str, dict[str, str]] = {}
        self.library = ""
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, tuple[str, int, str, dict[str, str]]] = {}
        try:
            with path.open("rb") as file:
                size = path.stat().st_size
                # An empty file cannot be memory-mapped.
                self._data = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) if size else b"")
        except OSError as error:
            raise BagError(f"{path} cannot be read: {error.strerror}") from None
        if bytes(self._data[: len(MAGIC)]) != MAGIC[: len(self._data)]:
            raise BagError(f"{path} is not an MCAP file")

    def messages(self) -> Iterator[ScannedMessage]:
        """Yield every readable message, in file order."""
        data, at = self._data, len(MAGIC)
        while at < len(data):
            if len(data) - at < 9:
                self._stop(at, "the file ends inside a record header")
                return
            opcode, length = struct.unpack_from("<BQ", data, at)
            body, end = at + 9, at + 9 + length
            if opcode not in _KNOWN_OPCODES and opcode < 0x80:
                self._stop(at, f"{opcode:#04x} is not a valid opcode")
                return
            if opcode == Opcode.CHUNK:
                yield from self._chunk(data[body : min(end, len(data))], at, end <= len(data))
            elif opcode == Opcode.DATA_END:
                self.whole = end <= len(data) and bytes(data[-len(MAGIC) :]) == MAGIC
                if not self.whole:
                    self._stop(at, "the index after the messages is truncated")
                return
            elif end <= len(data):
                try:
                    yield from self._record(opcode, data[body:end])
                except _UNREADABLE as error:
                    self._damage(f"record at byte {at}: {error}")
            if end > len(data):
                self._stop(at, "the file ends inside a record")
                return
            at = end
        self._stop(at, "the file ends without an index")

    def _damage(self, text: str) -> None:
        if len(self.damaged) < _MOST_DAMAGED:
            self.damaged.append(text)

    def _stop(self, at: int, why: str) -> None:
        self.stopped_by = f"{self.path.name}, byte {at}: {why}"

    def _chunk(self, body: memoryview, at: int, complete: bool) -> Iterator[ScannedMessage]:
        try:
            _, _, size, crc = struct.unpack_from("<QQQI", body, 0)
            compression, offset = _string(body, 28)
            (stored_size,) = struct.unpack_from("<Q", body, offset)
            stored = body[offset + 8 : offset + 8 + stored_size]
            records = stored if compression == "" else memoryview(decompress(stored, compression, size))
        except _UNREADABLE as error:
            if complete:
                self._damage(f"chunk at byte {at}: {error}")
            return
        if complete and (len(records) != size or (crc and zlib.crc32(records) != crc)):
            self._damage(f"chunk at byte {at}: wrong checksum")
            return
        inner = 0
        while len(records) - inner >= 9:
            opcode, length = struct.unpack_from("<BQ", records, inner)
            end = inner + 9 + length
            if end > len(records) or (opcode not in _KNOWN_OPCODES and opcode < 0x80):
                return
            try:
                yield from self._record(opcode, records[inner + 9 : end])
            except _UNREADABLE as error:
                self._damage(f"record in the chunk at byte {at}: {error}")
            inner = end

    def _record(self, opcode: int, body: memoryview) -> Iterator[ScannedMessage]:
        if opcode == Opcode.MESSAGE:
            number, _, stamp_ns, publish_ns = struct.unpack_from("<HIQQ", body, 0)
            if number not in self._channels:
                raise ValueError(f"a message of unknown channel {number} (its definition was damaged)")
            topic, schema, encoding, metadata = self._channels[number]
            repeated = self.library == LIBRARY and publish_ns != stamp_ns
            known = self._schemas.get(schema, Schema("", "", "", ""))
            yield ScannedMessage(topic, known, encoding, metadata, stamp_ns, bytes(body[22:]), repeated)
        elif opcode == Opcode.SCHEMA:
            name, at = _string(body, 2)
            encoding, at = _string(body, at)
            text, at = _string(body, at)
            self._schemas[struct.unpack_from("<H", body)[0]] = Schema(name, encoding, text, "")
        elif opcode == Opcode.CHANNEL:
            number, schema = struct.unpack_from("<HH", body)
            topic, at = _string(body, 4)
            encoding, at = _string(body, at)
            self._channels[number] = (topic, schema, encoding, _string_map(body, at)[0])
        elif opcode == Opcode.METADATA:
            name, at = _string(body, 0)
            self.metadata[name] = _string_map(body, at)[0]
        elif opcode == Opcode.HEADER:
            _, at = _string(body, 0)
            self.library = _string(body, at)[0]


def _string(data: memoryview, at: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("<I", data, at)
    end = at + 4 + length
    if end > len(data):
        raise ValueError("a text is longer than its record")
    return str(data[at + 4 : end], "utf-8"), end


def _string_map(data: memoryview, at: int) -> tuple[dict[str, str], int]:
    (length,) = struct.unpack_from("<I", data, at)
    at, end = at + 4, at + 4 + length
    values = {}
    while at < end:
        key, at = _string(data, at)
        values[key], at = _string(data, at)
    return values, at
