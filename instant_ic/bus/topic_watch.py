"""Polls the topics of a run directory at low cost."""

from __future__ import annotations

import os
import time
from pathlib import Path

from instant_ic.bus import registry

# The leftovers of a killed process change no folder. Every second its process is looked for, now and then its lock.
_LOOK_S = 1.0
_FULL_LOOK_S = 5.0


class TopicWatch:
    """Topics of a run directory, read again when one of their folders changes or a publisher's process has ended.

    Args:
        run_dir: the run directory.
    """

    def __init__(self, run_dir: Path) -> None:
        self._run_dir = run_dir
        self._seen: list[tuple[str, int]] = []
        self._next_look_s = 0.0
        self._next_full_look_s = 0.0
        self._topics: list[registry.TopicInfo] = []

    def topics(self) -> list[registry.TopicInfo]:
        """Return the topics with a live publisher, by name."""
        now = time.monotonic()
        try:
            with os.scandir(self._run_dir / "topics") as folders:
                seen = sorted((folder.name, folder.stat().st_mtime_ns) for folder in folders)
        except OSError:  # one was just removed, or there is no publisher yet: the next call finds out
            seen = []
        full = seen != self._seen or now >= self._next_full_look_s
        if not full and now >= self._next_look_s:
            self._next_look_s = now + _LOOK_S
            full = not all(registry.running(one) for topic in self._topics for one in topic.publishers)
        if full:
            trusted = all(registry.settled(mtime_ns) for _, mtime_ns in seen)
            self._seen = seen if trusted else []
            self._next_look_s, self._next_full_look_s = now + _LOOK_S, now + _FULL_LOOK_S
            self._topics = registry.list_topics(self._run_dir)
        return self._topics
