"""Detection of a source that sends old data again. Measurements have noise, so equal ones are copies."""

from __future__ import annotations

import zlib
from collections import deque

REMEMBERED = 128
"""Number of different measurements remembered, because ring buffers and short recordings repeat many."""


class RepeatWatch:
    """Compares each measurement with earlier ones.

    Attributes:
        copies: number of copies received in a row.
    """

    def __init__(self) -> None:
        self.copies = 0
        self._known: deque[int] = deque(maxlen=REMEMBERED)

    def is_new(self, *parts: bytes) -> bool:
        """Return whether a measurement, given in one or more parts, differs from the earlier ones."""
        digest = 0
        for part in parts:
            digest = zlib.crc32(part, digest)
        if digest in self._known:
            self.copies += 1
            return False
        self._known.append(digest)
        self.copies = 0
        return True

    def forget(self) -> None:
        """Forget the earlier measurements."""
        self._known.clear()
        self.copies = 0
