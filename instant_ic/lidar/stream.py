"""Revolutions from the stream of data packets, with a count of the missing ones."""

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from instant_ic.lidar.clock import DeviceClock
from instant_ic.lidar.config import DecoderConfig
from instant_ic.lidar.decode import DecodedPackets, decode_packets, turn_to
from instant_ic.lidar.head import TURN_CDEG, Head
from instant_ic.lidar.packets import (
    BLOCKS,
    DATA_PACKET_BYTES,
    HOUR_US,
    PACKET_PERIOD_US,
    RETURN_DUAL,
    check_data_packet,
)

_HEADS = struct.Struct("<" + "2xH96x" * BLOCKS + "IBB")
"""Azimuth of each block, time, return mode and product."""

_OTHER_PRODUCTS = (0x21, 0x24, 0x28)
"""HDL-32E, Puck Hi-Res, VLP-32C: same packets, other elevations. Old firmware sends no product."""

_MAX_GAP_US = 20_000
"""A longer gap ends the revolution; time in a blocked sector does not count."""
_LATE_US = -100_000
"""Oldest late packet, relative to the newest one; an even older packet means that the sensor's clock was reset."""
_LEAST_STEP = 0.75
"""Smallest interval to the newest packet, in periods; one sensor cannot fire two packets at once."""
_CLOCK_SET_US = 500_000
"""If the sensor's time gains this much on the host's over a gap, its clock was set; packets are not missing."""
_MAX_PACKETS = 400
"""More packets than a revolution at 300 rpm in dual mode (302); if none of them reaches the cut, the head stands."""


@dataclass(frozen=True)
class Revolution(DecodedPackets):
    """One revolution of the sensor.

    Attributes:
        stamp_ns: host time of the first firing.
        end_ns: host time of the end of the last firing.
        complete: True if both ends are at the cut angle and no packet is missing.
    """

    stamp_ns: int
    end_ns: int
    complete: bool

    @property
    def xyz(self) -> NDArray[np.float32]:
        """Positions in the sensor's frame, metres, (N, 3)."""
        return np.stack([self.points["x"], self.points["y"], self.points["z"]], axis=-1)


@dataclass
class StreamCounters:
    """Packet statistics since the start.

    Attributes:
        packets: accepted data packets.
        missing: packets that never arrived.
        late: packets dropped because a newer one, or one of the same time, had already arrived.
        bad: payloads dropped because they are not data packets; the newest reason is ``bad_reason``.
        clock_resets: jumps of the sensor's clock (the sensor or a capture was restarted).
        revolutions: returned revolutions.
    """

    packets: int = 0
    missing: int = 0
    late: int = 0
    bad: int = 0
    clock_resets: int = 0
    revolutions: int = 0
    bad_reason: str = ""


class PacketStream:
    """Assembler of revolutions: takes data packets one by one, and returns each revolution as soon as it ends."""

    def __init__(self, config: DecoderConfig | None = None) -> None:
        self.config = config or DecoderConfig()
        self.clock = DeviceClock()
        self.counters = StreamCounters()
        self.head = Head(self.config.blocked)
        self._cut = round(self.config.cut_angle_deg * 100.0)
        self._payloads: list[bytes] = []
        self._times_us: list[int] = []
        self._first_block = 0
        self._missing = 0
        self._dual = False
        self._cut_before = False
        self._turned: int | None = None
        """Turn from the cut angle to the last block, 0.01 degrees; None after an interruption of the stream."""
        self._received_ns = 0

    def feed(self, payload: bytes, received_ns: int) -> Revolution | None:
        """Add one payload.

        Args:
            payload: 1206 bytes; other payloads are counted and dropped.
            received_ns: host time of arrival.

        Returns:
            The revolution that this packet ends, if any.
        """
        reason = check_data_packet(payload)
        azimuths, timestamp_us, mode = [0], 0, 0
        if reason is None:
            *azimuths, timestamp_us, mode, product = _HEADS.unpack_from(payload)
            if product in _OTHER_PRODUCTS:
                reason = f"product 0x{product:02x} is not a VLP-16"
            elif max(azimuths) >= TURN_CDEG:
                reason = "azimuth out of range"
        if reason is not None:
            self.counters.bad += 1
            self.counters.bad_reason = reason
            return None
        timestamp_us %= HOUR_US

        dual = mode == RETURN_DUAL
        step_us = self.clock.step_us(timestamp_us)
        elapsed_us = (received_ns - self._received_ns) * 1e-3
        self._received_ns = received_ns
        period_us = PACKET_PERIOD_US / 2 if dual else PACKET_PERIOD_US
        if step_us is not None and _LATE_US < step_us < _LEAST_STEP * period_us:
            self.counters.late += 1
            return None
        azimuths = azimuths[::2] if dual else azimuths
        sent_us, between = self.head.take(azimuths, step_us)
        done = self._interruption(step_us, sent_us, elapsed_us, dual)

        self.counters.packets += 1
        # A packet arrives after its last firing, but carries the time of its first firing.
        device_us = self.clock.take(timestamp_us, received_ns - round(period_us * 1000.0))
        self._payloads.append(payload)
        self._times_us.append(device_us)
        column = None
        if self._turned is not None and self._turned + between + max(0, self.head.span) >= TURN_CDEG:
            column = _column_after_cut(azimuths, self._turned + between)
        self._turned = (azimuths[-1] - self._cut) % TURN_CDEG
        return done if column is None else self._end_at_cut(column * (2 if dual else 1))

    def _interruption(self, step_us: int | None, sent_us: float, elapsed_us: float, dual: bool) -> Revolution | None:
        """Count missing packets before a new one, and end the revolution if the new packet cannot continue it.

        Args:
            step_us: time since the last packet on the sensor's clock; None before the first one.
            sent_us: part of this time during which the sensor sent packets.
            elapsed_us: time since the last packet on the host's clock.
            dual: True if the new packet has two returns.
        """
        period_us = PACKET_PERIOD_US / 2 if dual else PACKET_PERIOD_US
        done = None
        if step_us is not None:
            if step_us <= _LATE_US or (step_us > _MAX_GAP_US and step_us - elapsed_us > _CLOCK_SET_US):
                self.counters.clock_resets += 1
                done = self._end_early()
                self.clock.restart()
            elif sent_us > 1.5 * period_us:
                missing = round(sent_us / period_us) - 1
                self.counters.missing += missing
                self._missing += missing
                if sent_us > _MAX_GAP_US:
                    done = self._end_early()
        if dual != self._dual or len(self._payloads) >= _MAX_PACKETS:
            # A revolution has one return mode, and it also ends if the head does not turn.
            done = self._end_early() or done
            self._dual = dual
        return done

    def restart(self) -> None:
        """Drop the current revolution and the sensor's clock, because earlier packets cannot be trusted."""
        self._end_early()
        self.clock.restart()
        self.head.restart()

    def finish(self) -> Revolution | None:
        """Return the points since the last cut as the last revolution, for example at the end of a capture."""
        return self._end_early()

    def _end_at_cut(self, block: int) -> Revolution | None:
        """End the revolution before a block of the newest packet."""
        payloads = self._payloads if block else self._payloads[:-1]
        revolution = self._decode(payloads, block or BLOCKS, cut_after=True)
        self._payloads = self._payloads[-1:]
        self._times_us = self._times_us[-1:]
        self._first_block = block
        self._missing = 0
        self._cut_before = True
        return revolution

    def _end_early(self) -> Revolution | None:
        """End the revolution here; the next one starts with the next packet."""
        revolution = self._decode(self._payloads, BLOCKS, cut_after=False)
        self._payloads = []
        self._times_us = []
        self._first_block = 0
        self._missing = 0
        self._cut_before = False
        self._turned = None
        return revolution

    def _decode(self, payloads: list[bytes], end_block: int, cut_after: bool) -> Revolution | None:
        if not payloads or (len(payloads) == 1 and self._first_block >= end_block):
            return None
        packets = np.frombuffer(b"".join(payloads), np.uint8).reshape(-1, DATA_PACKET_BYTES)
        first_us = self._times_us[0]
        times = np.array(self._times_us[: len(payloads)], np.int64) - first_us
        decoded = decode_packets(
            packets,
            times.astype(np.float64),
            self._first_block,
            end_block,
            self.config.min_range,
            self.config.max_range,
        )
        start_us = first_us + decoded.start_us
        self.counters.revolutions += 1
        return Revolution(
            **vars(decoded),
            stamp_ns=self.clock.host_ns(start_us),
            end_ns=self.clock.host_ns(start_us + decoded.duration_s * 1e6),
            complete=self._cut_before and cut_after and self._missing == 0,
        )


def _column_after_cut(azimuths: list[int], turned: int) -> int | None:
    """Return the first block (or pair of blocks) of a packet after the cut angle; None if the head does not pass it.

    Args:
        azimuths: azimuth of each block or pair, 0.01 degrees.
        turned: turn from the cut angle to the first of them, 0.01 degrees.
    """
    for column, azimuth in enumerate(azimuths):
        if column:
            turned += turn_to(azimuths[column - 1], azimuth)
        if turned >= TURN_CDEG:
            return column
    return None
