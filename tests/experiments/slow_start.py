"""What a pool's process does, with a halt at the stage that ``HALT`` names; there it creates the file ``HALTED``."""

import os
import time
from pathlib import Path


def _halt(stage: str) -> None:
    if os.environ.get("HALT") == stage:
        Path(os.environ["HALTED"]).touch()
        time.sleep(600.0)


def prepare() -> None:
    _halt("prepare")


def drive() -> None:
    _halt("drive")


def nothing() -> None:
    pass


def behave(how: str) -> str:
    """Hang, die, raise, or return the word."""
    if how == "hang":
        time.sleep(600.0)
    if how == "die":
        os._exit(3)
    if how == "raise":
        raise ValueError("no such thing")
    return how


_halt("import")
