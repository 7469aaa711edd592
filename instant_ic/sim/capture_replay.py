"""Replay of the UDP payloads of a recording at their recorded pace."""

import contextlib
import socket
from pathlib import Path

import numpy as np

from instant_ic.lidar.capture import CaptureReader
from instant_ic.lidar.packets import DATA_PACKET_BYTES, POSITION_PACKET_BYTES


def with_noise(packet: bytes, rng: np.random.Generator) -> bytes:
    """Return a data packet with a random half of its returns moved 2 mm nearer or farther."""
    data = np.frombuffer(packet, np.uint8).copy()
    returns = data[:1200].reshape(12, 100)[:, 4:].reshape(12, 32, 3)
    returns[..., 0] ^= rng.integers(0, 2, (12, 32), np.uint8) & (returns[..., :2].max(axis=2) > 1)
    return data.tobytes()


class CaptureReplay:
    """A sender of the data and position packets of a VLP-16 capture, with their recorded timing.

    The capture is repeated after a pause of one packet. From the second pass on, the ranges have noise, because the
    driver withholds data of a sensor that repeats itself.

    Args:
        path: pcap or pcapng file.
        host: destination address.
        data_port, position_port: destination UDP ports; the recorded ports are ignored.

    Attributes:
        sent: number of datagrams sent.
        duration_s: length of the recording.

    Raises:
        CaptureError: the file is not a capture.
        ValueError: the file has no VLP-16 packets.
    """

    def __init__(self, path: str | Path, host: str, data_port: int, position_port: int) -> None:
        ports = {DATA_PACKET_BYTES: data_port, POSITION_PACKET_BYTES: position_port}
        datagrams = [d for d in CaptureReader(path) if len(d.payload) in ports]
        if not datagrams:
            raise ValueError(f"pcap {path} has no VLP-16 packets (UDP payloads of 1206 or 512 bytes)")
        first = min(d.stamp_ns for d in datagrams)
        # The sort must be stable: the driver would count packets with equal stamps in another order as late.
        self._items = sorted(
            (((d.stamp_ns - first) * 1e-9, (host, ports[len(d.payload)]), d.payload) for d in datagrams),
            key=lambda item: item[0],
        )
        count = len(self._items)
        self.duration_s = self._items[-1][0]
        self._period_s = self.duration_s * (count + 1) / count if count > 1 else 0.1
        self._next = 0
        self._began_s = 0.0
        self._rng: np.random.Generator | None = None  # used from the second pass on
        self.sent = 0
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)

    def pump(self, time_s: float) -> None:
        """Send the packets that are due at ``time_s`` (seconds since the start)."""
        while self._items[self._next][0] + self._began_s <= time_s:
            _, address, payload = self._items[self._next]
            if self._rng is not None and len(payload) == DATA_PACKET_BYTES:
                payload = with_noise(payload, self._rng)
            # The kernel reports the refusal of an earlier datagram here. A real sensor ignores it.
            with contextlib.suppress(ConnectionRefusedError):
                self._socket.sendto(payload, address)
            self.sent += 1
            self._next += 1
            if self._next == len(self._items):
                self._next = 0
                self._rng = self._rng or np.random.default_rng(0)
                self._began_s = max(self._began_s + self._period_s, time_s - self._period_s)

    def close(self) -> None:
        self._socket.close()
