"""Selection of topics by name or pattern."""

from __future__ import annotations

import fnmatch
from dataclasses import dataclass


@dataclass(frozen=True)
class TopicChoice:
    """Topics to take from a bag or a stack.

    Attributes:
        topics: names or patterns (``/camera/*``); empty takes all.
        exclude: names or patterns to leave out.
    """

    topics: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()

    def takes(self, topic: str) -> bool:
        if any(fnmatch.fnmatchcase(topic, pattern) for pattern in self.exclude):
            return False
        return not self.topics or any(fnmatch.fnmatchcase(topic, pattern) for pattern in self.topics)
