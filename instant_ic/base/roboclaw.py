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


class ControllerRestarted(LinkError):
    """The controller lost what it was set to, as after a brown-out: it must be stopped and set up again at once."""


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
        stops: times that the motors were stopped because a reply did not come.
    """

    transactions: int = 0
    retries: int = 0
    timeouts: int = 0
    crc_errors: int = 0
    stops: int = 0


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


_MOVING = (Command.DUTY_BOTH, Command.SPEED_BOTH, Command.SPEED_ACCELERATION_BOTH)


def _tenths(timeout_s: float) -> int:
    """Value of command 14 for a watchdog: never longer than asked for, never off."""
    return max(1, int(timeout_s * 10 + 1e-6))


def _acknowledged(port: SerialPort, command: int) -> bytes:
    reply = port.read(1)
    if not reply:
        raise TimeoutError(f"command {command}: no acknowledgement")
    if reply != ACKNOWLEDGE:
        raise ProtocolError(f"command {command}: acknowledged with 0x{reply.hex()} instead of 0xff")
    return reply


class Roboclaw:
    """One controller: a method a command, each repeated up to ``retries`` times.

    Every valid packet feeds the controller's watchdog, so a request that goes out while replies are missing could keep
    the motors running. After a missing reply, and on each `connect`, nothing but speed zero is sent until the
    controller has acknowledged one.

    Example:
        >>> with Roboclaw(RoboclawConfig(port="/dev/ttyACM0")) as roboclaw:   # doctest: +SKIP
        ...     roboclaw.drive([1000.0, 1000.0], acceleration_pps2=4000.0)
        ...     print(roboclaw.encoders(), roboclaw.battery_v())
    """

    def __init__(
        self,
        config: RoboclawConfig,
        open_port: Callable[[RoboclawConfig], SerialPort] = open_serial,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.config = config
        self.counters = LinkCounters()
        self.restarted = False
        """At the last `connect` the controller did not have the watchdog that an earlier one had set."""
        self._was_set = False
        self._stop_frame = write_frame(config.address, Command.SPEED_BOTH, struct.pack(">ii", 0, 0))
        self._open_port = open_port
        self._sleep = sleep
        self._port: SerialPort | None = None
        self._status_size: int | None = None

    @property
    def connected(self) -> bool:
        """Whether the port is open."""
        return self._port is not None

    def connect(self) -> str:
        """Open the port, stop the motors, ask for the firmware's version and set the controller's own watchdog.

        Returns:
            The version.

        Raises:
            LinkError: no port, nobody answers on it, or the watchdog cannot be set.
        """
        self.close()
        self._port = self._open_port(self.config)
        self._status_size = None
        try:
            self._stop_blind()
            self.stop()
            version = self.version()
            self.restarted = self._was_set and not self._watchdog_holds(self.watchdog_s())
            self.set_watchdog(self.config.watchdog_s)
            self.check_watchdog()
            self._was_set = True
        except LinkError:
            self.close()
            raise
        return version

    def close(self) -> None:
        """Stop the motors without waiting for an acknowledgement, and release the port."""
        self._stop_blind()
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
        self._acknowledge(Command.SPEED_BOTH, self._stop_frame)

    def set_watchdog(self, timeout_s: float) -> None:
        """Let the controller stop the motors after a silence; rounded down to whole 0.1 s (command 14)."""
        self._write(Command.SET_TIMEOUT, bytes((_tenths(timeout_s),)))

    def check_watchdog(self) -> None:
        """Read the watchdog back.

        Raises:
            ControllerRestarted: it is not what was set.
            LinkError: it cannot be read.
        """
        found_s = self.watchdog_s()
        if not self._watchdog_holds(found_s):
            raise ControllerRestarted(
                f"{self.config.port}: the controller's watchdog is {found_s:.1f} s instead of "
                f"{_tenths(self.config.watchdog_s) / 10:.1f} s: it restarted, look at its supply voltage"
            )

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

    def _watchdog_holds(self, found_s: float) -> bool:
        return round(found_s * 10) == _tenths(self.config.watchdog_s)

    def _stop_blind(self) -> None:
        """Write speed zero twice and await no reply: the first frame may meet the rest of a damaged one."""
        if self._port is None:
            return
        try:
            self._port.write(self._stop_frame)
            self._sleep(1.5 * INTER_BYTE_GAP_S)
            self._port.write(self._stop_frame)
        except (OSError, termios.error):
            # Unplugged: nothing reaches the controller any more, and its watchdog stops the motors. Whoever closes
            # the port for that has raised a LinkError.
            return

    def _write(self, command: int, data: bytes = b"") -> None:
        self._acknowledge(command, write_frame(self.config.address, command, data))

    def _acknowledge(self, command: int, frame: bytes) -> None:
        self._transact(command, _acknowledged, frame)

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

        When a reply does not come, the motors are stopped first, and a command that moves them is not repeated: an
        acknowledged stop is its end.

        Raises:
            LinkError: not connected, the port failed, or no try got a good reply.
        """
        port = self._port
        if port is None:
            raise LinkError(f"{self.config.port}: not connected; call connect() first")
        # One write call a frame: bytes that follow one another late would be dropped by the controller.
        sent = frame or read_request(self.config.address, command)
        self.counters.transactions += 1
        failure, silent = "", False
        for attempt in range(self.config.retries + 1):
            if attempt:
                self.counters.retries += 1
                # What the controller has of a damaged frame, it drops after this gap.
                self._sleep(1.5 * INTER_BYTE_GAP_S)
            try:
                port.reset_input_buffer()
                if silent:
                    port.write(self._stop_frame)
                    _acknowledged(port, Command.SPEED_BOTH)
                    if command in _MOVING:
                        return ACKNOWLEDGE
                    silent = False
                    port.reset_input_buffer()
                port.write(sent)
                return receive(port, command)
            except TimeoutError as error:
                self.counters.timeouts += 1
                self.counters.stops += not silent
                failure, silent = failure or str(error), True
                self._stop_blind()
            except ProtocolError as error:
                self.counters.crc_errors += 1
                failure = failure or str(error)
            # Unplugged, or the pseudo-terminal is gone; pyserial's own exception is an OSError.
            except (OSError, termios.error) as error:
                self.close()
                raise LinkError(f"{self.config.port}: lost ({error})") from error
        raise LinkError(
            f"{self.config.port}: no good reply in {self.config.retries + 1} tries ({failure}); "
            f"look at cable, baud rate ({self.config.baud}) and address (0x{self.config.address:02x})"
        )
