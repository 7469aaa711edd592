"""The sensor's clock, which starts anew every hour, against the host's."""

from instant_ic.lidar.packets import HOUR_US


class DeviceClock:
    """Unrolls device time over the hours and estimates what to add to it for host time.

    Transport only ever delays a packet, so the smallest difference seen is the truest. It is let rise slowly,
    as the two clocks drift apart. A difference that stays elsewhere means that one of the clocks was set.

    Attributes:
        resets: how often the offset was estimated anew after a clock was set.
    """

    JUMP_NS = 500_000_000
    JUMP_PACKETS = 20

    def __init__(self, max_drift_ppm: float = 50.0) -> None:
        """Start without an offset: the first packet gives it."""
        self.max_drift_ppm = max_drift_ppm
        self.resets = 0
        self._device_us: int | None = None
        self._offset_ns: float = 0.0
        self._jumped = 0

    def step_us(self, timestamp_us: int) -> int | None:
        """Microseconds from the last packet taken to this one, by the shorter way round the hour.

        Negative for a packet that is older; None before the first.
        """
        if self._device_us is None:
            return None
        return (timestamp_us - self._device_us + HOUR_US // 2) % HOUR_US - HOUR_US // 2

    def take(self, timestamp_us: int, host_ns: int) -> int:
        """Take the time of a packet.

        Args:
            timestamp_us: microseconds past the hour, as the packet says.
            host_ns: host time of the same instant, late by the transport.

        Returns:
            Microseconds on the unrolled device clock.
        """
        step = self.step_us(timestamp_us)
        if self._device_us is None or step is None:
            self._device_us = timestamp_us
            self._offset_ns = host_ns - timestamp_us * 1000.0
            return timestamp_us
        self._device_us += step
        sample_ns = host_ns - self._device_us * 1000.0
        if abs(sample_ns - self._offset_ns) > self.JUMP_NS:
            self._jumped += 1
            if self._jumped >= self.JUMP_PACKETS:
                self._offset_ns = sample_ns
                self._jumped = 0
                self.resets += 1
            return self._device_us
        self._jumped = 0
        drift_ns = max(step, 0) * 1e-3 * self.max_drift_ppm
        self._offset_ns = min(sample_ns, self._offset_ns + drift_ns)
        return self._device_us

    def restart(self) -> None:
        """Forget everything, as after the sensor was switched on anew."""
        self._device_us = None
        self._jumped = 0

    def host_ns(self, device_us: float) -> int:
        """Host time of an instant on the unrolled device clock."""
        return round(device_us * 1000.0 + self._offset_ns)
