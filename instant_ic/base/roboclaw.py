"""Talks to a RoboClaw over a serial line."""

import struct
import termios
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from instant_ic.base.config import RoboclawConfig
from instant_ic.base.protocol import (
    ACKNOWLEDGE,
    INTER_BYTE_GAP_S,
    Command,
    ProtocolError,
    decode_reply,
    describe_status,
    read_request,
    write_frame,
)


class LinkError(ConnectionError):
    """The controller cannot be reached; the text says what was tried and what to look at."""


class SerialPort(Protocol):
    """The part of pyserial's ``Serial`` that is used here."""

    def write(self, data: bytes, /) -> int | None:
        """Send bytes."""

    def read(self, size: int = 1, /) -> bytes:
        """Receive up to size bytes; fewer when the port's time-out passes."""

    def reset_input_buffer(self) -> None:
        """Drop what was received and not read."""

    def close(self) -> None:
        """Release the port."""


@dataclass(frozen=True)
class Status:
    """Reply to command 90.

    Attributes:
        value: the bits.
        size: 2 or 4, bytes; the two have different bits.
    """

    value: int
    size: int

    @property
    def faults(self) -> list[str]:
        """Faults in words."""
        return describe_status(self.value, self.size)[0]

    @property
    def warnings(self) -> list[str]:
        """Warnings in words."""
        return describe_status(self.value, self.size)[1]


@dataclass
class LinkCounters:
    """What went wrong on the line since the driver was made.

    Attributes:
        transactions: commands sent, repeats not counted.
        retries: repeats.
        timeouts: replies that did not come whole.
        crc_errors: replies that came damaged.
    """

    transactions: int = 0
    retries: int = 0
    timeouts: int = 0
    crc_errors: int = 0


def open_serial(config: RoboclawConfig) -> SerialPort:
    """Open the port named in the configuration.

    Raises:
        LinkError: it cannot be opened.
    """
    import serial

    try:
        return serial.Serial(
            config.port,
            config.baud,
            timeout=config.reply_timeout_s,
            write_timeout=max(0.2, config.reply_timeout_s),
            exclusive=True,
        )
    except (serial.SerialException, OSError) as error:
        raise LinkError(
            f"{config.port}: cannot be opened ({error}); is the controller plugged in and switched on, "
            "is no other program using it, and may you use it (group dialout)?"
        ) from error


class Roboclaw:
    """One controller: a method a command, each repeated up to ``retries`` times.

    Example:
        >>> with Roboclaw(RoboclawConfig(port="/dev/ttyACM0")) as roboclaw:   # doctest: +SKIP
        ...     roboclaw.drive([1000.0, 1000.0], acceleration_pps2=4000.0)
        ...     print(roboclaw.encoders(), roboclaw.battery_v())
    """

    def __init__(self, config: RoboclawConfig, open_port: Callable[[RoboclawConfig], SerialPort] = open_serial) -> None:
        self.config = config
        self.counters = LinkCounters()
        self._open_port = open_port
        self._port: SerialPort | None = None
        self._status_size: int | None = None

    @property
    def connected(self) -> bool:
        """Whether the port is open."""
        return self._port is not None

    def connect(self) -> str:
        """Open the port, ask for the firmware's version and set the controller's own watchdog.

        Returns:
            The version.

        Raises:
            LinkError: no port, or nobody answers on it.
        """
        self.close()
        self._port = self._open_port(self.config)
        self._status_size = None
        try:
            version = self.version()
            self.set_watchdog(self.config.watchdog_s)
        except LinkError:
            self.close()
            raise
        return version

    def close(self) -> None:
        """Release the port. Motors go on until the watchdog: call `stop` before."""
        port, self._port = self._port, None
        if port is not None:
            port.close()

    def __enter__(self) -> Self:
        """Connect."""
        self.connect()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop the motors and release the port, whatever happened."""
        try:
            if self.connected:
                self.stop()
        finally:
            self.close()

    def drive(self, speed_pps: NDArray[np.float64] | list[float], acceleration_pps2: float) -> None:
        """Closed-loop speeds of M1 and M2, pulses/s, with a ramp, pulses/s^2 (command 40)."""
        m1, m2 = (round(float(speed)) for speed in speed_pps)
        self._write(Command.SPEED_ACCELERATION_BOTH, struct.pack(">Iii", round(acceleration_pps2), m1, m2))

    def stop(self) -> None:
        """Speed zero for both motors at once, without a ramp (command 37)."""
        self._write(Command.SPEED_BOTH, struct.pack(">ii", 0, 0))

    def set_watchdog(self, timeout_s: float) -> None:
        """Let the controller stop the motors when no packet came for so long; steps of 0.1 s (command 14)."""
        self._write(Command.SET_TIMEOUT, bytes((max(1, round(timeout_s * 10)),)))

    def reset_encoders(self) -> None:
        """Set both counts to zero (command 20)."""
        self._write(Command.RESET_ENCODERS)

    def watchdog_s(self) -> float:
        """The controller's watchdog, seconds, 0 is off (command 15)."""
        return self._read(Command.READ_TIMEOUT, 1)[0] * 0.1

    def encoders(self) -> NDArray[np.int64]:
        """Counts of M1 and M2 modulo 2^32, (2,) (command 78)."""
        return np.array(struct.unpack(">II", self._read(Command.READ_ENCODERS, 8)), np.int64)

    def speeds_pps(self) -> NDArray[np.float64]:
        """Measured speeds of M1 and M2, pulses/s, (2,) (commands 18 and 19)."""
        speeds = []
        for command in (Command.READ_SPEED_1, Command.READ_SPEED_2):
            speed, backwards = struct.unpack(">IB", self._read(command, 5))
            speeds.append(-float(speed) if backwards else float(speed))
        return np.array(speeds)

    def battery_v(self) -> float:
        """Main battery, volts (command 24)."""
        return int.from_bytes(self._read(Command.READ_MAIN_BATTERY, 2), "big") * 0.1

    def status(self) -> Status:
        """Faults and warnings (command 90).

        Old firmware replies with 2 bytes, newer with 4. Which it is shows by length and CRC once, and is
        kept until the next connect, so that old firmware does not cost a time-out each time.
        """
        size = self._status_size
        data = self._transact(Command.READ_STATUS, self._status_reply if size is None else self._reply(size))
        self._status_size = len(data)
        return Status(int.from_bytes(data, "big"), len(data))

    def version(self) -> str:
        """Text of the firmware's version (command 21)."""
        return self._transact(Command.READ_VERSION, self._version_reply).decode("ascii", "replace").strip()

    def _write(self, command: int, data: bytes = b"") -> None:
        frame = write_frame(self.config.address, command, data)

        def acknowledged(port: SerialPort, command: int) -> bytes:
            reply = port.read(1)
            if not reply:
                raise TimeoutError(f"command {command}: no acknowledgement")
            if reply != ACKNOWLEDGE:
                raise ProtocolError(f"command {command}: acknowledged with 0x{reply.hex()} instead of 0xff")
            return reply

        self._transact(command, acknowledged, frame)

    def _read(self, command: int, size: int) -> bytes:
        return self._transact(command, self._reply(size))

    def _reply(self, size: int) -> Callable[[SerialPort, int], bytes]:
        """Reader of a reply with ``size`` bytes of data."""

        def read(port: SerialPort, command: int) -> bytes:
            received = port.read(size + 2)
            if len(received) < size + 2:
                raise TimeoutError(f"command {command}: {len(received)} of {size + 2} bytes came")
            return decode_reply(self.config.address, command, received)

        return read

    def _status_reply(self, port: SerialPort, command: int) -> bytes:
        received = port.read(6)
        if len(received) not in (4, 6):
            raise TimeoutError(f"command {command}: {len(received)} bytes came, which is neither 4 nor 6")
        return decode_reply(self.config.address, command, received)

    def _version_reply(self, port: SerialPort, command: int) -> bytes:
        """Text up to its null byte, then the CRC: the length is not known before."""
        received = bytearray()
        while not received.endswith(b"\0"):
            byte = port.read(1)
            if not byte or len(received) > 48:
                raise TimeoutError(f"command {command}: the version's text does not end ({received.hex()})")
            received += byte
        received += port.read(2)
        return decode_reply(self.config.address, command, bytes(received)).rstrip(b"\0")

    def _transact(self, command: int, receive: Callable[[SerialPort, int], bytes], frame: bytes | None = None) -> bytes:
        """Send a frame and receive its reply, with repeats.

        Raises:
            LinkError: not connected, the port failed, or no try got a good reply.
        """
        port = self._port
        if port is None:
            raise LinkError(f"{self.config.port}: not connected; call connect() first")
        # One write call a frame: bytes that follow one another late would be dropped by the controller.
        sent = frame or read_request(self.config.address, command)
        self.counters.transactions += 1
        failure = ""
        for attempt in range(self.config.retries + 1):
            if attempt:
                self.counters.retries += 1
                # What the controller has of a damaged frame, it drops after this gap.
                time.sleep(1.5 * INTER_BYTE_GAP_S)
            try:
                port.reset_input_buffer()
                port.write(sent)
                return receive(port, command)
            except TimeoutError as error:
                self.counters.timeouts += 1
                failure = str(error)
            except ProtocolError as error:
                self.counters.crc_errors += 1
                failure = str(error)
            # Unplugged, or the pseudo-terminal is gone; pyserial's own exception is an OSError.
            except (OSError, termios.error) as error:
                self.close()
                raise LinkError(f"{self.config.port}: lost ({error})") from error
        raise LinkError(
            f"{self.config.port}: no good reply in {self.config.retries + 1} tries ({failure}); "
            f"look at cable, baud rate ({self.config.baud}) and address (0x{self.config.address:02x})"
        )
