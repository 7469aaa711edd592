"""Removal of outdated machine code from numba's cache."""

from __future__ import annotations

import contextlib
from pathlib import Path

_SOURCES = ("*kernels.py", "march.py", "volume.py", "vectors.py")


def forget_stale(folder: Path) -> list[Path]:
    """Delete the indices of cached code older than the newest source in a folder, so that numba compiles it again.

    numba compares a function only with its own source file. If a function from another module is inlined and that
    module changes, numba would run the old code, possibly with array shapes that no longer fit.

    Args:
        folder: folder of the sources; numba's files lie in its ``__pycache__``.

    Returns:
        The deleted files.
    """
    newest = max((path.stat().st_mtime for name in _SOURCES for path in folder.glob(name)), default=0.0)
    gone = []
    for index in folder.glob("__pycache__/*.nbi"):
        with contextlib.suppress(OSError):  # another process deleted the file, or only root may write the folder
            if index.stat().st_mtime < newest:
                index.unlink()
                gone.append(index)
    return gone
