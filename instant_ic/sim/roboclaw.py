"""RoboClaw controller on a pseudo-terminal, which the driver opens like a serial port."""

import contextlib
import logging
import os
import select
import threading
import tty
from pathlib import Path

from instant_ic.sim.roboclaw_emulator import RoboclawEmulator

log = logging.getLogger(__name__)


class RoboClawServer:
    """A server of an emulated controller on a pseudo-terminal.

    Args:
        emulator: the controller, whose time the robot simulation advances.
        lock: lock to hold during each access to the emulator.
        link: symbolic link to create to the terminal, replaced if it exists; None creates no link.
    """

    def __init__(self, emulator: RoboclawEmulator, lock: threading.Lock, link: Path | None = None) -> None:
        self._emulator = emulator
        self._lock = lock
        # This process keeps the slave end open, so that the master sees no hang-up when a driver closes it.
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.device = os.ttyname(self._slave)
        self.link = link
        if link is not None:
            link.parent.mkdir(parents=True, exist_ok=True)
            with contextlib.suppress(FileNotFoundError):
                link.unlink()
            link.symlink_to(self.device)
        self._wake_read, self._wake_write = os.pipe()
        self._thread = threading.Thread(target=self._run, name="roboclaw", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread, remove the link and close the terminal."""
        os.write(self._wake_write, b"x")
        self._thread.join(1.0)
        if self.link is not None and self.link.is_symlink() and str(self.link.readlink()) == self.device:
            self.link.unlink()
        for descriptor in (self._master, self._slave, self._wake_read, self._wake_write):
            os.close(descriptor)

    def _run(self) -> None:
        while True:
            ready, _, _ = select.select([self._master, self._wake_read], [], [])
            if self._wake_read in ready:
                return
            data = os.read(self._master, 4096)
            with self._lock:
                reply = self._emulator.feed(data)
            while reply:
                # A driver that sends requests but never reads must not block the simulator.
                _, writable, _ = select.select([], [self._master], [], 0.5)
                if not writable:
                    log.warning("%s: %d bytes of a reply were not read and are dropped", self.device, len(reply))
                    break
                reply = reply[os.write(self._master, reply) :]
