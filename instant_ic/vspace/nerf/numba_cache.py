"""Removal of numba's cached machine code that is out of date."""

from __future__ import annotations

import contextlib
from pathlib import Path

_SOURCES = ("*kernels.py", "march.py", "volume.py", "vectors.py")


def forget_stale(folder: Path) -> list[Path]:
    """Delete the indices of code that is older than any of a folder's kernels; numba then compiles again.

    numba compares a function with its own file alone. A function that has another module's inlined would run old code
    after a change there, with array shapes that the new code no longer has.

    Args:
        folder: folder of the sources; numba's files lie in its ``__pycache__``.

    Returns:
        What was deleted.
    """
    newest = max((path.stat().st_mtime for name in _SOURCES for path in folder.glob(name)), default=0.0)
    gone = []
    for index in folder.glob("__pycache__/*.nbi"):
        with contextlib.suppress(OSError):  # another process was first, or a folder that only root may write
            if index.stat().st_mtime < newest:
                index.unlink()
                gone.append(index)
    return gone
