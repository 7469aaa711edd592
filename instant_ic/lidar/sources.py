"""Check that all packets come from one sensor.

UDP does not authenticate the sender. If a second sender's clock runs ahead, every packet of the sensor counts as late,
and the second sender's walls replace the real ones. The guard therefore accepts one address and port, and reports any
other sender. It also reports packets out of order, which a second sender with the sensor's own address cannot avoid.
"""

_LATE_SHARE = 0.03
"""Tolerated share of late packets over any time. A cable to the sensor reorders none."""
_LATE_BURST = 3.0
"""Late packets tolerated at once, above the share; 4 packets are 19 degrees of a revolution at 600 rpm."""


class SourceGuard:
    """Sender and packet order of one sensor.

    Args:
        sensor: address of the sensor; empty accepts the first sender, and no other until the process ends.

    Attributes:
        foreign: number of datagrams that were rejected because another sender sent them.
    """

    QUIET_S = 3.0
    """Time without a fault after which the points are trusted again."""

    def __init__(self, sensor: str = "") -> None:
        self.foreign = 0
        self._configured = bool(sensor)
        self._address = sensor
        self._ports: dict[bool, tuple[int, int]] = {}
        """Source port of data (True) and position packets, and the time of the last packet from it."""
        self._late_level = 0.0
        self._fault: tuple[str, int] | None = None
        """Newest reason to distrust the points, and its steady time."""

    def admit(self, sender: tuple[str, int], is_data: bool, well_formed: bool, now_ns: int) -> bool:
        """Return whether a datagram is from the sensor.

        Another port of the same address is accepted as a restarted sensor once the old port has been silent.

        Args:
            sender: address and port.
            is_data: True from the data port, False from the position port.
            well_formed: False if the payload cannot be the sensor's; it then neither selects a sender nor counts as a
                fault.
            now_ns: steady time.
        """
        address, port = sender
        if well_formed:
            self._address = self._address or address
        same = not self._address or address == self._address  # the stream reports payloads of another product
        before = self._ports.get(is_data, (port, now_ns))
        second_port = same and well_formed and before[0] != port and now_ns - before[1] < self.QUIET_S * 1e9
        if same and not second_port:
            if well_formed:
                self._ports[is_data] = (port, now_ns)
            return True
        self.foreign += 1
        if second_port or (well_formed and not self._configured):
            rival = f"{address}:{port}"
            text = (
                f"Packets arrive from {rival} as well as from {self._address}. No scan until {rival} has sent nothing "
                f"for {self.QUIET_S:.0f} s. Disconnect it, or set vlp16_driver `sensor` to the sensor's address and "
                "restart the driver."
            )
            self._fault = text, now_ns
        return False

    def count(self, taken: int, out_of_order: int, now_ns: int) -> None:
        """Count packets that the stream accepted, and those that were late or from another clock."""
        self._late_level = max(0.0, self._late_level + out_of_order - _LATE_SHARE * (taken + out_of_order))
        if self._late_level > _LATE_BURST:
            self._late_level = _LATE_BURST
            text = (
                f"Packets arrive out of order, as if two senders used the address {self._address or 'of the sensor'}. "
                f"No scan until packets were in order for {self.QUIET_S:.0f} s. Check for a second sensor or a forged "
                "sender."
            )
            self._fault = text, now_ns

    def doubt(self, now_ns: int) -> str | None:
        """Return why the points cannot be trusted at a steady time, and what to do; None if they can."""
        fault = self._fault
        return fault[0] if fault is not None and now_ns - fault[1] < self.QUIET_S * 1e9 else None
