"""Backend, time-outs and tokens that the tests of the server over real sockets share."""

import asyncio

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
        self.on_estop, self.on_look, self.on_operator = self.estops.append, self.looks.append, self.operator.append
        self.on_released, self.on_watched = self.released.append, self.watched.append

    def on_drive(self, linear, angular):
        self.commands.append((linear, angular))

    def on_recorder(self, command, on):
        self.recorder.append((command, on))

    async def wait(self, predicate):
        await until(lambda: predicate(self))


def token_file(folder, name, token, mode=0o600):
    path = folder / name
    path.write_text(token + "\n")
    path.chmod(mode)
    return str(path)


async def until(condition):
    """Waits for something on the server's side."""
    while not condition():
        await asyncio.sleep(0.01)
