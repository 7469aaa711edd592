"""A node to look at, in a process of its own, and waiting for what it does."""

import contextlib
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from instant_ic.bus import registry

TALKER = Path(__file__).with_name("cli_talker.py")


def wait_until(condition: Callable[[], Any], what: str, seconds: float = 40.0) -> Any:
    """Waits for a condition and gives its value; fails in words when it does not come."""
    deadline_s = time.monotonic() + seconds
    while not (value := condition()):
        assert time.monotonic() < deadline_s, f"waited {seconds} s for {what}"
        time.sleep(0.02)
    return value


@contextlib.contextmanager
def talking(run_dir: Path, *words: str) -> Iterator[subprocess.Popen[bytes]]:
    """A talker in a process of its own, up and ended by SIGINT."""
    process = subprocess.Popen(
        [sys.executable, str(TALKER), "--run-dir", str(run_dir), *words],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        wait_until(lambda: any(node.subscribes.get("/sleep") for node in registry.list_nodes(run_dir)), "the talker")
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(20)
        finally:
            process.kill()
