"""Paths of nodes, launch files, configuration, models and the run directory, in a checkout and in a wheel."""

from __future__ import annotations

import os
from pathlib import Path

_PACKAGE = Path(__file__).resolve().parents[1]


def share_dir(name: str) -> Path:
    """Return the folder ``nodes``, ``launch``, ``config`` or ``models``.

    Raises:
        FileNotFoundError: the installation lacks it.
    """
    for candidate in (_PACKAGE / "share" / name, _PACKAGE.parent / name):
        if candidate.is_dir():
            return candidate
    raise FileNotFoundError(f"{name}/ is missing beside the package at {_PACKAGE}: reinstall instant-ic")


def is_file(path: Path) -> bool:
    """Return whether a file exists. A name that is too long is False, though ``Path.is_file`` would raise."""
    try:
        return path.is_file()
    except OSError:
        return False


def shipped_file(folder: str, name: str) -> Path:
    """Return the path of a file in ``launch``, ``config`` or ``models``. The error lists the folder's files."""
    path = share_dir(folder) / name
    if not is_file(path):
        have = ", ".join(sorted(entry.name for entry in share_dir(folder).iterdir())) or "nothing"
        raise FileNotFoundError(f"{path} does not exist ({folder}/ holds: {have})")
    return path


def node_names() -> list[str]:
    """Return the names of the shipped nodes."""
    return sorted(file.stem for file in share_dir("nodes").glob("[a-z]*.py"))


def node_file(name: str) -> Path:
    """Return the path that a shipped node of this name has, whether or not it exists."""
    return share_dir("nodes") / f"{name}.py"


def run_dir() -> Path:
    """Return the run directory: registry of the bus, logs, simulated devices.

    ``INSTANT_IC_RUN_DIR``, else ``XDG_RUNTIME_DIR/instant_ic``, else ``/tmp/instant_ic-UID``.
    """
    if explicit := os.environ.get("INSTANT_IC_RUN_DIR"):
        return Path(explicit)
    return default_run_dir()


def default_run_dir() -> Path:
    """Return the run directory used when none is set. It does not survive the machine's shutdown."""
    if runtime := os.environ.get("XDG_RUNTIME_DIR"):
        return Path(runtime) / "instant_ic"
    return Path(f"/tmp/instant_ic-{os.getuid()}")


def sign_in_file(run_dir: Path, node: str) -> Path:
    """Return the file for a console's address and token. Unlike the log, only its user can read it."""
    return run_dir / f"{node}.sign_in"


def cache_dir() -> Path:
    """Return the folder for recreatable files: ``XDG_CACHE_HOME/instant_ic``, else ``~/.cache/instant_ic``."""
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "instant_ic"
