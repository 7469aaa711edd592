"""In-memory serial ports for the tests of the base."""

from collections.abc import Callable

from instant_ic.base.config import RoboclawConfig
from instant_ic.sim.roboclaw_emulator import RoboclawEmulator


class EmulatorPort:
    """A serial port with an emulated controller at its other end; ``damage`` may change each reply."""

    def __init__(self, emulator: RoboclawEmulator, damage: Callable[[bytes], bytes] | None = None) -> None:
        self.emulator = emulator
        self.damage = damage
        self.received = bytearray()
        self.written: list[bytes] = []
        self.unplugged = False
        self.closed = False

    def write(self, data: bytes, /) -> int:
        self._check()
        self.written.append(bytes(data))
        reply = self.emulator.feed(bytes(data))
        self.received += self.damage(reply) if self.damage else reply
        return len(data)

    def read(self, size: int = 1, /) -> bytes:
        self._check()
        taken = bytes(self.received[:size])
        del self.received[:size]
        return taken

    def reset_input_buffer(self) -> None:
        self._check()
        self.received.clear()
        # A driver waits longer than the byte gap before it repeats.
        self.emulator.advance(0.0)

    def close(self) -> None:
        self.closed = True

    def _check(self) -> None:
        if self.unplugged:
            raise OSError(5, "Input/output error")


def opener(port: EmulatorPort) -> Callable[[RoboclawConfig], EmulatorPort]:
    def open_port(config: RoboclawConfig) -> EmulatorPort:
        if port.unplugged:
            from instant_ic.base.roboclaw import LinkError

            raise LinkError(f"{config.port}: cannot be opened (unplugged)")
        port.closed = False
        return port

    return open_port
