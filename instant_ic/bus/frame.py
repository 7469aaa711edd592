"""Wire format of a topic (docs/wire.md). A message has two ZeroMQ parts: topic and header, and body."""

from __future__ import annotations

import functools
import struct

from instant_ic.msg import type_hash

VERSION = 4
MAGIC = b"IIC\0"

HEADER = struct.Struct("<BQQq8s8sQ")
"""Kind (:data:`INLINE` or :data:`SHARED`), mark, sequence, publication time in ns, publisher, type, CDR bytes."""

MARK = int.from_bytes(MAGIC + bytes([VERSION, 0, 0, 0]), "little")
"""Magic number and version as one integer."""

INLINE, SHARED = 0, 1
"""Kinds: the body is the CDR itself, or a :data:`REFERENCE` to it."""

REFERENCE = struct.Struct("<IIII")
"""Place of a message: process and file descriptor of its slot, slot number, smallest slot number still in use."""

KEY_COPY = b"="
"""Prefix of the topic's name in an inline copy of a shared message. Subscribers of the plain name do not get it."""

MOST_BYTES = 0xFFFFFFFF
"""Largest message, in bytes."""


class FrameError(ValueError):
    """The received parts are not a message of this version."""


Header = tuple[int, int, int, int, bytes, bytes, int]
"""The fields of :data:`HEADER`."""


def unpack_header(part: bytes) -> Header:
    """Check and parse the header at the end of a message's first part.

    Raises:
        FrameError: the part does not end with a header of this version.
    """
    at = len(part) - HEADER.size
    if at >= 0:
        header: Header = HEADER.unpack_from(part, at)
        kind, mark, sequence, *_, size = header
        if kind in (INLINE, SHARED) and mark == MARK and sequence and size <= MOST_BYTES:
            return header
    _, found, rest = part.partition(MAGIC)
    version = rest[0] if found and rest else "none"
    raise FrameError(f"not a frame of version {VERSION} (version {version}, {len(part)} bytes: {bytes(part[:16])!r})")


@functools.cache
def type_digest(type_name: str) -> bytes:
    """Return the first 8 bytes of a type's RIHS01 hash, which covers its name and its fields."""
    return bytes.fromhex(type_hash(type_name).removeprefix("RIHS01_")[:16])
