"""Decides whose packets are believed: one sensor, in its own order; anything beside it puts the scan in doubt.

UDP has no sender that can be trusted. A second sender whose clock runs ahead would make every packet of the
sensor late, and its walls would replace the real ones. So one address and port is taken, a second one is
reported, and so are packets out of order, which a sender that forges the sensor's address cannot avoid.
"""

_LATE_SHARE = 0.03
"""Share of late packets that is tolerated for any time. A cable to the sensor reorders none."""
_LATE_BURST = 3.0
"""Late packets tolerated at once, above the share: 4 are 19 degrees of a turn at 600 rpm."""


class SourceGuard:
    """One sensor's sender and order of packets.

    Attributes:
        foreign: datagrams refused because the sensor did not send them.
    """

    QUIET_S = 3.0
    """The doubt lasts until nothing was wrong for this long."""

    def __init__(self, sensor: str = "") -> None:
        """Start without a sender.

        Args:
            sensor: the sensor's address; empty locks onto the first sender's until the process ends.
        """
        self.foreign = 0
        self._configured = bool(sensor)
        self._address = sensor
        self._ports: dict[bool, tuple[int, int]] = {}
        """Source port of data (True) and position packets, and when it was last heard."""
        self._rival = ""
        self._rival_ns: int | None = None
        self._late_level = 0.0
        self._late_ns: int | None = None

    def admit(self, sender: tuple[str, int], is_data: bool, well_formed: bool, now_ns: int) -> bool:
        """Whether a datagram is from the sensor.

        Another port of the same address is a sensor that was restarted, once the old port has been silent.

        Args:
            sender: address and port.
            is_data: from the data port; else from the position port.
            well_formed: whether the payload could be the sensor's; else it neither locks nor casts doubt.
            now_ns: steady time.
        """
        address, port = sender
        if not self._address:
            if not well_formed:
                return True  # another product, perhaps: the stream says what it is
            self._address = address
        if address != self._address:
            self.foreign += 1
            if well_formed and not self._configured:
                self._doubt_sender(sender, now_ns)
            return False
        if not well_formed:
            return True
        before = self._ports.get(is_data)
        if before is not None and before[0] != port and now_ns - before[1] < self.QUIET_S * 1e9:
            self.foreign += 1
            self._doubt_sender(sender, now_ns)
            return False
        self._ports[is_data] = (port, now_ns)
        return True

    def count(self, taken: int, out_of_order: int, now_ns: int) -> None:
        """Take note of packets that the stream took, and of those that it found late or of another clock."""
        self._late_level = max(0.0, self._late_level + out_of_order - _LATE_SHARE * (taken + out_of_order))
        if self._late_level > _LATE_BURST:
            self._late_level = _LATE_BURST
            self._late_ns = now_ns

    def doubt(self, now_ns: int) -> str | None:
        """Why the points cannot be trusted at a steady time, and what to do; None while they can."""
        if self._recent(self._rival_ns, now_ns):
            return (
                f"Packets come from {self._rival} beside {self._address}. No scan until it has been silent for "
                f"{self.QUIET_S:.0f} s. Disconnect it, or set vlp16_driver `sensor` to the sensor's address and "
                "restart the driver."
            )
        if self._recent(self._late_ns, now_ns):
            return (
                f"Packets come out of order, as if two senders used the address {self._address or 'of the sensor'}. "
                f"No scan until all was in order for {self.QUIET_S:.0f} s. Look for a second sensor or a forged sender."
            )
        return None

    def _recent(self, then_ns: int | None, now_ns: int) -> bool:
        return then_ns is not None and now_ns - then_ns < self.QUIET_S * 1e9

    def _doubt_sender(self, sender: tuple[str, int], now_ns: int) -> None:
        self._rival = f"{sender[0]}:{sender[1]}"
        self._rival_ns = now_ns
