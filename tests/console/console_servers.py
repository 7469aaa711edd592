"""Backend, time-outs and tokens that the tests of the server over real sockets share."""

import asyncio
import threading

from instant_ic.console import ConsoleBackend
from instant_ic.console.drive import DriveConfig

WAIT_S = 60.0
DRIVE, WATCH = "drive-token-0123456789", "watch-token-0123456789"


class Patient(DriveConfig):
    """Takes time-outs that no robot may have: where a test does not look at them, a busy machine must not trip them."""

    def __post_init__(self):
        pass


PATIENT = Patient(watchdog_s=30.0, lease_timeout_s=60.0, max_command_age_s=10.0)


class Backend(ConsoleBackend):
    """Keeps what the operators do."""

    def __init__(self):
        self.commands, self.estops, self.looks, self.operator, self.recorder = [], [], [], [], []
        self.released, self.watched = [], []
        self._news = threading.Condition()

    def on_drive(self, linear, angular):
        self._add(self.commands, (linear, angular))

    def on_operator(self, there):
        self._add(self.operator, there)

    def on_estop(self, stop):
        self._add(self.estops, stop)

    def on_look(self, look):
        self._add(self.looks, look)

    def on_released(self, client):
        self._add(self.released, client)

    def on_watched(self, watched):
        self._add(self.watched, watched)

    def on_record(self, on):
        self._add(self.recorder, ("record", on))

    def on_snapshot(self):
        self._add(self.recorder, ("snapshot",))

    def on_bookmark(self):
        self._add(self.recorder, ("bookmark",))

    def _add(self, target, value):
        with self._news:
            target.append(value)
            self._news.notify_all()

    def wait(self, predicate):
        with self._news:
            assert self._news.wait_for(lambda: predicate(self), WAIT_S), (self.commands[-5:], self.estops, self.looks)


def token_file(folder, name, token, mode=0o600):
    path = folder / name
    path.write_text(token + "\n")
    path.chmod(mode)
    return str(path)


async def until(condition):
    """Waits for something on the server's side."""
    while not condition():
        await asyncio.sleep(0.01)
