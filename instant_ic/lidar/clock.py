"""Offset between the sensor's clock, which wraps every hour, and the host's clock."""

from instant_ic.lidar.packets import HOUR_US


class DeviceClock:
    """Unwraps device time over the hours and estimates its offset to host time.

    Transport can only delay a packet, so the smallest observed difference is the best estimate of the offset. The
    estimate may rise slowly, because the clocks drift. A lasting change of the difference means that one of the clocks
    was set.

    Attributes:
        resets: number of times the offset was estimated again because a clock was set.
    """

    JUMP_NS = 500_000_000
    JUMP_PACKETS = 20
    MAX_DRIFT_PPM = 50.0

    def __init__(self) -> None:
        """Start without an offset; the first packet sets it."""
        self.resets = 0
        self._device_us: int | None = None
        self._offset_ns: float = 0.0
        self._jumped = 0

    def step_us(self, timestamp_us: int) -> int | None:
        """Return the microseconds from the last accepted packet to this one, in the shorter direction around the hour.

        They are negative for an older packet. Before the first packet the result is None.
        """
        if self._device_us is None:
            return None
        return (timestamp_us - self._device_us + HOUR_US // 2) % HOUR_US - HOUR_US // 2

    def take(self, timestamp_us: int, host_ns: int) -> int:
        """Add the time of a packet and update the offset.

        Args:
            timestamp_us: microseconds past the hour, from the packet.
            host_ns: host time of the same instant, including the transport delay.

        Returns:
            Microseconds on the unwrapped device clock.
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
        drift_ns = max(step, 0) * 1e-3 * self.MAX_DRIFT_PPM
        self._offset_ns = min(sample_ns, self._offset_ns + drift_ns)
        return self._device_us

    def shift(self, ns: int) -> None:
        """Follow the host's clock after it was set forward."""
        self._offset_ns += ns

    def restart(self) -> None:
        """Reset the estimate, for example after a restart of the sensor."""
        self._device_us = None
        self._jumped = 0

    def host_ns(self, device_us: float) -> int:
        """Return the host time of an instant on the unwrapped device clock."""
        return round(device_us * 1000.0 + self._offset_ns)
