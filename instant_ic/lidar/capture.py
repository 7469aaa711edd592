"""UDP payloads from pcap files of either endianness, with micro- or nanoseconds.

Source: the pcap draft of the IETF opsawg (draft-ietf-opsawg-pcap).
"""

import struct
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

LINK_NULL, LINK_ETHERNET, LINK_RAW, LINK_LINUX_SLL, LINK_LINUX_SLL2 = 0, 1, 101, 113, 276

_PCAP_MAGIC = {
    b"\xd4\xc3\xb2\xa1": ("<", 1000),
    b"\xa1\xb2\xc3\xd4": (">", 1000),
    b"\x4d\x3c\xb2\xa1": ("<", 1),
    b"\xa1\xb2\x3c\x4d": (">", 1),
}


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
        Counter({'not IP': 1, 'cut record': 1})

    Attributes:
        datagrams: UDP payloads returned.
        skipped: skipped frames by reason.
    """

    def __init__(self, path: str | Path) -> None:
        """Open and read the file.

        Raises:
            CaptureError: the file is not pcap.
            OSError: the file cannot be read.
        """
        self.path = Path(path)
        self.datagrams = 0
        self.skipped: Counter[str] = Counter()
        self._data = self.path.read_bytes()
        magic = self._data[:4]
        if magic not in _PCAP_MAGIC:
            raise CaptureError(
                f"{self.path}: not a pcap file: it starts with {magic.hex(' ') or 'nothing'}. "
                "Convert it with 'editcap -F pcap'."
            )

    def __iter__(self) -> Iterator[Datagram]:
        """Iterate over all UDP payloads in file order; the counters restart at zero."""
        self.datagrams, self.skipped = 0, Counter()
        for stamp_ns, link, start, end in self._frames():
            found = _udp(self._data, start, end, link)
            if isinstance(found, str):
                self.skipped[found] += 1
                continue
            self.datagrams += 1
            port, start, end = found
            yield Datagram(stamp_ns, port, self._data[start:end])

    def _frames(self) -> Iterator[tuple[int, int, int, int]]:
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


def _udp(data: bytes, start: int, end: int, link: int) -> tuple[int, int, int] | str:
    """Return destination port, start and end of a frame's UDP payload, or the reason why it has none."""
    if link == LINK_ETHERNET:
        at = start + 12
        while end - at >= 4 and data[at : at + 2] in (b"\x81\x00", b"\x88\xa8"):
            at += 4
        if data[at : at + 2] not in (b"\x08\x00", b"\x86\xdd"):
            return "not IP"
        at += 2
    elif link == LINK_RAW:
        at = start
    elif link == LINK_NULL:
        at = start + 4
    elif link == LINK_LINUX_SLL:
        at = start + 16
    elif link == LINK_LINUX_SLL2:
        at = start + 20
    else:
        return f"unknown link type {link}"
    if at + 20 > end:
        return "cut frame"
    version = data[at] >> 4
    if version == 4:
        protocol, header = data[at + 9], 4 * (data[at] & 0x0F)
        if (data[at + 6] & 0x3F) | data[at + 7]:
            return "IP fragment"
    elif version == 6:
        protocol, header = data[at + 6], 40
    else:
        return "not IP"
    if protocol != 17:
        return "not UDP"
    udp = at + header
    if udp + 8 > end:
        return "cut frame"
    length = data[udp + 4] << 8 | data[udp + 5]
    if length < 8 or udp + length > end:
        return "cut datagram"
    return data[udp + 2] << 8 | data[udp + 3], udp + 8, udp + length
