"""Driver of a RoboClaw over a serial link."""

import struct
import termios
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from instant_ic.base.config import RoboclawConfig
from instant_ic.base.protocol import (
    ACKNOWLEDGE,
    INTER_BYTE_GAP_S,
    MOTORS_OFF,
    PINS,
    PWM_MAX,
    Command,
    ProtocolError,
    decode_reply,
    describe_status,
    latches,
    read_request,
    write_frame,
)
from instant_ic.util.pace import current


class LinkError(ConnectionError):
    """The controller cannot be reached; the text says what was tried and what to check."""


class ControllerRestarted(LinkError):
    """The controller lost its settings, for example in a brown-out. Stop the base and connect again at once."""


class SerialPort(Protocol):
    """Part of pyserial's ``Serial`` that the driver uses."""

    def write(self, data: bytes, /) -> int | None:
        """Send bytes."""

    def read(self, size: int = 1, /) -> bytes:
        """Receive up to ``size`` bytes, fewer if the port's time-out expires."""

    def reset_input_buffer(self) -> None:
        """Drop received bytes that have not been read."""

    def close(self) -> None:
        """Release the port."""


@dataclass(frozen=True)
class ControllerStatus:
    """Reply to command 90.

    Attributes:
        value: status bits.
        size: length in bytes, 2 or 4; each length has its own meaning of the bits.
    """

    value: int
    size: int

    @property
    def faults(self) -> list[str]:
        return describe_status(self.value, self.size)[0]

    @property
    def warnings(self) -> list[str]:
        return describe_status(self.value, self.size)[1]


@dataclass
class LinkCounters:
    """Link statistics since the driver was created.

    Attributes:
        retries: number of repeated commands.
        timeouts: number of missing or incomplete replies.
        crc_errors: number of damaged replies.
        stops: number of times the motors were stopped because a reply was missing.
    """

    retries: int = 0
    timeouts: int = 0
    crc_errors: int = 0
    stops: int = 0


def open_serial(config: RoboclawConfig) -> SerialPort:
    """Open the port named in the configuration.

    Raises:
        LinkError: the port cannot be opened.
    """
    import serial

    timeout_s = current().timeout_s(config.reply_timeout_s)
    try:
        return serial.Serial(
            config.port,
            config.baud,
            timeout=timeout_s,
            write_timeout=max(0.2, timeout_s),
            exclusive=True,
        )
    except (serial.SerialException, OSError) as error:
        raise LinkError(
            f"{config.port}: cannot be opened ({error}). Check that the controller is plugged in and switched on, that "
            "no other program uses the port, and that you are in the group dialout."
        ) from error


_DRAIN_READS = 20
"""Number of reads after which the driver stops waiting for a quiet line."""


def _tenths(timeout_s: float) -> int:
    """Return the value of command 14 for a watchdog time, rounded down but at least 1, as 0 turns the watchdog off."""
    return max(1, int(timeout_s * 10 + 1e-6))


def _acknowledged(port: SerialPort, command: int) -> bytes:
    reply = port.read(1)
    if not reply:
        raise TimeoutError(f"command {command}: no acknowledgement")
    if reply != ACKNOWLEDGE:
        raise ProtocolError(f"command {command}: acknowledged with 0x{reply.hex()} instead of 0xff")
    return reply


class Roboclaw:
    """Driver of one controller with one method per command, each repeated up to ``retries`` times.

    Every valid packet resets the controller's watchdog, so a request sent while replies are missing could keep the
    motors running. After a missing reply, and on each `connect`, the driver sends only stops until the controller has
    acknowledged one. Acknowledgements have no number, so the driver first waits until the line is quiet. Otherwise a
    late acknowledgement could confirm the next command. A stop takes the power off the motors. A set point of zero
    would not stop a track with a dead or reversed encoder, because the speed loop would go on driving it.

    Example:
        >>> with closing(Roboclaw(RoboclawConfig(port="/dev/ttyACM0"))) as roboclaw:   # doctest: +SKIP
        ...     print(roboclaw.connect(), roboclaw.battery_v())
        ...     roboclaw.drive([1000.0, 1000.0], acceleration_pps2=4000.0)
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
        """True if, at the last `connect`, the controller had lost the watchdog setting of an earlier connection."""
        self._was_set = False
        self._stop_frame = write_frame(config.address, Command.DUTY_ACCELERATION_BOTH, MOTORS_OFF)
        self._has_limits = True  # false once the firmware has not answered a limit command
        self._open_port = open_port
        self._sleep = sleep
        self._port: SerialPort | None = None
        self._status_size: int | None = None

    @property
    def connected(self) -> bool:
        return self._port is not None

    def connect(self) -> str:
        """Open the port, stop the motors, read the firmware version, set the watchdog and check the stop button's pin.

        Returns:
            Firmware version.

        Raises:
            LinkError: the port cannot be opened, no controller answers, the watchdog cannot be set, or the pin of the
                stop button does not latch.
        """
        self.close()
        self.restarted = False
        self._port = self._open_port(self.config)
        self._status_size = None
        try:
            self._stop_blind()
            self._drain(self._port)
            self.stop()
            version = self.version()
            self.restarted = self._was_set and not self._watchdog_holds(self.watchdog_s())
            self.set_watchdog(self.config.watchdog_s)
            self.check_watchdog()
            self.check_button()
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

    def drive(self, speed_pps: NDArray[np.float64] | list[float], acceleration_pps2: float) -> None:
        """Set closed-loop speeds of M1 and M2, pulses/s, with a ramp, pulses/s^2 (command 40)."""
        m1, m2 = (round(float(speed)) for speed in speed_pps)
        self._write(Command.SPEED_ACCELERATION_BOTH, struct.pack(">Iii", round(acceleration_pps2), m1, m2))

    def stop(self) -> None:
        """Take the power off both motors, which brakes them independently of the encoders (command 54)."""
        self._transact(Command.DUTY_ACCELERATION_BOTH, _acknowledged, self._stop_frame)

    def set_watchdog(self, timeout_s: float) -> None:
        """Make the controller stop the motors after this time without a packet; rounded down to 0.1 s (command 14)."""
        self._write(Command.SET_TIMEOUT, bytes((_tenths(timeout_s),)))

    def check_watchdog(self) -> None:
        """Read the watchdog back and compare it with the configuration.

        Raises:
            ControllerRestarted: the watchdog has another value.
            LinkError: the watchdog cannot be read.
        """
        found_s = self.watchdog_s()
        if not self._watchdog_holds(found_s):
            raise ControllerRestarted(
                f"{self.config.port}: the controller's watchdog is {found_s:.1f} s instead of "
                f"{_tenths(self.config.watchdog_s) / 10:.1f} s: it has restarted. Check its supply voltage."
            )

    def watchdog_s(self) -> float:
        """Return the watchdog time of the controller, seconds; 0 is off (command 15)."""
        return self._read(Command.READ_TIMEOUT, 1)[0] * 0.1

    def check_button(self) -> None:
        """Check that the pin of the robot's stop button is a latching emergency stop (command 75).

        Raises:
            LinkError: the pin is not a latching stop, or its mode cannot be read.
        """
        pin, port = self.config.estop_pin, self.config.port
        if not pin:
            return
        advice = (
            f"The robot does not drive. Set {pin} to E-Stop (latching) with the manufacturer's tool and save it in the "
            "controller, or set roboclaw.estop_pin to the button's pin, or to '' if there is no button."
        )
        size = self.status().size
        try:
            modes = self._transact(Command.READ_PIN_FUNCTIONS, self._reply(3, 5))
        except LinkError as error:
            raise LinkError(f"{port}: mode of the stop button's pin {pin} unknown: {error} {advice}") from error
        mode = modes[PINS.index(pin)]
        if not latches(mode, pin, size):
            raise LinkError(f"{port}: mode 0x{mode:02x} of the stop button's pin {pin} is no latching stop. {advice}")

    def limit_speed_error(self, limit_pps: float) -> bool:
        """Set the speed error at which the controller itself stops a motor (command 109), and read it back.

        Args:
            limit_pps: largest difference between measured speed and set point, pulses/s.

        Returns:
            True if the firmware has such a limit and accepted the value.
        """
        if not self._has_limits:
            return False
        try:
            kept = self._transact(Command.READ_SPEED_ERROR_LIMITS, self._reply(4, 8))
        except LinkError:
            if not self.connected:
                raise
            self._has_limits = False
            return False
        width = len(kept) // 2  # bytes of a limit; firmware versions differ
        wanted = 2 * min(round(limit_pps), 256**width - 1).to_bytes(width, "big")
        if kept != wanted:
            self._write(Command.SET_SPEED_ERROR_LIMITS, wanted)
        return self._read(Command.READ_SPEED_ERROR_LIMITS, len(wanted)) == wanted

    def pwm(self) -> NDArray[np.float64]:
        """Return the power on M1 and M2, -1 to 1, (2,) (command 48)."""
        return np.array(struct.unpack(">hh", self._read(Command.READ_PWM, 4))) / PWM_MAX

    def currents_a(self) -> NDArray[np.float64]:
        """Return the currents of M1 and M2, amperes, (2,) (command 49)."""
        return np.array(struct.unpack(">hh", self._read(Command.READ_CURRENTS, 4))) * 0.01

    def encoders(self) -> NDArray[np.int64]:
        """Return the counts of M1 and M2 modulo 2^32, (2,) (command 78)."""
        return np.array(struct.unpack(">II", self._read(Command.READ_ENCODERS, 8)), np.int64)

    def battery_v(self) -> float:
        """Return the main battery voltage, volts (command 24)."""
        return int.from_bytes(self._read(Command.READ_MAIN_BATTERY, 2), "big") * 0.1

    def status(self) -> ControllerStatus:
        """Return the faults and warnings (command 90).

        Old firmware replies with 2 bytes, newer firmware with 4. The first reply determines the size, which is kept
        until the next connect, so that old firmware does not cost a time-out on each call.
        """
        size = self._status_size
        data = self._transact(Command.READ_STATUS, self._reply(2, 4) if size is None else self._reply(size))
        self._status_size = len(data)
        return ControllerStatus(int.from_bytes(data, "big"), len(data))

    def version(self) -> str:
        """Return the firmware version text (command 21)."""
        return self._transact(Command.READ_VERSION, self._version_reply).decode("ascii", "replace").strip()

    def _watchdog_holds(self, found_s: float) -> bool:
        return round(found_s * 10) == _tenths(self.config.watchdog_s)

    def _drain(self, port: SerialPort) -> None:
        """Drop received bytes until none has arrived for ``reply_timeout_s``."""
        for _ in range(_DRAIN_READS):
            if not port.read(64):
                return

    def _stop_blind(self) -> None:
        """Write a stop twice without waiting for a reply. The first may be lost after a damaged frame."""
        if self._port is None:
            return
        try:
            self._port.write(self._stop_frame)
            self._sleep(1.5 * INTER_BYTE_GAP_S)
            self._port.write(self._stop_frame)
        except (OSError, termios.error):
            # The cable is unplugged; the controller's watchdog stops the motors. The caller that closes the port has
            # already raised a LinkError.
            return

    def _write(self, command: int, data: bytes) -> None:
        self._transact(command, _acknowledged, write_frame(self.config.address, command, data))

    def _read(self, command: int, size: int) -> bytes:
        return self._transact(command, self._reply(size))

    def _reply(self, *sizes: int) -> Callable[[SerialPort, int], bytes]:
        """Return a reader of replies whose data length depends on the firmware; ``sizes`` are in ascending order."""

        def read(port: SerialPort, command: int) -> bytes:
            received = port.read(sizes[-1] + 2)
            if len(received) - 2 not in sizes:
                raise TimeoutError(f"command {command}: received {len(received)} of {sizes[-1] + 2} bytes")
            return decode_reply(self.config.address, command, received)

        return read

    def _version_reply(self, port: SerialPort, command: int) -> bytes:
        """Read text up to its null byte, then the CRC. The length is not known in advance."""
        received = bytearray()
        while not received.endswith(b"\0"):
            byte = port.read(1)
            if not byte or len(received) > 48:
                raise TimeoutError(f"command {command}: the version text has no end ({received.hex()})")
            received += byte
        received += port.read(2)
        return decode_reply(self.config.address, command, bytes(received)).rstrip(b"\0")

    def _transact(self, command: int, receive: Callable[[SerialPort, int], bytes], frame: bytes | None = None) -> bytes:
        """Send a frame and receive its reply; repeat both if the reply is missing or damaged.

        Before a repeat, the motors are stopped. A command that moves them is not repeated, but ends with the
        acknowledged stop.

        Raises:
            LinkError: not connected, the port failed, or no attempt got a valid reply.
        """
        port = self._port
        if port is None:
            raise LinkError(f"{self.config.port}: not connected; call connect() first")
        # Write each frame in one call, because the controller drops a frame with gaps between its bytes.
        sent = frame or read_request(self.config.address, command)
        failure, silent = "", False
        for attempt in range(self.config.retries + 1):
            if attempt:
                self.counters.retries += 1
                # After this gap the controller drops the remains of a damaged frame.
                self._sleep(1.5 * INTER_BYTE_GAP_S)
            try:
                if silent:
                    self._drain(port)
                port.reset_input_buffer()
                if silent:
                    port.write(self._stop_frame)
                    _acknowledged(port, Command.DUTY_ACCELERATION_BOTH)
                    if command == Command.SPEED_ACCELERATION_BOTH:
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
            # The cable is unplugged or the pseudo-terminal is gone; pyserial's exception is an OSError.
            except (OSError, termios.error) as error:
                self.close()
                raise LinkError(f"{self.config.port}: connection lost ({error})") from error
        raise LinkError(
            f"{self.config.port}: no valid reply in {self.config.retries + 1} attempts ({failure}). "
            f"Check the cable, the baud rate ({self.config.baud}) and the address (0x{self.config.address:02x})."
        )
