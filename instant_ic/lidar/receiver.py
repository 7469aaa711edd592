"""Receiver of the sensor's UDP packets."""

import ipaddress
import selectors
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Annotated, NamedTuple

from instant_ic.config.ranges import Range, check_ranges
from instant_ic.lidar.packets import DATA_PACKET_BYTES, POSITION_PACKET_BYTES, check_data_packet
from instant_ic.lidar.sources import SourceGuard
from instant_ic.util.closing import Closing
from instant_ic.util.pace import current

_SO_TIMESTAMPNS = getattr(socket, "SO_TIMESTAMPNS", 35)
"""Constant of Linux, which Python 3.11 does not define."""
_TIMESPEC = struct.Struct("@ll")
_MOST_AT_ONCE = 512
"""Datagrams per read from one port, so that a flood on it delays neither the other port nor the shutdown."""
_GATHER_S = 0.005
"""Wait after a first packet for the next ones, because waking up for each of 754 packets a second costs more than
decoding them. Stamps do not suffer: the kernel stamps each packet at its arrival."""


class ReceiverError(OSError):
    """A port cannot be bound; the text says which one and why."""


@dataclass(frozen=True)
class ReceiverConfig:
    """Addresses and ports of the receiver.

    Attributes:
        host: local address; 0.0.0.0 also receives the broadcasts of a sensor with factory settings.
        port: UDP port of data packets; 0: any free port.
        position_port: UDP port of position packets; -1: not received.
        sensor: the sensor's IPv4 address; empty: the first sender until the driver restarts.
    """

    host: str = "0.0.0.0"
    port: Annotated[int, Range(0, 65535)] = 2368
    position_port: Annotated[int, Range(-1, 65535)] = 8308
    sensor: str = ""

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.sensor:
            try:
                ipaddress.IPv4Address(self.sensor)
            except ValueError as error:
                raise ValueError(f"sensor must be an IPv4 address or empty (got {self.sensor!r})") from error


class SensorDatagram(NamedTuple):
    """A datagram from the sensor."""

    stamp_ns: int
    """Time of arrival in the kernel, since the epoch."""
    payload: bytes
    is_data: bool
    """True from the data port, False from the position port."""


class PacketReceiver(Closing):
    """Sockets on both ports of the sensor.

    Example:
        >>> with PacketReceiver(ReceiverConfig()) as receiver:      # doctest: +SKIP
        ...     for received in receiver.read(timeout_s=0.1): ...

    Attributes:
        sources: check of the senders.
        port, position_port: the bound UDP ports; -1 for none.

    Raises:
        ReceiverError: a port is in use or not permitted.
    """

    def __init__(
        self,
        config: ReceiverConfig,
        sources: SourceGuard | None = None,
        steady_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.sources = sources or SourceGuard(config.sensor)
        self._steady_ns = steady_ns
        self._selector = selectors.DefaultSelector()
        self._sockets: list[socket.socket] = []
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None
        try:
            self.port = self._bind(config.host, config.port, is_data=True)
            position = config.position_port
            self.position_port = self._bind(config.host, position, is_data=False) if position >= 0 else -1
        except ReceiverError:
            self.close()
            raise

    def start(self, on_datagram: Callable[[SensorDatagram], None], on_fault: Callable[[Exception], None]) -> None:
        """Read on a thread of its own until :meth:`close`.

        Args:
            on_datagram: called on that thread with each datagram.
            on_fault: called on that thread with the exception that ended it.
        """

        def run() -> None:
            try:
                while not self._ending.is_set():
                    for received in self.read(timeout_s=0.2):
                        on_datagram(received)
            except Exception as error:  # noqa: BLE001 - nothing else reports what ends a thread
                on_fault(error)

        self._thread = threading.Thread(target=run, name="vlp16 receiver", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._ending.set()
        if self._thread is not None:
            self._thread.join(2.0)
        for bound in self._sockets:
            bound.close()
        self._selector.close()

    def read(self, timeout_s: float) -> Iterator[SensorDatagram]:
        """Yield the sensor's datagrams; wait at most ``timeout_s`` for the first one, and yield none if it is late."""
        if self._selector.select(timeout_s):
            time.sleep(_GATHER_S)
        for key, _ in self._selector.select(0.0):
            bound, is_data = key.fileobj, bool(key.data)
            assert isinstance(bound, socket.socket)
            for _ in range(_MOST_AT_ONCE):
                try:
                    payload, ancillary, _, sender = bound.recvmsg(DATA_PACKET_BYTES + 512, 64)
                except BlockingIOError:
                    break
                well_formed = check_data_packet(payload) is None if is_data else len(payload) == POSITION_PACKET_BYTES
                if self.sources.admit(sender, is_data, well_formed, self._steady_ns()):
                    yield SensorDatagram(_stamp_ns(ancillary), payload, is_data)

    def _bind(self, host: str, port: int, is_data: bool) -> int:
        bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._sockets.append(bound)
        try:
            bound.setblocking(False)
            # Room for half a second of packets, because the decoder's thread may be delayed.
            bound.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
            bound.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
            bound.bind((host, port))
        except OSError as error:
            raise ReceiverError(
                f"UDP {host}:{port} cannot be bound ({error.strerror}). "
                "Stop the program that uses the port: 'ss -ulpn' shows it."
            ) from error
        self._selector.register(bound, selectors.EVENT_READ, is_data)
        return int(bound.getsockname()[1])


def _stamp_ns(ancillary: list[tuple[int, int, bytes]]) -> int:
    for level, kind, data in ancillary:
        if level == socket.SOL_SOCKET and kind == _SO_TIMESTAMPNS and len(data) >= _TIMESPEC.size:
            seconds, nanoseconds = _TIMESPEC.unpack_from(data)
            return current().stamp_ns(int(seconds * 1_000_000_000 + nanoseconds))
    return current().now_ns()
