"""Recording, snapshots and bookmarks of the page: commands to a recorder, and its state for the page."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import PurePath
from typing import Any

MOST_PENDING = 20
logger = logging.getLogger("instant_ic.console")


class RecorderError(RuntimeError):
    """The recorder refused or did not answer; the message is for the operator."""


class RecordingDesk:
    """Caller of the recorder on a separate thread, because an answer may take seconds and the page must not wait.

    Any thread may call its methods. Each command ends with a new report.

    Args:
        ask: function that calls a command of the recorder (``record``, ``stop``, ``snapshot`` or ``status``) with named
            arguments and returns the answer; raises RecorderError if the recorder refuses or does not answer.
        report: function that receives the page's ``recording`` message.
    """

    def __init__(self, ask: Callable[..., Any], report: Callable[[dict[str, Any]], None]) -> None:
        self._ask = ask
        self._report = report
        self._thread = ThreadPoolExecutor(1, "recording desk")
        self._places = threading.Semaphore(MOST_PENDING)
        self._poll: Future[None] | None = None
        self._recording = False
        self._notice: dict[str, Any] = {"number": 0, "text": "", "level": "ok"}

    def stop(self) -> None:
        """Stop the thread, and drop pending commands."""
        self._thread.shutdown(cancel_futures=True)

    def record(self, on: bool) -> None:
        """Start or stop a recording."""
        command, text = ("record", "Recording to") if on else ("stop", "Recording saved:")
        self._submit(lambda: f"{text} {_name(self._ask(command)['path'])}")

    def snapshot(self) -> None:
        """Save the last minute."""
        self._submit(lambda: f"Saving the last minute: {_name(self._ask('snapshot', reason='operator')['path'])}")

    def bookmark(self, name: str) -> None:
        """Confirm a published bookmark to the operator."""
        self._submit(lambda: f"Bookmark set: {name}" + ("" if self._recording else " (not recording)"))

    def poll(self) -> None:
        """Report the recorder's state, unless the answer to the last poll is still pending."""
        if self._poll is None or self._poll.done():
            self._poll = self._thread.submit(self._do, None)

    def _submit(self, command: Callable[[], str]) -> None:
        if self._places.acquire(blocking=False):
            self._thread.submit(self._do, command).add_done_callback(lambda _: self._places.release())
        else:
            logger.warning("Recorder command dropped: %d are pending. Wait, then try again.", MOST_PENDING)

    def _do(self, command: Callable[[], str] | None) -> None:
        if command is not None:
            self._notice = {"number": self._notice["number"] + 1} | self._outcome(command)
        self._report(self.status())

    def _outcome(self, command: Callable[[], str]) -> dict[str, str]:
        try:
            return {"text": command(), "level": "ok"}
        except RecorderError as error:
            logger.warning("%s", error)
            return {"text": str(error), "level": "error"}

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
