"""Emergency-stop state that survives a restart: a latched emergency stop, and the mark of an interrupted run.

Two files in a folder of each run directory (:func:`state_dir`):

- ``estop.json``: the emergency stop is latched. The arbiter writes it on a press and removes it on a release.
- ``run.json``: a stack is running. The launcher writes it at the start and removes it when every node has ended. If
  it exists at the next start, the last run was interrupted (power cut, killed launcher), and the stack starts stopped.

Both have mode 0600, are replaced atomically, and are synced to disk before the caller continues.
"""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from instant_ic.util import pace, paths
from instant_ic.util.files import replacing
from instant_ic.util.private import sync_folder

RELEASE = "Release the emergency stop to continue."


class EstopStateError(RuntimeError):
    """The emergency stop's state cannot be saved. The message names the file and the remedy."""


@dataclass(frozen=True)
class KeptStop:
    """A latched emergency stop.

    Attributes:
        publisher: node that pressed it; ``launch`` after an interrupted run.
        pressed_ns: publication time of the press, nanoseconds since the epoch; releases before it do not count.
        why: reason for the operator; empty for a plain press.
    """

    publisher: str
    pressed_ns: int
    why: str = ""


def state_dir(run_dir: Path) -> Path:
    """Return the folder of the state files: the run directory, unless that is the default one.

    The default run directory is lost at a power cut or sign-out. Its state files are therefore in a folder below
    ``XDG_STATE_HOME/instant_ic`` (``~/.local/state/instant_ic``).
    """
    default = paths.default_run_dir()
    if run_dir == default or default in run_dir.parents:
        home = Path(os.environ.get("XDG_STATE_HOME") or "~/.local/state").expanduser()
        return home / "instant_ic" / run_dir.relative_to(default)
    return run_dir


def read(run_dir: Path) -> KeptStop | None:
    """Return the latched emergency stop, or None. An unreadable file counts as an emergency stop."""
    file = state_dir(run_dir) / "estop.json"
    try:
        fields = json.loads(file.read_text(encoding="utf-8"))
        return KeptStop(str(fields["publisher"]), int(fields["pressed_ns"]), str(fields["why"]))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        why = f"The emergency stop's last state cannot be read ({file}: {error}). {RELEASE}"
        return KeptStop("arbiter", pace.current().now_ns(), why)


def write(run_dir: Path, stop: KeptStop | None) -> None:
    """Save a press, or clear it if ``stop`` is None.

    Raises:
        EstopStateError: the folder cannot be written.
    """
    _put(state_dir(run_dir) / "estop.json", None if stop is None else asdict(stop))


class RunMark:
    """File in the state folder that exists while a stack runs. If a run leaves it behind, the next one starts stopped.

    Args:
        run_dir: prepared run directory, locked against other stacks.
    """

    def __init__(self, run_dir: Path) -> None:
        self._run_dir = run_dir
        self._file = state_dir(run_dir) / "run.json"

    def __enter__(self) -> Self:
        """Check how the last run ended, and mark this run as started.

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
        """Mark the run as ended cleanly. Every node has ended, so the reason does not matter."""
        _put(self._file, None)


def _put(file: Path, content: dict[str, object] | None) -> None:
    """Replace a file atomically, or remove it for None. The change is on disk when this returns."""
    try:
        if content is None:
            file.unlink(missing_ok=True)
            sync_folder(file.parent)
        else:
            file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            with replacing(file, private=True, sync=True) as stream:
                stream.write(json.dumps(content).encode())
    except OSError as error:
        if content is None and isinstance(error, FileNotFoundError):
            return  # without the folder, there is no file to remove
        raise EstopStateError(
            f"the emergency stop's state cannot be kept: {file}: {error.strerror}. Free the disk, or set "
            "INSTANT_IC_RUN_DIR to a folder that can be written"
        ) from error
