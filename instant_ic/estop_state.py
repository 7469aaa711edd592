"""What the emergency stop must remember from one run to the next: a stop that nobody released, a run that broke off.

Two files in a folder of each run directory (:func:`state_dir`):

- ``estop.json``: the emergency stop is pressed. The arbiter writes it at a press and removes it at a release.
- ``run.json``: a stack runs. The launcher writes it at the start and removes it when every node has ended. Where it
  stands at the next start, that run broke off (power cut, killed launcher), and the stack starts stopped.

Both are replaced in one step and reach the disk before the caller goes on, mode 0600.
"""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from instant_ic import pace, paths

RELEASE = "Release the emergency stop to continue."


class EstopStateError(RuntimeError):
    """The state of the emergency stop cannot be kept; says where and what to do."""


@dataclass(frozen=True)
class KeptStop:
    """An emergency stop that nobody released.

    Attributes:
        publisher: node that pressed it; ``launch`` after a run that broke off.
        pressed_ns: publication time of the press, nanoseconds since the epoch; older releases do not count.
        why: text for the operator; empty for a plain press.
    """

    publisher: str
    pressed_ns: int
    why: str = ""


def state_dir(run_dir: Path) -> Path:
    """Folder of the files: the run directory, unless that is the default one, which a power cut or sign-out empties.

    Then it is the place below ``XDG_STATE_HOME/instant_ic`` (``~/.local/state/instant_ic``).
    """
    default = paths.default_run_dir()
    if run_dir == default or default in run_dir.parents:
        home = Path(os.environ.get("XDG_STATE_HOME") or "~/.local/state").expanduser()
        return home / "instant_ic" / run_dir.relative_to(default)
    return run_dir


def read(run_dir: Path) -> KeptStop | None:
    """The stop that nobody released; None where there is none. A file that cannot be read counts as one."""
    file = state_dir(run_dir) / "estop.json"
    try:
        fields = json.loads(file.read_text(encoding="utf-8"))
        return KeptStop(str(fields["publisher"]), int(fields["pressed_ns"]), str(fields["why"]))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError) as error:
        why = f"The emergency stop's last state cannot be read ({file}: {error}). {RELEASE}"
        return KeptStop("arbiter", pace.current().now_ns(), why)


def write(run_dir: Path, stop: KeptStop | None) -> None:
    """Keeps a press, or forgets it (None).

    Raises:
        EstopStateError: the folder cannot be written.
    """
    _put(state_dir(run_dir) / "estop.json", None if stop is None else asdict(stop))


class RunMark:
    """Stands in the state folder for as long as a stack runs; one that was left there stops the next stack.

    Args:
        run_dir: prepared run directory, locked against other stacks.
    """

    def __init__(self, run_dir: Path) -> None:
        self._run_dir = run_dir
        self._file = state_dir(run_dir) / "run.json"

    def __enter__(self) -> Self:
        """Sees how the last run ended, and begins this one.

        Raises:
            EstopStateError: the folder cannot be written.
        """
        if os.path.lexists(self._file):
            while_pressed = " while the emergency stop was pressed" if read(self._run_dir) is not None else ""
            why = f"The last run did not end cleanly{while_pressed}. {RELEASE}"
            write(self._run_dir, KeptStop("launch", pace.current().now_ns(), why))
        _put(self._file, {"pid": os.getpid()})
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Every node has ended, for whatever reason: this run ended cleanly."""
        _put(self._file, None)


def _put(file: Path, content: dict[str, object] | None) -> None:
    """Replaces a file in one step, or removes it; it is so on the disk, too, when this returns."""
    part = file.with_suffix(".part")
    try:
        if content is None:
            file.unlink(missing_ok=True)
        else:
            file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            part.unlink(missing_ok=True)
            descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
            with os.fdopen(descriptor, "w", encoding="utf-8") as stream:
                json.dump(content, stream)
                stream.flush()
                os.fsync(stream.fileno())
            part.replace(file)
        folder = os.open(file.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except OSError as error:
        if content is None and isinstance(error, FileNotFoundError):
            return  # there is no folder, so there is no file
        raise EstopStateError(
            f"the emergency stop's state cannot be kept: {file}: {error.strerror}. Free the disk, or set "
            "INSTANT_IC_RUN_DIR to a folder that can be written"
        ) from error
