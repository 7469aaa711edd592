"""RoboClaw packet serial: frames and their CRC.

Source: Basicmicro, RoboClaw User Manual, chapter "Packet Serial".
"""

import binascii
import struct
from enum import IntEnum

BAUD_RATES = (2400, 9600, 19200, 38400, 57600, 115200, 230400, 460800)
ADDRESSES = range(0x80, 0x88)
ACKNOWLEDGE = b"\xff"
INTER_BYTE_GAP_S = 0.010
"""Longest gap between two bytes of a packet. The controller drops a packet with a longer gap."""


class Command(IntEnum):
    """Commands that this package uses; each value is the number in the manual."""

    SET_TIMEOUT = 14
    READ_TIMEOUT = 15
    READ_VERSION = 21
    READ_MAIN_BATTERY = 24
    SPEED_BOTH = 37
    SPEED_ACCELERATION_BOTH = 40
    READ_PWM = 48
    READ_CURRENTS = 49
    DUTY_ACCELERATION_BOTH = 54
    READ_PIN_FUNCTIONS = 75
    READ_ENCODERS = 78
    READ_STATUS = 90
    SET_SPEED_ERROR_LIMITS = 109
    READ_SPEED_ERROR_LIMITS = 110


WRITE_DATA_BYTES: dict[int, int] = {
    Command.SET_TIMEOUT: 1,
    Command.SPEED_BOTH: 8,
    Command.SPEED_ACCELERATION_BOTH: 12,
    Command.DUTY_ACCELERATION_BOTH: 12,
    Command.SET_SPEED_ERROR_LIMITS: 8,
}
"""Write commands (acknowledged with 0xFF) and the number of data bytes in each."""
CYCLE_BYTES = 64
"""Bytes of a control cycle that reads the health: commands 40, 78, 48, 49, 90, 15 and 24 with their replies."""

PINS = ("S3", "S4", "S5")
MOTORS_OFF = struct.pack(">hIhI", 0, 655359, 0, 655359)
"""Data of command 54: no power on either motor, with the steepest ramp (full power to none in 50 ms)."""
PWM_MAX = 32767

STATUS_FAULTS: dict[int, str] = {
    0x0001: "emergency stop",
    0x0002: "temperature error",
    0x0004: "temperature 2 error",
    0x0008: "main voltage high",
    0x0010: "logic voltage high",
    0x0020: "logic voltage low",
    0x0040: "driver fault M1",
    0x0080: "driver fault M2",
    0x0100: "speed error M1",
    0x0200: "speed error M2",
    0x0400: "position error M1",
    0x0800: "position error M2",
    0x1000: "over-current M1",
    0x2000: "over-current M2",
    0x4000: "main voltage low",
    0x8000: "main voltage high (not recovered)",
}
"""Error bits of the 4-byte status (command 90)."""
STATUS_WARNING_MASK = 0xFFFF0000

STATUS_FAULTS_2_BYTES: dict[int, str] = {
    0x0001: "over-current warning M1",
    0x0002: "over-current warning M2",
    0x0004: "emergency stop",
    0x0008: "temperature error",
    0x0010: "temperature 2 error",
    0x0020: "main voltage high",
    0x0040: "logic voltage high",
    0x0080: "logic voltage low",
    0x0100: "driver fault M1",
    0x0200: "driver fault M2",
    0x0400: "main voltage high warning",
    0x0800: "main voltage low warning",
    0x1000: "temperature warning",
    0x2000: "temperature 2 warning",
}
"""Bits of the 2-byte status of older firmware."""
_WARNINGS_2_BYTES = 0x0001 | 0x0002 | 0x3C00


class ProtocolError(Exception):
    """A missing, truncated or damaged reply; the text names the command and the received bytes."""


def crc16(data: bytes) -> int:
    """Compute the CRC-16/XMODEM: polynomial 0x1021, initial 0, most significant bit first."""
    return binascii.crc_hqx(data, 0)


def write_frame(address: int, command: int, data: bytes = b"") -> bytes:
    """Return the frame of a write command: address, command, data, CRC."""
    body = bytes((address, command)) + data
    return body + struct.pack(">H", crc16(body))


def read_request(address: int, command: int) -> bytes:
    """Return the frame of a read command, which has no CRC."""
    return bytes((address, command))


def encode_reply(address: int, command: int, data: bytes) -> bytes:
    """Return the reply of the controller to a read command: data, then the CRC over address, command and data."""
    return data + struct.pack(">H", crc16(bytes((address, command)) + data))


def decode_reply(address: int, command: int, reply: bytes) -> bytes:
    """Return the data of a reply.

    Raises:
        ProtocolError: the CRC does not match.
    """
    if len(reply) < 2:
        raise ProtocolError(f"command {command}: reply of {len(reply)} bytes has no CRC")
    data, received = reply[:-2], int.from_bytes(reply[-2:], "big")
    expected = crc16(bytes((address, command)) + data)
    if received != expected:
        raise ProtocolError(f"command {command}: CRC 0x{received:04x} instead of 0x{expected:04x} ({reply.hex(' ')})")
    return data


ESTOP_BITS = {4: 0x0001, 2: 0x0004}
"""Emergency stop bit of a status, by the status's length in bytes."""


def describe_status(status: int, status_bytes: int) -> tuple[list[str], list[str]]:
    """Return the fault texts and the warning texts of a status of 2 or 4 bytes (command 90).

    During a fault, the motors do not run or do not run reliably.
    """
    if status_bytes == 2:
        named = [(bit, text) for bit, text in STATUS_FAULTS_2_BYTES.items() if status & bit]
        return (
            [text for bit, text in named if not bit & _WARNINGS_2_BYTES],
            [text for bit, text in named if bit & _WARNINGS_2_BYTES],
        )
    faults = [text for bit, text in STATUS_FAULTS.items() if status & bit]
    warning = status & STATUS_WARNING_MASK
    return faults, [f"warning bits 0x{warning:08x}"] if warning else []


def latches(mode: int, pin: str, status_bytes: int) -> bool:
    """Return whether a pin's mode (command 75) is a latching emergency stop.

    In packet serial mode, S3 is a latching stop by default. Firmware with a short status numbers the modes differently.
    """
    return mode == (0x81 if status_bytes == 4 else 0x01) or (mode == 0 and pin == "S3")
