"""Revolutions from a capture file."""

from collections.abc import Iterator
from pathlib import Path

from instant_ic.lidar.capture import CaptureReader
from instant_ic.lidar.config import DecoderConfig
from instant_ic.lidar.packets import DATA_PACKET_BYTES
from instant_ic.lidar.stream import PacketStream, Revolution


class Recording:
    """All revolutions of a capture, including the partial first and last ones.

    Example:
        >>> for revolution in Recording("recording.pcap"):   # doctest: +SKIP
        ...     print(revolution.stamp_ns, len(revolution.points))

    Attributes:
        capture: reader of the file, with its counters.
        stream: decoder of the current or last iteration, with its counters.
    """

    def __init__(self, path: str | Path, config: DecoderConfig | None = None, port: int | None = None) -> None:
        """Open the file.

        Args:
            path: pcap or pcapng.
            config: decoding.
            port: read only datagrams to this port; without it, all datagrams of 1206 bytes.

        Raises:
            CaptureError: the file is not a capture.
        """
        self.capture = CaptureReader(path)
        self.config = config or DecoderConfig()
        self.stream = PacketStream(self.config)
        self._port = port

    def __iter__(self) -> Iterator[Revolution]:
        """Decode from the start of the file."""
        stream = self.stream = PacketStream(self.config)
        for stamp_ns, port, payload in self.capture:
            if port != self._port if self._port is not None else len(payload) != DATA_PACKET_BYTES:
                continue
            revolution = stream.feed(payload, stamp_ns)
            if revolution is not None:
                yield revolution
        last = stream.finish()
        if last is not None:
            yield last
