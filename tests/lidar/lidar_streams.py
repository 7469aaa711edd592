"""Packets and captures made for the tests of the lidar."""

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from instant_ic.lidar.packets import (
    BLOCK_PERIOD_US,
    HOUR_US,
    LASER_ELEVATION_DEG,
    PACKET_PERIOD_US,
    RETURN_DUAL,
    RETURN_STRONGEST,
    encode_data_packet,
)

DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "vlp16"
SECOND = 1_000_000_000


def random_stream(
    packets: int, dual: bool = False, seed: int = 0, start_us: int = 1000, max_units: int = 5000, jitter: int = 1
) -> list[bytes]:
    """Data packets at 600 rpm with random returns; a fifth of the rays has none, half of the pairs are identical."""
    rng = np.random.default_rng(seed)
    azimuth = 100
    stream = []
    for index in range(packets):
        columns = 6 if dual else 12
        turns = azimuth + np.cumsum(rng.integers(40 - jitter, 41 + jitter, columns))
        azimuth = int(turns[-1])
        distance = rng.integers(1, max_units, (12, 2, 16))
        distance[rng.random(distance.shape) < 0.2] = 0
        reflectivity = rng.integers(0, 256, (12, 2, 16))
        if dual:
            same = rng.random((6, 2, 16)) < 0.5
            distance[1::2] = np.where(same, distance[0::2], distance[1::2])
            # Two returns of one distance are one return, and have one reflectivity.
            same = distance[0::2] == distance[1::2]
            reflectivity[1::2] = np.where(same, reflectivity[0::2], reflectivity[1::2])
        stream.append(
            encode_data_packet(
                (np.repeat(turns, 2) if dual else turns) % 36000,
                distance,
                reflectivity,
                (start_us + round(index * PACKET_PERIOD_US / (2 if dual else 1))) % HOUR_US,
                RETURN_DUAL if dual else RETURN_STRONGEST,
            )
        )
    return stream


def wall_stream(packets: int, distance_m: float, start_us: int = 0, azimuth_cdeg: int = 18000) -> list[bytes]:
    """Data packets at 600 rpm, exactly even, inside a round wall of one horizontal distance, from an azimuth on."""
    slant = distance_m / np.cos(np.radians(LASER_ELEVATION_DEG))
    units = np.broadcast_to(np.round(slant / 0.002).astype(int), (12, 2, 16))
    # 0.36 degrees a millisecond at 600 rpm, so 0.398 degrees a block, in the sensor's unit of 0.01 degrees.
    blocks = np.arange(packets * 12) * BLOCK_PERIOD_US
    azimuth = ((azimuth_cdeg + np.round(blocks * 0.36)) % 36000).astype(int).reshape(packets, 12)
    return [
        encode_data_packet(
            azimuth[index], units, np.full((12, 2, 16), 50), (start_us + round(index * PACKET_PERIOD_US)) % HOUR_US
        )
        for index in range(packets)
    ]


def retimed(payload: bytes, timestamp_us: int) -> bytes:
    """A data packet with another time, also one beyond the hour."""
    return payload[:1200] + timestamp_us.to_bytes(4, "little") + payload[1204:]


@dataclass(frozen=True)
class Limited:
    """Packets of a sensor with a limited field of view, and what it did.

    Attributes:
        payloads: data packets.
        sent_s: time at which each packet is full and sent.
        azimuth_deg: azimuth of each ray, not wrapped, (packets, rays).
        time_s: time of each ray, (packets, rays).
        block_deg: azimuth at the start of each block or pair of blocks, not wrapped, (packets, columns).
    """

    payloads: list[bytes]
    sent_s: np.ndarray
    azimuth_deg: np.ndarray
    time_s: np.ndarray
    block_deg: np.ndarray


def limited_stream(
    turns: float, view_deg: tuple[float, float], rpm: float, dual: bool = False, start_deg: float = 123.4
) -> Limited:
    """Packets inside a round wall of 5 m from a sensor that sends only the blocks that begin within its field of view.

    The head turns evenly and fires all the time, a block each 110.592 us. Every ray has a return.
    """
    start, end = view_deg
    count = round(turns * 60.0 / rpm / (BLOCK_PERIOD_US * 1e-6))
    times = np.arange(count) * BLOCK_PERIOD_US * 1e-6
    turned = start_deg + times * rpm * 6.0
    columns = 6 if dual else 12
    sent = np.flatnonzero((turned - start) % 360.0 < ((end - start) % 360.0 or 360.0))
    sent = sent[: len(sent) // columns * columns].reshape(-1, columns)
    rays = (np.arange(2)[:, None] * 55.296 + np.arange(16) * 2.304).reshape(-1) * 1e-6
    time_s = (times[sent][..., None] + rays).reshape(len(sent), -1)
    pair = 2 if dual else 1
    payloads = [
        encode_data_packet(
            np.repeat(np.round(turned[row] * 100.0).astype(int) % 36000, pair),
            np.full((12, 2, 16), 2500),
            np.full((12, 2, 16), 50),
            round(times[row[0]] * 1e6),
            RETURN_DUAL if dual else RETURN_STRONGEST,
        )
        for row in sent
    ]
    sent_s = times[sent[:, -1]] + BLOCK_PERIOD_US * 1e-6
    return Limited(payloads, sent_s, start_deg + time_s * rpm * 6.0, time_s, turned[sent])


def udp_frame(payload: bytes, port: int = 2368, vlan: bool = False) -> bytes:
    """Ethernet, IPv4 and UDP around a payload."""
    udp = struct.pack(">HHHH", 2368, port, 8 + len(payload), 0) + payload
    ip = struct.pack(">BBHHHBBH4s4s", 0x45, 0, 20 + len(udp), 0, 0, 64, 17, 0, bytes((192, 168, 1, 201)), b"\xff" * 4)
    tag = b"\x81\x00\x00\x05" if vlan else b""
    return b"\xff" * 6 + b"\x60\x76\x88\0\0\0" + tag + b"\x08\x00" + ip + udp


def pcap(frames: list[tuple[int, bytes]], order: str = "<", nano: bool = False, link: int = 1) -> bytes:
    """A pcap file of (stamp_ns, frame)."""
    magic = 0xA1B23C4D if nano else 0xA1B2C3D4
    out = struct.pack(order + "IHHiIII", magic, 2, 4, 0, 0, 65535, link)
    for stamp_ns, frame in frames:
        fraction = stamp_ns % SECOND if nano else stamp_ns % SECOND // 1000
        out += struct.pack(order + "IIII", stamp_ns // SECOND, fraction, len(frame), len(frame)) + frame
    return out


def pcapng(frames: list[tuple[int, bytes]], order: str = "<", resolution: int | None = None) -> bytes:
    """A pcapng file of (stamp_ns, frame); resolution is if_tsresol, microseconds without it."""

    def block(kind: int, body: bytes) -> bytes:
        body += b"\0" * (-len(body) % 4)
        return struct.pack(order + "II", kind, 12 + len(body)) + body + struct.pack(order + "I", 12 + len(body))

    option = b"" if resolution is None else struct.pack(order + "HHB3xHH", 9, 1, resolution, 0, 0)
    unit_ns = 1000 if resolution is None else 10 ** (9 - resolution)
    out = block(0x0A0D0D0A, struct.pack(order + "IHHq", 0x1A2B3C4D, 1, 0, -1))
    out += block(1, struct.pack(order + "HHI", 1, 0, 65535) + option)
    for stamp_ns, frame in frames:
        ticks = stamp_ns // unit_ns
        head = struct.pack(order + "IIIII", 0, ticks >> 32, ticks & 0xFFFFFFFF, len(frame), len(frame))
        out += block(6, head + frame)
    return out
