"""VLP-16 wire format of data packets (1206 bytes) and position packets (512 bytes).

Source: Velodyne VLP-16 User Manual (63-9243), chapters 9 and 12.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

DATA_PACKET_BYTES = 1206
POSITION_PACKET_BYTES = 512
BLOCKS = 12
FIRINGS = 2
"""Firing sequences in one block."""
LASERS = 16

DISTANCE_UNIT_M = 0.002
LASER_PERIOD_US = 2.304
FIRING_PERIOD_US = 55.296
BLOCK_PERIOD_US = 110.592
PACKET_PERIOD_US = BLOCKS * BLOCK_PERIOD_US
"""Time from one packet to the next in single return mode; half of it in dual return mode."""
HOUR_US = 3_600_000_000
"""Period of the sensor's time. Some sensors count on past it, so a received time is taken modulo the hour."""

RETURN_STRONGEST = 0x37
RETURN_DUAL = 0x39
PRODUCT_VLP16 = 0x22

LASER_ELEVATION_DEG: NDArray[np.float64] = np.array(
    [-15.0, 1.0, -13.0, 3.0, -11.0, 5.0, -9.0, 7.0, -7.0, 9.0, -5.0, 11.0, -3.0, 13.0, -1.0, 15.0]
)
"""Elevation of each laser, indexed by laser id, degrees, (16,)."""
LASER_VERTICAL_OFFSET_M: NDArray[np.float64] = 0.04191 * np.tan(np.radians(-LASER_ELEVATION_DEG))
"""Offset added to z of each laser's points, indexed by laser id, metres, (16,).

The lasers meet 41.91 mm in front of the axis; the manual's table has these values rounded to 0.1 mm.
"""
LASER_RING: NDArray[np.uint16] = np.argsort(np.argsort(LASER_ELEVATION_DEG)).astype(np.uint16)
"""Rank of each laser by elevation, 0 for the lowest, (16,)."""

BLOCK_FLAG = 0xEEFF
"""Bytes FF EE as a little-endian number."""

RETURN_DTYPE = np.dtype([("distance", "<u2"), ("reflectivity", "u1")])
BLOCK_DTYPE = np.dtype([("flag", "<u2"), ("azimuth", "<u2"), ("returns", RETURN_DTYPE, (FIRINGS, LASERS))])
PACKET_DTYPE = np.dtype(
    [("blocks", BLOCK_DTYPE, (BLOCKS,)), ("timestamp_us", "<u4"), ("return_mode", "u1"), ("product", "u1")]
)


class PacketError(ValueError):
    """The payload is not the expected packet; the text says why."""


def encode_data_packet(
    azimuth_cdeg: ArrayLike,
    distance_mm2: ArrayLike,
    reflectivity: ArrayLike,
    timestamp_us: int,
    return_mode: int = RETURN_STRONGEST,
    product: int = PRODUCT_VLP16,
) -> bytes:
    """Return the bytes of one data packet.

    In dual return mode (0x39) blocks come in pairs of equal azimuth: even blocks hold the last return, odd blocks the
    strongest, or the second strongest if the strongest is also the last (manual, page 57).

    Args:
        azimuth_cdeg: azimuth of each block's first laser, 0.01 degrees, clockwise, (12,).
        distance_mm2: distance per block, firing and laser id, in units of 2 mm; 0 is no return; (12, 2, 16).
        reflectivity: 0-255, (12, 2, 16).
        timestamp_us: time of the first firing, microseconds past the hour.
        return_mode: 0x37 strongest, 0x38 last, 0x39 dual.
        product: 0x22 VLP-16, 0x24 Puck Hi-Res.
    """
    packet = np.zeros((), PACKET_DTYPE)
    packet["blocks"]["flag"] = BLOCK_FLAG
    packet["blocks"]["azimuth"] = azimuth_cdeg
    packet["blocks"]["returns"]["distance"] = distance_mm2
    packet["blocks"]["returns"]["reflectivity"] = reflectivity
    packet["timestamp_us"] = timestamp_us
    packet["return_mode"] = return_mode
    packet["product"] = product
    return packet.tobytes()


@dataclass(frozen=True)
class PositionPacket:
    """State of the sensor's clock from a position packet.

    Attributes:
        timestamp_us: microseconds past the hour.
        pps: 0 absent, 1 synchronising, 2 locked, 3 error.
        nmea: last sentence of the GPS receiver, without CR LF; empty without a receiver.
    """

    timestamp_us: int
    pps: int
    nmea: str


_POSITION_TIME = 0xC6
_POSITION_PPS = 0xCA
_POSITION_NMEA = 0xCE


def encode_position_packet(timestamp_us: int, pps: int = 0, nmea: str = "") -> bytes:
    """Return the bytes of one position packet (512); see `PositionPacket` for the fields."""
    sentence = f"{nmea}\r\n".encode("ascii", "strict") if nmea else b""
    packet = bytearray(POSITION_PACKET_BYTES)
    packet[_POSITION_TIME : _POSITION_TIME + 4] = timestamp_us.to_bytes(4, "little")
    packet[_POSITION_PPS] = pps
    packet[_POSITION_NMEA : _POSITION_NMEA + len(sentence)] = sentence
    return bytes(packet)


def decode_position_packet(payload: bytes) -> PositionPacket:
    """Decode one position packet.

    Raises:
        PacketError: not 512 bytes.
    """
    if len(payload) != POSITION_PACKET_BYTES:
        raise PacketError(f"a position packet has {POSITION_PACKET_BYTES} bytes (got {len(payload)})")
    timestamp_us = int.from_bytes(payload[_POSITION_TIME : _POSITION_TIME + 4], "little") % HOUR_US
    text = payload[_POSITION_NMEA:].split(b"\0", 1)[0].split(b"\r\n", 1)[0]
    return PositionPacket(timestamp_us, payload[_POSITION_PPS], text.decode("ascii", "replace"))


def check_data_packet(payload: bytes | memoryview) -> str | None:
    """Return why the payload is not a VLP-16 data packet, or None if it is one."""
    if len(payload) != DATA_PACKET_BYTES:
        return f"{len(payload)} bytes instead of {DATA_PACKET_BYTES}"
    if bytes(payload[:2]) != b"\xff\xee":
        return f"first block starts with {bytes(payload[:2]).hex()} instead of ffee"
    return None
