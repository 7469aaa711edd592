"""Receiver of the sensor's UDP packets."""

import ipaddress
import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Annotated

from instant_ic.config.ranges import Range, check_ranges
from instant_ic.lidar.packets import DATA_PACKET_BYTES, check_data_packet
from instant_ic.lidar.sources import SourceGuard
from instant_ic.util.closing import Closing
from instant_ic.util.pace import current

_SO_TIMESTAMPNS = getattr(socket, "SO_TIMESTAMPNS", 35)
"""Constant of Linux, which Python 3.11 does not define."""
_TIMESPEC = struct.Struct("@ll")
_MOST_AT_ONCE = 512
"""Datagrams per read, so that a flood does not delay the shutdown."""
_GATHER_S = 0.005
"""The first packet waits this long for the next ones: waking up for each of 754 packets a second costs more than
decoding them. The kernel stamps each packet at its arrival."""


class ReceiverError(OSError):
    """The port cannot be bound; the text says why."""


@dataclass(frozen=True)
class ReceiverConfig:
    """Addresses and port of the receiver.

    Attributes:
        host: local address; 0.0.0.0 also receives the broadcasts of a sensor with factory settings.
        port: UDP port of data packets; 0: any free port.
        sensor: the sensor's IPv4 address; empty: the first sender until the driver restarts.
    """

    host: str = "0.0.0.0"
    port: Annotated[int, Range(0, 65535)] = 2368
    sensor: str = ""

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.sensor:
            try:
                ipaddress.IPv4Address(self.sensor)
            except ValueError as error:
                raise ValueError(f"sensor must be an IPv4 address or empty (got {self.sensor!r})") from error


class PacketReceiver(Closing):
    """Socket for the sensor's packets.

    Example:
        >>> with PacketReceiver(ReceiverConfig()) as receiver:      # doctest: +SKIP
        ...     for payload, stamp_ns in receiver.read(timeout_s=0.1): ...

    Attributes:
        sources: check of the senders.
        port: the bound UDP port.

    Raises:
        ReceiverError: the port is in use or not permitted.
    """

    def __init__(
        self,
        config: ReceiverConfig,
        sources: SourceGuard | None = None,
        steady_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.sources = sources or SourceGuard(config.sensor)
        self._steady_ns = steady_ns
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setblocking(False)
            # Room for half a second of packets, because the decoder's thread may be delayed.
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
            self._socket.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
            self._socket.bind((config.host, config.port))
        except OSError as error:
            self.close()
            raise ReceiverError(
                f"UDP {config.host}:{config.port} cannot be bound ({error.strerror}). "
                "Stop the program that uses the port: 'ss -ulpn' shows it."
            ) from error
        self.port = int(self._socket.getsockname()[1])

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def read(self, timeout_s: float) -> Iterator[tuple[bytes, int]]:
        """Yield payload and kernel's time of arrival of the datagrams; wait at most ``timeout_s`` for the first."""
        if select.select([self._socket], [], [], timeout_s)[0]:
            time.sleep(_GATHER_S)
        for _ in range(_MOST_AT_ONCE):
            try:
                payload, ancillary, _, sender = self._socket.recvmsg(DATA_PACKET_BYTES + 512, 64)
            except BlockingIOError:
                break
            if self.sources.admit(sender, check_data_packet(payload) is None, self._steady_ns()):
                yield payload, _stamp_ns(ancillary)


class ReceiverThread(threading.Thread):
    """Thread that reads a receiver.

    Args:
        receiver: closed at the end.
        on_packet: called on this thread with payload and stamp of each datagram.
        on_fault: called on this thread with the exception that ended it.
    """

    def __init__(
        self,
        receiver: PacketReceiver,
        on_packet: Callable[[bytes, int], None],
        on_fault: Callable[[Exception], None],
    ) -> None:
        super().__init__(name="vlp16 receiver", daemon=True)
        self.receiver = receiver
        self._on_packet = on_packet
        self._on_fault = on_fault
        self.ending = threading.Event()

    def run(self) -> None:
        try:
            while not self.ending.is_set():
                for payload, stamp_ns in self.receiver.read(timeout_s=0.2):
                    self._on_packet(payload, stamp_ns)
        except Exception as error:  # noqa: BLE001 - nothing else reports what ends a thread
            self._on_fault(error)

    def end(self) -> None:
        self.ending.set()
        self.join(2.0)
        self.receiver.close()


def _stamp_ns(ancillary: list[tuple[int, int, bytes]]) -> int:
    for level, kind, data in ancillary:
        if level == socket.SOL_SOCKET and kind == _SO_TIMESTAMPNS and len(data) >= _TIMESPEC.size:
            seconds, nanoseconds = _TIMESPEC.unpack_from(data)
            return current().stamp_ns(int(seconds * 1_000_000_000 + nanoseconds))
    return current().now_ns()
