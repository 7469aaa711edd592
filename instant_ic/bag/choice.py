"""Which topics of a bag or of a stack are meant."""

from __future__ import annotations

import fnmatch
from dataclasses import dataclass


@dataclass(frozen=True)
class TopicChoice:
    """Which topics to take.

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
