"""Disk cache of expensive deterministic arrays (textures, baked light)."""

from __future__ import annotations

import hashlib
import os
import zipfile
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from instant_ic.util import paths
from instant_ic.util.files import replacing

Arrays = dict[str, npt.NDArray[np.generic]]

MOST_BYTES = 256 << 20
"""Size limit of the cache. Above it, the least recently used files are deleted."""


def kept(kind: str, parts: Iterable[str | npt.NDArray[np.generic]], make: Callable[[], Arrays]) -> Arrays:
    """Return the arrays of ``make``, from disk if they are in the cache.

    Args:
        kind: kind of the arrays; part of the file name.
        parts: all inputs on which the arrays depend; a hash of this package's code is added.
        make: function that computes the arrays.

    Returns:
        Arrays by name, bit-identical to those of ``make``; computed again if a folder or file is unusable.
    """
    digest = hashlib.sha256(_code())
    for part in parts:
        if isinstance(part, str):
            digest.update(f"{len(part)} {part}".encode())
        else:
            digest.update(f"{part.dtype} {part.shape}".encode() + np.ascontiguousarray(part).tobytes())
    file = paths.cache_dir() / "sim" / f"{kind}-{digest.hexdigest()[:32]}.npz"
    try:
        with np.load(file, allow_pickle=False) as found:
            arrays = {name: found[name] for name in found.files}
        os.utime(file)
        return arrays
    except (OSError, ValueError, EOFError, zipfile.BadZipFile):
        pass
    arrays = make()
    with suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        with replacing(file) as out:
            np.savez(out, allow_pickle=False, **arrays)
        _make_room(file.parent)
    return arrays


@cache
def _code() -> bytes:
    """Return a hash of this package's code and the numpy version."""
    files = sorted(Path(__file__).parent.glob("*.py"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files) + np.__version__.encode()).digest()


def _make_room(folder: Path) -> None:
    files = []
    for file in folder.iterdir():
        with suppress(FileNotFoundError):  # another process may have deleted the file
            status = file.stat()
            files.append((status.st_mtime, status.st_size, file))
    total = sum(size for _, size, _ in files)
    for _, size, file in sorted(files):
        if total <= MOST_BYTES:
            return
        file.unlink(missing_ok=True)
        total -= size
