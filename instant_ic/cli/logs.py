"""Log lines of the nodes, from the launcher's files."""

from __future__ import annotations

import os
import re
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from instant_ic.util.safe_text import masked, visible

LEVELS = ("DEBUG", "INFO", "WARNING", "ERROR", "CRITICAL")
_LINE = re.compile(r"(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d\.\d{3}) (DEBUG|INFO|WARNING|ERROR|CRITICAL) +([^\s:]+): (.*)")
_COLOURS = {"DEBUG": "2", "WARNING": "33", "ERROR": "31", "CRITICAL": "1;31"}


@dataclass
class LogLine:
    """One log entry; a traceback belongs to the entry before it.

    Attributes:
        stamp: local date and time, such as ``2026-03-04 12:00:00.250``; empty if unknown.
        level: one of ``LEVELS``.
        text: the message, with the lines of a traceback.
    """

    stamp: str
    level: str
    node: str
    text: str

    def at_least(self, level: str) -> bool:
        """Return whether the entry has the given level or a higher one."""
        return LEVELS.index(self.level) >= LEVELS.index(level)

    def show(self, colour: bool) -> str:
        """Return the entry as text for the terminal."""
        node, text = visible(self.node), visible(masked(self.text))
        if not colour:
            return f"{self.stamp} {self.level:<7} {node}: {text}"
        code = _COLOURS.get(self.level, "")
        start, end = (f"\x1b[{code}m", "\x1b[0m") if code else ("", "")
        return f"\x1b[2m{self.stamp}\x1b[0m {start}{self.level:<7}{end} \x1b[1m{node}\x1b[0m: {start}{text}{end}"


def parse(text: str, node: str) -> list[LogLine]:
    """Return the entries of a node's log file.

    Args:
        text: content of the file.
        node: owner of the file, to whom lines before the first entry (output of a library) are attributed.
    """
    lines: list[LogLine] = []
    for raw in text.splitlines():
        if match := _LINE.match(raw):
            if lines and not lines[0].stamp:
                lines[0].stamp = match[1]  # the latest possible time of the lines before the first entry
            lines.append(LogLine(*match.groups()))
        elif lines:
            lines[-1].text += f"\n{raw}"
        else:
            lines.append(LogLine("", "INFO", node, raw))
    return lines


class GrowingLog:
    """A growing log file, which is replaced by a new one when its node restarts."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._inode = -1
        self._offset = 0
        self._partial = b""

    def new_lines(self) -> list[LogLine]:
        """Return the entries written since the last call; the first call returns all of them."""
        try:
            with self._path.open("rb") as file:
                status = os.fstat(file.fileno())
                if status.st_ino != self._inode or status.st_size < self._offset:
                    self._inode, self._offset, self._partial = status.st_ino, 0, b""
                file.seek(self._offset)
                data = file.read()
        except FileNotFoundError:
            return []
        self._offset += len(data)
        # An incomplete last line is kept until the rest of it arrives.
        whole, separator, rest = (self._partial + data).rpartition(b"\n")
        self._partial = rest
        return parse((whole + separator).decode(errors="replace"), self._path.stem)


class LogFolder:
    """All log files of a run directory.

    Args:
        folder: ``RUN_DIR/log``.
        nodes: nodes whose files are read; empty: all nodes.
    """

    def __init__(self, folder: Path, nodes: Collection[str] = ()) -> None:
        self._folder = folder
        self._nodes = set(nodes)
        self._files: dict[Path, GrowingLog] = {}

    def new_lines(self) -> list[LogLine]:
        """Return the entries of all files written since the last call, sorted by time."""
        for path in sorted(self._folder.glob("*.log")):
            if not self._nodes or path.stem in self._nodes:
                self._files.setdefault(path, GrowingLog(path))
        lines = [line for file in self._files.values() for line in file.new_lines()]
        return sorted(lines, key=lambda line: line.stamp)
