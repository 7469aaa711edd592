"""UDP payloads from capture files, read or played: pcap (either endianness, micro- and nanoseconds) and pcapng.

Source: the pcap and pcapng drafts of the IETF opsawg (draft-ietf-opsawg-pcap, draft-ietf-opsawg-pcapng).
"""

import struct
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from instant_ic.util.diagnosis import Diagnosis, Level

_ETHERNET = 1
_IP_OFFSET = {0: 4, 101: 0, 113: 16, 276: 20}
"""Bytes before the IP header by link type: BSD loopback, raw IP, Linux cooked 1 and 2."""

_PCAP_MAGIC = {
    b"\xd4\xc3\xb2\xa1": ("<", 1000),
    b"\xa1\xb2\xc3\xd4": (">", 1000),
    b"\x4d\x3c\xb2\xa1": ("<", 1),
    b"\xa1\xb2\x3c\x4d": (">", 1),
}
_PCAPNG_MAGIC = b"\x0a\x0d\x0d\x0a"


class CaptureError(ValueError):
    """A file that is not a capture; the text names the file and its first bytes."""


class Datagram(NamedTuple):
    """One UDP payload of a capture."""

    stamp_ns: int
    """Time of capture since the epoch."""
    port: int
    """Destination port."""
    payload: bytes


class CaptureReader:
    """Iterates over the UDP payloads of a capture file; other frames are counted by reason and raise no error.

    Example:
        >>> reader = CaptureReader("recording.pcap")        # doctest: +SKIP
        >>> for stamp_ns, port, payload in reader: ...      # doctest: +SKIP
        >>> reader.skipped                                  # doctest: +SKIP
        Counter({'not IPv4': 1, 'cut record': 1})

    Attributes:
        datagrams: UDP payloads returned.
        skipped: skipped frames by reason.
    """

    def __init__(self, path: str | Path) -> None:
        """Open and read the file.

        Raises:
            CaptureError: the file is neither pcap nor pcapng.
            OSError: the file cannot be read.
        """
        self.path = Path(path)
        self.datagrams = 0
        self.skipped: Counter[str] = Counter()
        self._data = self.path.read_bytes()
        magic = self._data[:4]
        if magic not in _PCAP_MAGIC and magic != _PCAPNG_MAGIC:
            raise CaptureError(
                f"{self.path}: neither pcap nor pcapng: it starts with {magic.hex(' ') or 'nothing'}. "
                "Convert it with 'editcap -F pcap'."
            )

    def __iter__(self) -> Iterator[Datagram]:
        """Iterate over all UDP payloads in file order; the counters restart at zero."""
        self.datagrams, self.skipped = 0, Counter()
        frames = self._pcapng() if self._data[:4] == _PCAPNG_MAGIC else self._pcap()
        for stamp_ns, link, start, end in frames:
            found = _udp(self._data, start, end, link)
            if isinstance(found, str):
                self.skipped[found] += 1
                continue
            self.datagrams += 1
            port, start, end = found
            yield Datagram(stamp_ns, port, self._data[start:end])

    def _pcap(self) -> Iterator[tuple[int, int, int, int]]:
        """Yield stamp, link type, start and end of each frame."""
        data = self._data
        order, unit_ns = _PCAP_MAGIC[data[:4]]
        if len(data) < 24:
            self.skipped["cut file header"] += 1
            return
        link = struct.unpack_from(order + "I", data, 20)[0] & 0xFFFF
        record = struct.Struct(order + "IIII")
        at, size = 24, len(data)
        while at + 16 <= size:
            seconds, fraction, captured, original = record.unpack_from(data, at)
            at += 16
            if at + captured > size:
                self.skipped["cut record"] += 1
                return
            if captured < original:
                # The snapshot length truncated this frame, so its payload is incomplete.
                self.skipped["cut frame"] += 1
            else:
                yield seconds * 1_000_000_000 + fraction * unit_ns, link, at, at + captured
            at += captured
        if at < size:
            self.skipped["cut record"] += 1

    def _pcapng(self) -> Iterator[tuple[int, int, int, int]]:
        """Yield stamp, link type, start and end of each frame in the enhanced packet blocks."""
        data, size = self._data, len(self._data)
        at, order = 0, "<"
        interfaces: list[tuple[int, float]] = []
        while at + 12 <= size:
            if data[at : at + 4] == _PCAPNG_MAGIC:
                order = "<" if data[at + 8 : at + 12] == b"\x4d\x3c\x2b\x1a" else ">"
                interfaces = []
            kind, length = struct.unpack_from(order + "II", data, at)
            if length < 12 or length % 4 or at + length > size:
                self.skipped["cut record"] += 1
                return
            body, end = at + 8, at + length - 4
            at += length
            if kind == 1 and end - body >= 8:
                link = struct.unpack_from(order + "H", data, body)[0]
                interfaces.append((link, _tick_ns(data, body + 8, end, order)))
            elif kind == 6 and end - body >= 20:
                interface, high, low, captured, original = struct.unpack_from(order + "IIIII", data, body)
                if interface >= len(interfaces) or body + 20 + captured > end:
                    self.skipped["broken packet block"] += 1
                elif captured < original:
                    self.skipped["cut frame"] += 1
                else:
                    link, tick_ns = interfaces[interface]
                    ticks = high << 32 | low
                    stamp_ns = ticks * int(tick_ns) if tick_ns >= 1.0 else round(ticks * tick_ns)
                    yield stamp_ns, link, body + 20, body + 20 + captured
            elif kind in (2, 3):
                self.skipped["packet block without a time"] += 1
        if at < size:
            self.skipped["cut record"] += 1


class CapturePlayer:
    """The datagrams of a capture, each when it is due.

    Args:
        path: capture file.
        now_ns: time at the start on the clock of the stamps.
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
        """Return a diagnosis with the numbers of played and skipped datagrams."""
        skipped = ", ".join(f"{count} x {reason}" for reason, count in self._reader.skipped.items())
        text = f"{self._reader.datagrams} datagrams played" + (f"; left out: {skipped}" if skipped else "")
        return Diagnosis("capture", Level.WARN if skipped else Level.OK, text)


def _tick_ns(data: bytes, at: int, end: int, order: str) -> float:
    """Return the nanoseconds per timestamp unit, from the interface options (if_tsresol, code 9)."""
    while at + 4 <= end:
        code, length = struct.unpack_from(order + "HH", data, at)
        if code == 0:
            break
        if code == 9 and length >= 1 and at + 4 < end:
            value = data[at + 4]
            return 1e9 / 2 ** (value & 0x7F) if value & 0x80 else 10.0 ** (9 - value)
        at += 4 + (length + 3) // 4 * 4
    return 1000.0


def _udp(data: bytes, start: int, end: int, link: int) -> tuple[int, int, int] | str:
    """Return destination port, start and end of a frame's UDP payload, or the reason why it has none."""
    at = start + _IP_OFFSET.get(link, 12)
    if link == _ETHERNET:
        while end - at >= 4 and data[at : at + 2] in (b"\x81\x00", b"\x88\xa8"):  # VLAN tags
            at += 4
        if data[at : at + 2] != b"\x08\x00":
            return "not IPv4"
        at += 2
    elif link not in _IP_OFFSET:
        return f"unknown link type {link}"
    if at + 20 > end:
        return "cut frame"
    if data[at] >> 4 != 4:
        return "not IPv4"
    if (data[at + 6] & 0x3F) | data[at + 7]:
        return "IP fragment"
    if data[at + 9] != 17:
        return "not UDP"
    udp = at + 4 * (data[at] & 0x0F)
    if udp + 8 > end:
        return "cut frame"
    length = data[udp + 4] << 8 | data[udp + 5]
    if length < 8 or udp + length > end:
        return "cut datagram"
    return data[udp + 2] << 8 | data[udp + 3], udp + 8, udp + length
