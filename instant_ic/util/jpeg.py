"""Completeness and size of a JPEG, found without decoding it (ITU-T T.81, annex B)."""

from __future__ import annotations

SOI = b"\xff\xd8"
EOI = b"\xff\xd9"

_START_OF_FRAME = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_WITHOUT_LENGTH = frozenset((0x01, *range(0xD0, 0xD8)))


class JpegError(ValueError):
    """The bytes are not a complete JPEG."""


def check_whole(data: bytes | bytearray) -> None:
    """Check that the data starts and ends like a JPEG.

    Raises:
        JpegError: the start or end marker is missing.
    """
    if data[:2] != SOI:
        raise JpegError(f"starts with {bytes(data[:2]).hex() or 'nothing'} instead of ffd8 (SOI)")
    if data[-2:] != EOI:
        raise JpegError(f"ends with {bytes(data[-2:]).hex()} instead of ffd9 (EOI): the data is truncated")


def jpeg_size(data: bytes | bytearray) -> tuple[int, int]:
    """Return (width, height) from the frame header.

    Raises:
        JpegError: there is no frame header before the image data.
    """
    if data[:2] != SOI:
        raise JpegError(f"starts with {bytes(data[:2]).hex() or 'nothing'} instead of ffd8 (SOI)")
    at = 2
    while at + 4 <= len(data):
        if data[at] != 0xFF:
            raise JpegError(f"no marker at byte {at}")
        marker = data[at + 1]
        if marker == 0xFF:  # fill byte
            at += 1
            continue
        if marker in _WITHOUT_LENGTH:
            at += 2
            continue
        length = data[at + 2] << 8 | data[at + 3]
        if marker in _START_OF_FRAME:
            if at + 9 > len(data):
                break
            return data[at + 7] << 8 | data[at + 8], data[at + 5] << 8 | data[at + 6]
        if marker == 0xDA or length < 2:
            break
        at += 2 + length
    raise JpegError("has no frame header")
