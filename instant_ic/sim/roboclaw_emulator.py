"""A RoboClaw emulated in memory: request bytes in, reply bytes out.

The emulator has no clock and no port. The caller feeds it bytes and advances its time with
`RoboclawEmulator.advance`.
"""

import struct

import numpy as np
from numpy.typing import NDArray

from instant_ic.base.protocol import (
    ACKNOWLEDGE,
    ADDRESSES,
    ESTOP_BITS,
    INTER_BYTE_GAP_S,
    PINS,
    PWM_MAX,
    WRITE_DATA_BYTES,
    Command,
    crc16,
    describe_status,
    encode_reply,
    latches,
)

MAX_SPEED_PPS = 4000.0
_STEEPEST, _STEEPEST_S = 655359, 0.05
"""Largest ramp of command 54, and the time that it takes from full power to none."""
_SPEED_ERRORS = (0x0100, 0x0200)
"""Status bits of the motors' speed errors."""


class RoboclawEmulator:
    """The controller and two motors with encoders.

    The motors follow `setpoint_pps` exactly if ``ideal_motors`` is True. Otherwise the robot simulation writes
    `speed_pps`, `encoder`, `power` and `currents_a`.

    Attributes:
        target_speed_pps: target speed of the last command, pulses/s, (2,) M1 and M2.
        acceleration_pps2: ramp of the last command, pulses/s^2; 0 means no ramp.
        setpoint_pps: target after the ramp, pulses/s, (2,).
        closed_loop: True while the speed loops regulate; otherwise the set points are power, given as the speed without
            load.
        speed_pps: speed measured by the encoders, pulses/s, (2,).
        encoder: counted pulses, (2,); replies contain them modulo 2^32.
        power: power on the motors, -1 to 1, (2,).
        currents_a: currents of the motors, amperes, (2,).
        battery_v: main battery, volts.
        status: bits of command 90; while an error bit is set, the motors are off.
        status_bytes: length of the status reply: 4, or 2 for old firmware.
        pins: functions of S3, S4, S5, CTRL1 and CTRL2 (command 75); old firmware has the first three only.
        speed_error_limits: largest differences of speed and set point, pulses/s, (2,); 0 is off. An error lasts until
            a restart.
        limit_bytes: length of each limit in commands 109 and 110: 2 or 4; 0 for firmware without them.
        timeout_s: time-out of the serial watchdog; 0 is off.
        watchdog_fired: True after the watchdog has stopped the motors, until the next valid packet.
        bad_packets: number of frames dropped because of their CRC, an unknown command or a gap between bytes.
        packets: number of valid frames.
    """

    def __init__(self, address: int = 0x80, ideal_motors: bool = True) -> None:
        if address not in ADDRESSES:
            raise ValueError(f"address must be in 0x80..0x87 (got 0x{address:02x})")
        self.address = address
        self.ideal_motors = ideal_motors
        self.target_speed_pps: NDArray[np.float64] = np.zeros(2)
        self.setpoint_pps: NDArray[np.float64] = np.zeros(2)
        self.speed_pps: NDArray[np.float64] = np.zeros(2)
        self.encoder: NDArray[np.float64] = np.zeros(2)
        self.acceleration_pps2 = 0.0
        self.closed_loop = True
        self.power: NDArray[np.float64] = np.zeros(2)
        self.currents_a: NDArray[np.float64] = np.zeros(2)
        self.pins = [0, 0, 0, 0, 0]
        self.speed_error_limits = [0, 0]
        self.limit_bytes = 4
        self.battery_v = 24.1
        self.status = 0
        self.status_bytes = 4
        self.timeout_s = 0.0
        self.version = "USB Roboclaw 2x15a v4.2.4"
        self.watchdog_fired = False
        self.bad_packets = 0
        self.packets = 0
        self._received = bytearray()
        self._silent_s = 0.0
        self._since_packet_s = 0.0

    def feed(self, data: bytes) -> bytes:
        """Process bytes from the line and return the controller's replies in order."""
        if data:
            self._silent_s = 0.0
        self._received += data
        sent = bytearray()
        while (reply := self._next_reply()) is not None:
            sent += reply
        return bytes(sent)

    def advance(self, dt_s: float) -> None:
        """Advance the time of the byte gap, the watchdog, the speed ramps and, for ideal motors, the encoders."""
        self._silent_s += dt_s
        if self._received and self._silent_s > INTER_BYTE_GAP_S:
            self._received.clear()
            self.bad_packets += 1
        self._since_packet_s += dt_s
        if self.timeout_s > 0.0 and self._since_packet_s > self.timeout_s and not self.watchdog_fired:
            self.watchdog_fired = True
            self._stop()
        for motor, limit in enumerate(self.speed_error_limits):
            if self.closed_loop and 0 < limit < abs(self.setpoint_pps[motor] - self.speed_pps[motor]):
                self.status |= _SPEED_ERRORS[motor]
        if self._halted:
            self._stop()
        before = self.setpoint_pps.copy()
        step = self.acceleration_pps2 * dt_s if self.acceleration_pps2 > 0.0 else np.inf
        self.setpoint_pps += np.clip(self.target_speed_pps - self.setpoint_pps, -step, step)
        if self.ideal_motors:
            self.speed_pps[:] = self.setpoint_pps
            self.power[:] = self.setpoint_pps / MAX_SPEED_PPS
            self.encoder += 0.5 * (before + self.setpoint_pps) * dt_s

    def press(self, pressed: bool, pin: str = "S3") -> None:
        """Press or release the robot's stop button. On a latching pin, the stop lasts until a restart."""
        bit, mode = ESTOP_BITS[self.status_bytes], self.pins[PINS.index(pin)]
        latching = latches(mode, pin, self.status_bytes)
        if pressed and (latching or mode == (0x01 if self.status_bytes == 4 else 0x02)):
            self.status |= bit
        elif not latching:
            self.status &= ~bit

    def restart(self) -> None:
        """Lose counts, status and settings, as in a brown-out."""
        self.encoder[:] = 0.0
        self.timeout_s, self.status, self.speed_error_limits = 0.0, 0, [0, 0]
        self._stop()

    @property
    def _halted(self) -> bool:
        return bool(self.status and describe_status(self.status, self.status_bytes)[0])

    def _stop(self) -> None:
        self.target_speed_pps[:] = 0.0
        self.setpoint_pps[:] = 0.0
        self.closed_loop = False

    def _next_reply(self) -> bytes | None:
        """Consume one frame and return its reply; None without a complete frame."""
        received = self._received
        if len(received) < 2:
            return None
        address, command = received[0], received[1]
        if address != self.address:
            # A packet for another controller, or noise. Its end is unknown, so the rest is dropped.
            received.clear()
            self.bad_packets += 1
            return None
        if command in WRITE_DATA_BYTES and (command != Command.SET_SPEED_ERROR_LIMITS or self.limit_bytes):
            limits = command == Command.SET_SPEED_ERROR_LIMITS
            size = 2 + (2 * self.limit_bytes if limits else WRITE_DATA_BYTES[command]) + 2
            if len(received) < size:
                return None
            frame = bytes(received[:size])
            if crc16(frame[:-2]) != int.from_bytes(frame[-2:], "big"):
                received.clear()
                self.bad_packets += 1
                return None
            del received[:size]
            self._write(command, frame[2:-2])
            self._understood()
            return ACKNOWLEDGE
        data = self._read(command)
        if data is None:
            received.clear()
            self.bad_packets += 1
            return None
        del received[:2]
        self._understood()
        return encode_reply(address, command, data)

    def _understood(self) -> None:
        self.packets += 1
        self._since_packet_s = 0.0
        self.watchdog_fired = False

    def _write(self, command: int, data: bytes) -> None:
        if command == Command.SET_TIMEOUT:
            self.timeout_s = data[0] * 0.1
        elif command == Command.SPEED_BOTH:
            self._drive(np.array(struct.unpack(">ii", data), float), 0.0)
        elif command == Command.SPEED_ACCELERATION_BOTH:
            acceleration, *speeds = struct.unpack(">Iii", data)
            self._drive(np.array(speeds, float), float(acceleration))
        elif command == Command.DUTY_ACCELERATION_BOTH:
            m1, ramp, m2, _ = struct.unpack(">hIhI", data)
            if self.closed_loop:
                self.setpoint_pps[:] = self.power * MAX_SPEED_PPS
            full_pps2 = MAX_SPEED_PPS / _STEEPEST_S * ramp / _STEEPEST
            self._drive(np.array([m1, m2]) / PWM_MAX * MAX_SPEED_PPS, full_pps2, closed_loop=False)
        elif command == Command.SET_SPEED_ERROR_LIMITS:
            half = self.limit_bytes
            self.speed_error_limits = [int.from_bytes(data[:half], "big"), int.from_bytes(data[half:], "big")]

    def _drive(self, speed_pps: NDArray[np.float64], acceleration_pps2: float, closed_loop: bool = True) -> None:
        if self._halted:
            return
        if closed_loop and not self.closed_loop:
            self.setpoint_pps[:] = self.speed_pps
        self.closed_loop = closed_loop
        self.target_speed_pps[:] = np.clip(speed_pps, -MAX_SPEED_PPS, MAX_SPEED_PPS)
        self.acceleration_pps2 = acceleration_pps2

    def _read(self, command: int) -> bytes | None:
        """Return the data of the reply to a read command; None for an unknown command."""
        if command == Command.READ_TIMEOUT:
            return bytes((round(self.timeout_s * 10),))
        if command == Command.READ_ENCODERS:
            return struct.pack(">II", self._encoder_u32(0), self._encoder_u32(1))
        if command == Command.READ_VERSION:
            return self.version.encode("ascii") + b"\n\0"
        if command == Command.READ_MAIN_BATTERY:
            return struct.pack(">H", round(self.battery_v * 10))
        if command == Command.READ_STATUS:
            return self.status.to_bytes(self.status_bytes, "big")
        if command == Command.READ_PWM:
            return struct.pack(">hh", *(round(float(power) * PWM_MAX) for power in self.power))
        if command == Command.READ_CURRENTS:
            return struct.pack(">hh", *(round(float(current) * 100) for current in self.currents_a))
        if command == Command.READ_PIN_FUNCTIONS:
            return bytes(self.pins)
        if command == Command.READ_SPEED_ERROR_LIMITS and self.limit_bytes:
            return b"".join(limit.to_bytes(self.limit_bytes, "big") for limit in self.speed_error_limits)
        return None

    def _encoder_u32(self, motor: int) -> int:
        return int(np.floor(self.encoder[motor])) & 0xFFFFFFFF
