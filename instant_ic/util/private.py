"""Folders and files that only their owner can read, independent of the umask."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from pathlib import Path

log = logging.getLogger(__name__)


def make_folder(path: Path, exist_ok: bool = False) -> None:
    """Create a folder and its missing parents, each with mode 0700. Existing folders keep their mode.

    Raises:
        FileExistsError: the folder exists and ``exist_ok`` is false, or the path is not a folder.
        OSError: the folder cannot be created.
    """
    try:
        path.mkdir(mode=0o700)
    except FileNotFoundError:
        make_folder(path.parent, exist_ok=True)
        path.mkdir(mode=0o700)
    except FileExistsError:
        if not exist_ok or not path.is_dir():
            raise
        return
    _restrict(path, path.lstat().st_mode, 0o700, path.chmod)


def open_file(path: Path, flags: int) -> int:
    """Open a new or existing file and set its mode to 0600. Symbolic links are not followed.

    Returns:
        A descriptor that child processes do not inherit.

    Raises:
        OSError: the file cannot be opened.
    """
    descriptor = os.open(path, flags | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    _restrict(path, os.fstat(descriptor).st_mode, 0o600, lambda mode: os.fchmod(descriptor, mode))
    return descriptor


def sync_folder(path: Path) -> None:
    """Sync the entries of a folder to the disk, so that its new files survive a power failure.

    Raises:
        OSError: the disk failed.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def read_secret(path: Path) -> str:
    """Return the text of a file that only its owner can read, without surrounding white space.

    Raises:
        PermissionError: others may read the file.
        OSError: the file cannot be read.
        UnicodeDecodeError: the file is not UTF-8 text.
    """
    with path.open(encoding="utf-8") as file:
        if os.fstat(file.fileno()).st_mode & 0o077:
            raise PermissionError(f"{path} is readable by others: run `chmod 600 {path}`")
        return file.read().strip()


def _restrict(path: Path, present: int, mode: int, change: Callable[[int], None]) -> None:
    if present & 0o777 == mode:
        return
    try:
        change(mode)
    except OSError as error:  # FAT on a USB stick has no modes, and an unprotected recording is better than none
        log.warning("%s cannot be hidden from other users (mode %04o): %s", path, mode, error.strerror)
