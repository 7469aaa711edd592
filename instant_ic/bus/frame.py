"""Wire format of a topic (docs/wire.md): a message is three ZeroMQ parts, namely key, header and payload."""

from __future__ import annotations

import functools
import struct

from instant_ic.msg import type_hash

VERSION = 3
MAGIC = b"IIC\0"

HEADER = struct.Struct("<QQq8s8sQ")
"""Mark (:data:`INLINE` or :data:`SHARED`), sequence, publication time in ns, publisher, type, size of the payload."""

INLINE, SHARED = (int.from_bytes(MAGIC + bytes([VERSION, kind, 0, 0]), "little") for kind in (0, 1))
"""Magic, version and kind in one number: the third part is the payload itself, or a :data:`REFERENCE` to it."""

REFERENCE = struct.Struct("<IIII")
"""Where a payload lies: process and descriptor of its slot, number of the slot, smallest number still in use."""

KEY_INLINE, KEY_SHARED = b"\0", b"\1"
"""What follows the topic's name in the key: the third part is the payload, or a reference to it."""

KEY_COPY = b"="
"""What precedes the name in the key of the inline copy of a referenced message; readers of the name do not get it."""

MOST_BYTES = 0xFFFFFFFF
"""Largest payload, in bytes."""


class FrameError(ValueError):
    """The parts are not a message of this version."""


Header = tuple[int, int, int, bytes, bytes, int]
"""The fields of :data:`HEADER`."""


def unpack_header(data: bytes) -> Header:
    """Check and parse the second part of a message.

    Raises:
        FrameError: it is not a header of this version.
    """
    if len(data) == HEADER.size:
        header: Header = HEADER.unpack(data)
        if header[0] in (INLINE, SHARED) and header[1] and header[5] <= MOST_BYTES:
            return header
    version = data[4] if data[:4] == MAGIC and len(data) > 4 else "none"
    raise FrameError(f"not a frame of version {VERSION} (version {version}, {len(data)} bytes: {bytes(data[:16])!r})")


@functools.cache
def type_digest(type_name: str) -> bytes:
    """First 8 bytes of a type's RIHS01 hash, which covers its name and its fields."""
    return bytes.fromhex(type_hash(type_name).removeprefix("RIHS01_")[:16])
