"""Atomic replacement of files."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from instant_ic.util.private import open_file, sync_folder


@contextmanager
def replacing(path: Path, private: bool = False, sync: bool = False) -> Iterator[BinaryIO]:
    """Open a stream whose content replaces a file at the end of the block.

    The content is written to a temporary file beside it, so readers see either the old file or the new one. If the
    block raises, the old file is kept.

    Args:
        path: file to create or replace, in an existing folder.
        private: let only the owner read the file (mode 0600).
        sync: sync file and folder to the disk, so that a power failure leaves either the old file or the new one.

    Raises:
        OSError: the file cannot be written.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with open(part, "w+b", opener=_open_private if private else None) as stream:
            yield stream
            if sync:
                stream.flush()
                os.fsync(stream.fileno())
        part.replace(path)
    except BaseException:
        with suppress(OSError):
            part.unlink()
        raise
    if sync:
        sync_folder(path.parent)


def _open_private(name: str, flags: int) -> int:
    return open_file(Path(name), flags)
