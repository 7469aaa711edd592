"""Keys and a status line for a command that runs until Ctrl-C. Without a terminal it does nothing."""

from __future__ import annotations

import logging
import os
import re
import select
import sys
import termios
import threading
import tty
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any, TextIO

from instant_ic.util.safe_text import direct, visible

ARROWS = {"\x1b[A": "up", "\x1b[B": "down", "\x1b[C": "right", "\x1b[D": "left"}
_KEY = re.compile(r"\x1b\[[0-9;]*[A-Za-z~]|.", re.DOTALL)
_CLEAR_LINE = "\r\x1b[K"
_PERIOD_S = 0.2


@contextmanager
def single_keys() -> Iterator[None]:
    """Read keys without Enter and without echo inside the block; Ctrl-C remains a signal."""
    before = termios.tcgetattr(sys.stdin)
    tty.setcbreak(sys.stdin)
    try:
        yield
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)


class Terminal:
    """Reads keys and updates a status line, in its own thread.

    Args:
        keys: key (a character, or ``up``, ``down``, ``left``, ``right``) → its action.
        line: returns the text of the status line.
    """

    def __init__(self, keys: Mapping[str, Callable[[], Any]], line: Callable[[], str]) -> None:
        self._keys = keys
        self._line = line
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._restore = ExitStack()
        self._lock = threading.Lock()

    def start(self) -> None:
        """Take over the terminal if stdin and stderr are terminals and this process is in the foreground."""
        if not (sys.stdin.isatty() and sys.stderr.isatty()) or not self._in_front():
            return
        self._restore.callback(direct(sys.stderr).write, _CLEAR_LINE)
        self._restore.enter_context(single_keys())
        for handler in logging.getLogger().handlers:
            if isinstance(handler, logging.StreamHandler) and handler.stream is sys.stderr:
                self._restore.callback(handler.setStream, handler.stream)
                handler.setStream(_AboveTheLine(handler.stream, self._lock))
        self._thread = threading.Thread(target=self._run, name="terminal", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join(2.0)
        self._restore.close()

    def _in_front(self) -> bool:
        try:
            return os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp()
        except OSError:  # no controlling terminal
            return False

    def _run(self) -> None:
        while not self._stop.is_set():
            with self._lock:
                width = os.get_terminal_size(sys.stderr.fileno()).columns or 80
                direct(sys.stderr).write(_CLEAR_LINE + visible(self._line())[: max(1, width - 1)])
                sys.stderr.flush()
            # Reading would stop a process in the background.
            if not self._in_front():
                self._stop.wait(_PERIOD_S)
                continue
            ready, _, _ = select.select([sys.stdin], [], [], _PERIOD_S)
            if ready:
                self._on_keys(os.read(sys.stdin.fileno(), 64).decode(errors="replace"))

    def _on_keys(self, text: str) -> None:
        for key in _KEY.findall(text):  # one read can return several keys
            try:
                self._keys.get(ARROWS.get(key, key), lambda: None)()
            except ValueError as error:
                logging.getLogger(__name__).warning("%s", error)


class _AboveTheLine:
    """Stream whose lines replace the status line; the status line is then written again below them."""

    def __init__(self, stream: TextIO, lock: threading.Lock) -> None:
        self._stream = stream
        self._lock = lock

    def write(self, text: str) -> int:
        with self._lock:
            return direct(self._stream).write((_CLEAR_LINE if text.strip() else "") + visible(text))

    def flush(self) -> None:
        self._stream.flush()
