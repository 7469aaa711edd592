"""The frame on the wire: topic, fixed header, CDR payload; three ZeroMQ message parts."""

from __future__ import annotations

import functools
import hashlib
import struct
from dataclasses import dataclass

from ..msg import type_hash

VERSION = 1
_HEADER = struct.Struct("<4sHHQq8s8s")
_MAGIC = b"IIC\0"
HEADER_SIZE = _HEADER.size


class FrameError(ValueError):
    """Bytes that are no frame of this version."""


@dataclass(frozen=True)
class FrameHeader:
    """What stands before the payload.

    Attributes:
        sequence: grows by one with each message of a publisher, from 1.
        publish_ns: the publisher's clock.
        publisher: 8 random bytes, new with every start of a publisher.
        type_digest: see :func:`type_digest`.
    """

    sequence: int
    publish_ns: int
    publisher: bytes
    type_digest: bytes

    def pack(self) -> bytes:
        """The header's 40 bytes."""
        return _HEADER.pack(_MAGIC, VERSION, 0, self.sequence, self.publish_ns, self.publisher, self.type_digest)

    @classmethod
    def unpack(cls, data: bytes | memoryview) -> FrameHeader:
        """Reads a header.

        Raises:
            FrameError: wrong length, magic or version.
        """
        if len(data) != HEADER_SIZE:
            raise FrameError(f"header of {len(data)} bytes, {HEADER_SIZE} expected")
        magic, version, _, sequence, publish_ns, publisher, digest = _HEADER.unpack(data)
        if magic != _MAGIC or version != VERSION:
            raise FrameError(f"not a frame of version {VERSION} (magic {magic!r}, version {version})")
        return cls(sequence, publish_ns, publisher, digest)


@functools.cache
def type_digest(type_name: str) -> bytes:
    """First 8 bytes of the SHA-256 of a type's name and RIHS01 hash: two sides agree on the type's fields."""
    return hashlib.sha256(f"{type_name} {type_hash(type_name)}".encode()).digest()[:8]
