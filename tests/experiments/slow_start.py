"""What a pool's process does, with a halt at the stage that ``HALT`` names; there it creates the file ``HALTED``."""

import os
import sys
import time
from pathlib import Path


def _halt(stage: str) -> None:
    if os.environ["HALT"] == stage:
        Path(os.environ["HALTED"]).touch()
        time.sleep(600.0)


def prepare() -> None:
    _halt("prepare")


def drive() -> None:
    _halt("drive")


def begin_a_result() -> None:
    """Sends the head of a result of 1000 bytes and no more."""
    frame = sys._getframe()
    while "result_queue" not in frame.f_locals:
        assert frame.f_back is not None
        frame = frame.f_back
    os.write(frame.f_locals["result_queue"]._writer.fileno(), (1000).to_bytes(4, "big") + b"x")
    _halt("result")


_halt("import")
