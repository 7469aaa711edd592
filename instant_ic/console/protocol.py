"""WebSocket protocol of the console: JSON text messages, and binary frames for images and maps.

Binary frame, little endian::

    offset 0   uint8   version (1)
    offset 1   uint8   kind (FrameKind)
    offset 2   uint16  0
    offset 4   uint32  sequence number, counted for each kind and client
    offset 8   uint32  length of the header, bytes
    offset 12          header: JSON, UTF-8
    then               payload: JPEG or PNG; for LAYERS the parts of all layers, by the ranges in the header; for PART
                       a piece, from byte ``start`` on, of a frame with ``size`` bytes

docs/console.md lists the messages. static/messages.js lists the fields of the headers and of messages to the page.
"""

from __future__ import annotations

import json
import math
import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

VERSION = 1
PREFIX = struct.Struct("<BBHII")


class PageProtocolError(ValueError):
    """A message violates the protocol; the error names the field and its value."""


class FrameKind(IntEnum):
    """Content of a binary frame."""

    PANORAMA = 1  # equirect JPEG as the camera sent it
    VIEW = 2  # perspective JPEG of the virtual space
    MAP = 3  # 8-bit grey PNG: 0..100 occupied %, 255 unknown; row 0 is the highest y
    COSTMAP = 4  # the same layout; 0..100 cost
    LAYERS = 5  # the virtual space as layers of triangles
    PART = 6  # piece of the payload of a frame that is too large for one message


@dataclass(frozen=True)
class PageFrame:
    """One binary frame."""

    kind: FrameKind
    sequence: int
    header: dict[str, Any]
    payload: bytes


@dataclass(frozen=True)
class PendingFrame:
    """A frame that has no sequence number yet; ``payload`` is JPEG or PNG."""

    header: dict[str, Any]
    payload: bytes

    def frame(self, held: frozenset[str]) -> tuple[dict[str, Any], bytes]:
        """Return header and payload, like ``PageLayers.frame``."""
        return self.header, self.payload


def encode_frame(frame: PageFrame) -> bytes:
    """Encode ``frame`` as one binary WebSocket message."""
    header = json.dumps(frame.header, separators=(",", ":"), allow_nan=False).encode()
    return PREFIX.pack(VERSION, frame.kind, 0, frame.sequence, len(header)) + header + frame.payload


def decode_frame(data: bytes) -> PageFrame:
    """Decode one binary WebSocket message.

    Raises:
        PageProtocolError: the message is too short or of unknown version or kind, or its header is not a JSON object.
    """
    if len(data) < PREFIX.size:
        raise PageProtocolError(f"binary frame of {len(data)} bytes is shorter than its prefix of {PREFIX.size} bytes")
    version, kind, _, sequence, header_length = PREFIX.unpack_from(data)
    if version != VERSION:
        raise PageProtocolError(f"binary frame of version {version}: expected {VERSION}")
    end = PREFIX.size + header_length
    if end > len(data):
        raise PageProtocolError(f"binary frame of {len(data)} bytes: its header should end at {end}")
    try:
        frame_kind = FrameKind(kind)
        header = json.loads(data[PREFIX.size : end])
    except (ValueError, RecursionError) as error:  # UnicodeDecodeError and JSONDecodeError are ValueErrors too
        raise PageProtocolError(f"binary frame: {error}") from None
    if not isinstance(header, dict):
        raise PageProtocolError(f"binary frame: header is {type(header).__name__}, not an object")
    return PageFrame(frame_kind, sequence, header, data[end:])


class Parts:
    """Assembler of a frame that arrives in pieces, in order."""

    def __init__(self) -> None:
        self._data = bytearray()

    def take(self, part: PageFrame) -> PageFrame | None:
        """Add a piece; return the frame once it is complete.

        Raises:
            PageProtocolError: a piece is missing, or the pieces do not form a frame.
        """
        start, size = part.header.get("start"), part.header.get("size")
        if start == 0:
            self._data.clear()
        if start != len(self._data):
            raise PageProtocolError(f"part.start must be {len(self._data)} (got {start})")
        self._data += part.payload
        if len(self._data) != size:
            return None
        whole = bytes(self._data)
        self._data.clear()
        return decode_frame(whole)


def parse_text(text: str) -> dict[str, Any]:
    """Parse a JSON object with a string ``type``. Raise PageProtocolError for anything else."""
    try:
        message = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise PageProtocolError(f"text message is not valid JSON: {error}") from None
    if not isinstance(message, dict) or not isinstance(message.get("type"), str):
        raise PageProtocolError("text message must be an object with a string 'type'")
    return message


def number(message: dict[str, Any], key: str, low: float = -math.inf, high: float = math.inf) -> float:
    """Return ``message[key]`` as a finite number in [low, high]. Raise PageProtocolError if it is not."""
    value = message.get(key)
    # json.loads accepts NaN, Infinity and integers of any length, which must not reach a motor.
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(_as_float(value)):
        raise PageProtocolError(f"{message['type']}.{key} must be a finite number (got {value!r:.40})")
    if not low <= value <= high:
        raise PageProtocolError(f"{message['type']}.{key} must be in [{low:g}, {high:g}] (got {value:g})")
    return float(value)


def whole(message: dict[str, Any], key: str) -> int:
    """Return ``message[key]`` as an integer in [0, 2**53]. Raise PageProtocolError if it is not."""
    value = message.get(key)
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= 2**53:
        raise PageProtocolError(f"{message['type']}.{key} must be an integer from 0 to 2**53 (got {value!r:.40})")
    return value


def flag(message: dict[str, Any], key: str, default: bool | None = None) -> bool:
    """Return ``message[key]`` as a bool. Raise PageProtocolError for another type, or a missing key without default."""
    value = message.get(key, default)
    if not isinstance(value, bool):
        raise PageProtocolError(f"{message['type']}.{key} must be true or false (got {value!r:.40})")
    return value


def _as_float(value: int | float) -> float:
    try:
        return float(value)
    except OverflowError:
        return math.inf
