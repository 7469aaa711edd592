"""Polls the topics of a run directory at low cost."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from instant_ic.bus import registry


class TopicWatch:
    """Topics of a run directory.

    Args:
        run_dir: the run directory.
    """

    def __init__(self, run_dir: Path) -> None:
        self._root = run_dir / "topics"
        self._folders: dict[Path, registry.TopicFolder] = {}

    def topics(self) -> list[registry.TopicInfo]:
        """Return the topics with a live publisher, by name."""
        paths = sorted(self._root.iterdir()) if self._root.is_dir() else []
        self._folders = {path: self._folders.get(path) or registry.TopicFolder(path) for path in paths}
        found = []
        for path, folder in self._folders.items():
            with suppress(OSError):  # just removed: the next call finds out
                folder.look()
            if publishers := folder.publishers:
                topic = "/" + path.name.replace(".", "/")
                found.append(registry.TopicInfo(topic, publishers[0].type_name, publishers))
        return found
