"""What is stored of a participant: a folder with a JSON file and a bag a drive. No name, no address."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from instant_ic.experiments.results import finite
from instant_ic.experiments.study.plan import Study, StudyError, save
from instant_ic.util.private import make_folder, open_file

OPEN, DONE, WITHDRAWN = "open", "done", "withdrawn"


class Record:
    """Answers and results of one participant, written after each step.

    Attributes:
        state: of OPEN, DONE, WITHDRAWN.
        simulated: the participant is a program.
        steps: result of each finished step.
    """

    def __init__(self, study: Study, code: str) -> None:
        if code not in study.participants:
            known = ", ".join(list(study.participants)[:8])
            raise StudyError(f"{study.folder} has no participant {code!r}; its study.yaml has {known}, ...")
        self.study, self.code = study, code
        self.folder = study.folder / "participants" / code
        self.path = self.folder / "answers.json"
        self.state, self.simulated = OPEN, False
        self.steps: dict[str, dict[str, Any]] = {}
        if self.path.exists():
            self._read()

    def _read(self) -> None:
        try:
            kept = json.loads(self.path.read_text(encoding="utf-8"))
            self.state, self.simulated = str(kept["state"]), bool(kept["simulated"])
            self.steps = {str(name): dict(result) for name, result in kept["steps"].items()}
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise StudyError(
                f"{self.path} is damaged ({error}): restore it, or delete the participant with "
                f"`ic study delete {self.study.folder} {self.code}`"
            ) from None

    @property
    def step(self) -> str | None:
        """First step that is not finished; None after the last."""
        return next((name for name in self.study.steps() if name not in self.steps), None)

    def finish(self, step: str, result: dict[str, Any]) -> None:
        """Store the result of a step."""
        self.steps[step] = finite(result)
        if self.step is None:
            self.state = DONE
        self.save()

    def save(self) -> None:
        make_folder(self.folder, exist_ok=True)
        kept = {"code": self.code, "state": self.state, "simulated": self.simulated, "steps": self.steps}
        save(self.path, json.dumps(kept, indent=1, ensure_ascii=False) + "\n")

    def delete(self) -> None:
        """Delete everything of this participant."""
        self.delete_folder(self.folder)
        self.state, self.simulated, self.steps = OPEN, False, {}

    @staticmethod
    def delete_folder(folder: Path) -> None:
        """Delete a participant's folder, also one that cannot be read."""
        if folder.exists():
            shutil.rmtree(folder)

    def bag(self, step: str) -> Path:
        """A new folder for the bag of a drive; an interrupted drive keeps its own."""
        make_folder(self.folder, exist_ok=True)
        attempt = 1
        while (found := self.folder / (step if attempt == 1 else f"{step}-attempt{attempt}")).exists():
            attempt += 1
        return found


@contextlib.contextmanager
def only_one(study: Study, what: str) -> Iterator[None]:
    """Hold the lock of a study: one participant at a time.

    Raises:
        StudyError: another ``ic study`` has it.
    """
    descriptor = open_file(study.folder / ".lock", os.O_RDWR | os.O_CREAT)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise StudyError(f"{study.folder}: another `ic study` is running; end it before you {what}") from None
        yield
    finally:
        os.close(descriptor)
