"""Playback of a capture at its recorded rate."""

from __future__ import annotations

from collections.abc import Iterator

from instant_ic.lidar.capture import CaptureError, CaptureReader, Datagram
from instant_ic.util.diagnosis import Diagnosis, Level


class CapturePlayer:
    """The datagrams of a capture, each when it is due.

    Args:
        path: capture file.
        now_ns: clock of the stamps at the start.
        steady_ns: steady time of the start.

    Raises:
        CaptureError: the file is not a capture, or holds no UDP datagram.
        OSError: the file cannot be read.
    """

    def __init__(self, path: str, now_ns: int, steady_ns: int) -> None:
        self._reader = CaptureReader(path)
        self._datagrams = iter(self._reader)
        self._next: Datagram | None = next(self._datagrams, None)
        if self._next is None:
            raise CaptureError(f"{path}: holds no UDP datagram ({dict(self._reader.skipped)})")
        self._first_ns = self._next.stamp_ns
        self._start_ns, self._start_steady_ns = now_ns, steady_ns

    @property
    def ended(self) -> bool:
        """True after the last datagram."""
        return self._next is None

    def due(self, steady_ns: int) -> Iterator[Datagram]:
        """Yield the datagrams that are due at a steady time, with stamps relative to the start of the playback."""
        elapsed_ns = steady_ns - self._start_steady_ns
        while self._next is not None and self._next.stamp_ns - self._first_ns <= elapsed_ns:
            datagram, self._next = self._next, next(self._datagrams, None)
            yield datagram._replace(stamp_ns=self._start_ns + datagram.stamp_ns - self._first_ns)

    @property
    def diagnosis(self) -> Diagnosis:
        """Number of played and of skipped datagrams."""
        skipped = ", ".join(f"{count} x {reason}" for reason, count in self._reader.skipped.items())
        text = f"{self._reader.datagrams} datagrams played" + (f"; left out: {skipped}" if skipped else "")
        return Diagnosis("capture", Level.WARN if skipped else Level.OK, text)
