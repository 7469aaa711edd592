"""Revolutions from packets, with the check of their sender."""

from __future__ import annotations

from instant_ic.lidar.config import DecoderConfig
from instant_ic.lidar.packets import DATA_PACKET_BYTES
from instant_ic.lidar.sources import SourceGuard
from instant_ic.lidar.stream import PacketStream, Revolution

_SET_NS, _SET_BACK_NS = 20_000_000, -500_000_000
"""Steps of the host's clock against its steady clock, forward and back, from which on the clock counts as set."""

Packets = list[tuple[bytes, int]]
"""Payloads with their stamps."""


class PacketFeed:
    """Assembly of packets into revolutions. After a doubt about the sender, the revolution in progress is dropped.

    Attributes:
        stream: decodes the packets.
        sources: check of the packets' sender.
        last_ns: steady time of the newest packet, or of the start.
    """

    def __init__(self, config: DecoderConfig, sensor: str, steady_ns: int) -> None:
        self.stream = PacketStream(config)
        self.sources = SourceGuard(sensor)
        self.last_ns = steady_ns
        self._doubtful = False
        self._packets: Packets = []
        self._ahead_ns: int | None = None  # largest difference of a packet's stamp and the steady clock

    def take(self, payload: bytes, stamp_ns: int, steady_ns: int) -> tuple[Revolution, Packets] | None:
        """Add one data packet; return the revolution that it ends, if any."""
        self.last_ns = steady_ns
        self._follow_host(stamp_ns - steady_ns)
        counters = self.stream.counters
        taken, late = counters.packets, counters.late + counters.clock_resets
        revolution = self.stream.feed(payload, stamp_ns)
        self.sources.count(counters.packets - taken, counters.late + counters.clock_resets - late, steady_ns)
        doubtful, self._doubtful = self._doubtful, self.sources.doubt(steady_ns) is not None
        if doubtful and not self._doubtful:
            # A forged packet may have moved the sensor's clock, and is part of the revolution so far.
            self.stream.restart()
            revolution = None
        if len(payload) == DATA_PACKET_BYTES:
            self._packets.append((payload, stamp_ns))
        return self._with_packets(revolution)

    def _follow_host(self, ahead_ns: int) -> None:
        """Follow the host's clock if it was set forward. Transport delays can only lower ``ahead_ns``."""
        raised_ns = 0 if self._ahead_ns is None else ahead_ns - self._ahead_ns
        if raised_ns > _SET_NS:
            self.stream.clock.shift(raised_ns)
        if self._ahead_ns is None or raised_ns > 0 or raised_ns < _SET_BACK_NS:
            self._ahead_ns = ahead_ns

    def finish(self) -> tuple[Revolution, Packets] | None:
        """Return the remaining points as the last revolution, with their packets."""
        return self._with_packets(self.stream.finish())

    def _with_packets(self, revolution: Revolution | None) -> tuple[Revolution, Packets] | None:
        if revolution is None:
            return None
        packets, self._packets = self._packets, []
        return revolution, packets
