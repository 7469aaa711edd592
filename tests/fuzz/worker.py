"""What a process of the whole run does."""

import os
import resource
from collections.abc import Callable
from pathlib import Path

from tests.fuzz.harness import Finding, run
from tests.fuzz.targets import TARGETS

_MEMORY_BYTES = 6 << 30
"""Address space of a worker: a parser that wants more fails there, not the machine."""
_parsers: dict[str, Callable[[bytes], object]] = {}


def run_chunk(name: str, seed: int, start: int, count: int) -> list[Finding]:
    """Parse some inputs of a target, whose parser is made once a process."""
    if name not in _parsers:
        _parsers[name] = TARGETS[name].make()
        resource.setrlimit(resource.RLIMIT_AS, (_MEMORY_BYTES, _MEMORY_BYTES))
        # libjpeg, libpng and OpenCV write a line for each damaged image.
        with Path(os.devnull).open("wb") as nothing:
            os.dup2(nothing.fileno(), 2)
    return run(TARGETS[name], _parsers[name], seed, start, count)
