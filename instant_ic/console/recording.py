"""Recording, snapshots and bookmarks of the page: commands to a recorder, and its state for the page."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable
from pathlib import PurePath
from typing import Any

_END_S = 5.0
logger = logging.getLogger("instant_ic.console")


class RecorderError(RuntimeError):
    """The recorder refused or did not answer; the text is for the operator."""


class RecordingDesk:
    """Caller of the recorder, with a thread of its own: an answer may take seconds, and the page must not wait.

    Args:
        ask: function that calls a command of the recorder (``record``, ``stop``, ``snapshot`` or ``status``) with named
            arguments and returns the answer; raises RecorderError if there is none or the recorder refuses.
        report: function that takes the page's ``recording`` message, every ``poll_s`` and after each command.
        poll_s: period of the recorder's status, s.
    """

    def __init__(self, ask: Callable[..., Any], report: Callable[[dict[str, Any]], None], poll_s: float = 1.0) -> None:
        self._ask = ask
        self._report = report
        self._poll_s = poll_s
        self._wishes: queue.Queue[Callable[[], str] | None] = queue.Queue(maxsize=20)
        self._recording = False
        self._notice: dict[str, Any] = {"number": 0, "text": "", "level": "ok"}
        self._thread = threading.Thread(target=self._run, name="recording desk", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread; drop pending commands."""
        if self._thread.is_alive():
            self._wish(None)
            self._thread.join(_END_S)

    # ---- any thread ----------------------------------------------------------------------------------

    def record(self, on: bool) -> None:
        """Start or stop a recording."""
        self._wish(self._begin if on else self._end)

    def snapshot(self) -> None:
        """Save the last minute."""
        self._wish(self._snap)

    def bookmark(self, name: str) -> None:
        """Confirm a published bookmark to the operator."""
        self._wish(lambda: f"Bookmark set: {name}" + ("" if self._recording else " (not recording)"))

    def _wish(self, wish: Callable[[], str] | None) -> None:
        try:
            self._wishes.put_nowait(wish)
        except queue.Full:
            logger.warning("Recorder command dropped: %d are pending. Wait, then try again.", self._wishes.maxsize)

    # ---- the desk's thread ---------------------------------------------------------------------------

    def _run(self) -> None:
        due = 0.0
        while True:
            try:
                wish = self._wishes.get(timeout=max(due - time.monotonic(), 0.0))
            except queue.Empty:
                due = time.monotonic() + self._poll_s
                self._report(self.status())
                continue
            if wish is None:
                return
            self._do(wish)
            due = 0.0

    def _do(self, wish: Callable[[], str]) -> None:
        try:
            text, level = wish(), "ok"
        except RecorderError as error:
            text, level = str(error), "error"
            logger.warning("%s", error)
        self._notice = {"number": self._notice["number"] + 1, "text": text, "level": level}

    def _begin(self) -> str:
        return f"Recording to {_name(self._ask('record')['path'])}"

    def _end(self) -> str:
        return f"Recording saved: {_name(self._ask('stop')['path'])}"

    def _snap(self) -> str:
        return f"Saving the last minute: {_name(self._ask('snapshot', reason='operator')['path'])}"

    def status(self) -> dict[str, Any]:
        """Ask the recorder for its state and return the page's ``recording`` message."""
        message: dict[str, Any] = {"notice": self._notice}
        try:
            status = self._ask("status")
        except RecorderError as error:
            self._recording = False
            return message | {"recorder": "missing", "text": str(error), "state": "none"}
        recording = status.get("recording")
        if recording is None:
            text = f"The recorder writes {_name(status.get('path', ''))} continuously. It cannot be started or stopped."
            return message | {"recorder": "missing", "text": text, "state": "none"}
        self._recording = recording.get("state") == "recording"
        return message | {
            "recorder": "ok",
            "text": recording.get("error", "") or status.get("error", ""),
            "state": recording.get("state", "idle"),
            "path": recording.get("path", ""),
            "seconds": recording.get("seconds", 0.0),
            "bytes": recording.get("bytes", 0),
            "free_bytes": recording.get("free_bytes"),
            "cached_s": status.get("cached_s", 0.0),
        }


def _name(path: str) -> str:
    return PurePath(path).name
