"""Wire format of a topic's socket: a greeting first, then frames with a fixed header.

Publisher to reader: ``HELLO`` (JSON: node, topic and type), then ``DATA`` (CDR bytes) and ``SHARED`` (a place in
shared memory; with a buffer that is new to the reader comes its file descriptor). ``RETIRED`` names a buffer that will
not be used again. Reader to publisher: one :data:`GREETING`, then the number (:data:`BUFFER_ID`) of each buffer that
the reader has finished with.
"""

from __future__ import annotations

import functools
import hashlib
import json
import struct
from dataclasses import dataclass

from instant_ic.msg import type_hash

VERSION = 2
MAGIC = b"IIC\0"

HELLO, DATA, SHARED, RETIRED = (int.from_bytes(MAGIC + bytes([VERSION, kind, 0, 0]), "little") for kind in (1, 2, 3, 4))
"""Frame kinds: magic, version and kind in one number, so that one comparison checks all three."""

HEADER = struct.Struct("<QIIQq")
"""Kind, messages skipped for this reader, size of the body in bytes, sequence, publication time in ns."""

SHARED_BODY = struct.Struct("<IIQ")
"""Buffer number, 1 if its file descriptor comes with this frame, size of the message in bytes."""

BUFFER_ID = struct.Struct("<I")

GREETING = struct.Struct("<4sB?2xI")
"""Magic, version, whether the reader supports shared memory, its queue length (1: the newest message only)."""

MOST_BYTES = 0xFFFFFFFF
"""Largest body, in bytes."""


class FrameError(ValueError):
    """The bytes are not a frame of this version."""


@dataclass(frozen=True)
class Hello:
    """A publisher's greeting to a new reader.

    Attributes:
        node: name of its node.
        topic: full name.
        type_name: for example ``sensor_msgs/msg/Image``.
        digest: see :func:`type_digest`.
        publisher: 8 random bytes in hex, new at every start.
    """

    node: str
    topic: str
    type_name: str
    digest: str
    publisher: str

    def pack(self) -> bytes:
        """The whole frame."""
        body = json.dumps(self.__dict__).encode()
        return HEADER.pack(HELLO, 0, len(body), 0, 0) + body

    @classmethod
    def unpack(cls, body: bytes) -> Hello:
        """Parse the body of a ``HELLO`` frame.

        Raises:
            FrameError: the body is not a publisher's greeting.
        """
        try:
            values = json.loads(body)
            hello = cls(**values)
        except (ValueError, TypeError, RecursionError) as error:
            raise FrameError(f"unreadable greeting: {error}") from None
        if not all(isinstance(value, str) for value in values.values()):
            raise FrameError("greeting with fields that are not text")
        return hello


def check_kind(kind: int) -> None:
    """Check that a frame is of a known kind.

    Raises:
        FrameError: not a kind of this version.
    """
    if kind not in (HELLO, DATA, SHARED, RETIRED):
        words = kind.to_bytes(8, "little")
        raise FrameError(f"not a frame of version {VERSION} (magic {words[:4]!r}, version {words[4]}, kind {words[5]})")


@functools.cache
def type_digest(type_name: str) -> str:
    """First 16 hex digits of the SHA-256 of a type's name and RIHS01 hash; equal digests mean equal fields."""
    return hashlib.sha256(f"{type_name} {type_hash(type_name)}".encode()).hexdigest()[:16]
