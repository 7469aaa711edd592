"""Records of MCAP files (https://mcap.dev/spec), parsed by the `mcap` package within the limits of ``bounded.py``.

The package's readers are used for the summary alone. In the data section they decompress without limit, return a short
value for a record that is cut, and pass over messages that no index lists.
"""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode

from instant_ic.bag.bounded import decompress
from instant_ic.bag.errors import BagError
from instant_ic.bag.mcap_writer import MAGIC, Schema

MESSAGE_HEAD = struct.Struct("<HIQQ")
"""Channel, sequence, log time and publish time; the payload follows."""
_HEAD = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQII")
_KINDS: dict[int, Any] = {
    Opcode.HEADER: records.Header,
    Opcode.SCHEMA: records.Schema,
    Opcode.CHANNEL: records.Channel,
    Opcode.METADATA: records.Metadata,
}


class _Body(ReadDataStream):
    """The body of a record; a value that is longer than it is an error."""

    def read(self, length: int) -> bytes:
        data = super().read(length) if length else b""
        if len(data) < length:
            raise ValueError("a value is longer than its record")
        return data


class Definitions:
    """Schemas, channels and metadata records of a file, as far as it has been read."""

    def __init__(self) -> None:
        self.library = ""
        self.schemas: dict[int, records.Schema] = {}
        self.channels: dict[int, records.Channel] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        """The last metadata record of each name."""

    def take(self, opcode: int, body: memoryview) -> None:
        """Store a record; other kinds are ignored, and so are those of later versions of the format.

        Raises:
            ValueError: it is damaged.
        """
        if opcode not in _KINDS:
            return
        try:
            record = _KINDS[opcode].read(_Body(BytesIO(body)))
        except Exception as error:  # noqa: BLE001 - the parser may raise anything on damaged bytes
            raise ValueError(str(error) or "a value is missing") from None
        if isinstance(record, records.Schema):
            self.schemas[record.id] = record
        elif isinstance(record, records.Channel):
            self.channels[record.id] = record
        elif isinstance(record, records.Metadata):
            self.metadata[record.name] = record.metadata
        else:
            self.library = record.library

    def schema_of(self, channel: records.Channel) -> Schema:
        """Return the definition of a channel's type; without text where it is in no encoding of ROS 2."""
        schema = self.schemas.get(channel.schema_id)
        if schema is None:
            return Schema("", "", "", "")
        if schema.encoding not in ("ros2msg", "ros2idl", "omgidl"):
            return Schema(schema.name, "", "", "")
        return Schema(schema.name, schema.encoding, str(schema.data, "utf-8"), "")


def mapped(path: Path) -> memoryview:
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


def records_of(data: memoryview, at: int, end: int) -> Iterator[tuple[int, int, memoryview, bool]]:
    """Yield place, opcode and body of each record in ``data[at:end]``, and whether it is complete.

    Only the last one may be incomplete; its opcode is 0 if not even its head is there.
    """
    while at < end:
        opcode, length = _HEAD.unpack_from(data, at) if at + _HEAD.size <= end else (0, end)
        begin, at_next = at + _HEAD.size, at + _HEAD.size + length
        yield at, opcode, data[begin : min(at_next, end)], at_next <= end
        at = at_next


def chunk_content(body: memoryview, complete: bool = True) -> tuple[str, memoryview]:
    """Return the compression of a chunk, and its records.

    Args:
        body: body of the chunk's record.
        complete: whether the body is; the records of an incomplete one end where it ends.

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
    return compression, content
