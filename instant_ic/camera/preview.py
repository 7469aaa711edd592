"""Parser of the multipart stream of ``camera.getLivePreview``, which standard multipart parsers cannot read.

Its parts begin with the literal ``---osclivepreview---``, without the two additional dashes of RFC 2046. Other firmware
and other cameras follow the RFC. The parser therefore reads each part by its Content-Length and searches for the
boundary only after a truncated part.
"""

import re

from instant_ic.util.jpeg import JpegError, check_whole

_HEADER_END = b"\r\n\r\n"
_LENGTH = re.compile(rb"content-length[ \t]*:[ \t]*(\d{1,12})", re.IGNORECASE)
_MAX_HEADER = 4096
_BOUNDARY = "osclivepreview"


class PreviewParser:
    """Parser of the preview's stream: takes chunks of any size and returns complete JPEGs.

    Attributes:
        bad_frames: number of dropped parts: truncated, not a JPEG, or without a usable length.
        last_fault: text of the reason for the last drop.
    """

    def __init__(self, boundary: str = _BOUNDARY, max_frame_bytes: int = 4 << 20) -> None:
        """Start before the first part.

        Args:
            boundary: boundary from the Content-Type; dashes and quotes around it are ignored.
            max_frame_bytes: largest accepted part.
        """
        self.bad_frames = 0
        self.last_fault = ""
        self._boundary = (boundary.strip("\"' \t-") or _BOUNDARY).encode("ascii", "replace")
        self._max_frame_bytes = max_frame_bytes
        self._buffer = bytearray()
        self._length: int | None = None

    @property
    def waiting(self) -> int:
        """Number of bytes that wait for the rest of a part."""
        return len(self._buffer)

    def feed(self, data: bytes) -> list[bytes]:
        """Take the next chunk and return the JPEGs that it completes, oldest first."""
        self._buffer += data
        frames: list[bytes] = []
        while True:
            if self._length is None and not self._read_header():
                return frames
            assert self._length is not None
            if self._resync_in_body():
                continue
            if len(self._buffer) < self._length:
                return frames
            body = bytes(self._buffer[: self._length])
            try:
                check_whole(body)
            except JpegError as error:
                self._drop(str(error))
                del self._buffer[: self._length]
            else:
                frames.append(body)
                del self._buffer[: self._length]
            self._length = None

    def _read_header(self) -> bool:
        """Take a part's header out of the buffer; return False if it is not complete yet."""
        while True:
            end = self._buffer.find(_HEADER_END)
            if end < 0:
                if len(self._buffer) > _MAX_HEADER:
                    self._drop(f"no part header within {_MAX_HEADER} bytes")
                    at = self._buffer.rfind(self._boundary)
                    del self._buffer[: at if at > 0 else len(self._buffer) - len(_HEADER_END)]
                return False
            header = bytes(self._buffer[:end])
            del self._buffer[: end + len(_HEADER_END)]
            lengths = _LENGTH.findall(header)
            # After garbage, the last length belongs to the part that begins here.
            length = int(lengths[-1]) if lengths else 0
            if 4 <= length <= self._max_frame_bytes:
                self._length = length
                return True
            self._drop(f"Content-Length {length}" if lengths else "no Content-Length")
            self._skip_to_boundary()

    def _resync_in_body(self) -> bool:
        """Skip to the next part if it begins inside the announced length of this one, which was truncated."""
        assert self._length is not None
        at = self._buffer.find(self._boundary, 0, self._length)
        if at < 0:
            return False
        self._drop(f"truncated after {at} of {self._length} bytes")
        del self._buffer[:at]
        self._length = None
        return True

    def _skip_to_boundary(self) -> None:
        at = self._buffer.find(self._boundary)
        del self._buffer[: at if at >= 0 else len(self._buffer)]

    def _drop(self, reason: str) -> None:
        self.bad_frames += 1
        self.last_fault = reason
