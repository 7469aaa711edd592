"""Pairs images with their depth files."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from instant_ic.depth.files import DEPTH_SUFFIXES, PICTURE_SUFFIXES

_NEAREST_MEDIAN_M, _FARTHEST_MEDIAN_M = 0.05, 150.0


class PairError(ValueError):
    """Images and depth files do not match; the message names them."""


def find_pictures(paths: Sequence[Path]) -> list[Path]:
    """Images in files and folders; a folder's images are sorted by name, without those ending in ``_depth``.

    Raises:
        PairError: a path is missing, or a folder holds no image.
    """
    return _found(paths, PICTURE_SUFFIXES, "picture")


def pair(pictures: Sequence[Path], truths: Sequence[Path]) -> list[tuple[Path, Path | None]]:
    """Pair each image with the depth file of the same stem (``room.jpg``, ``room.npy``), or with None.

    A single image and a single depth file are paired whatever their names. A stem may end in ``_rgb`` or ``_depth``.

    Raises:
        PairError: a path is missing, no image has a depth file, or two files match the same image.
    """
    if len(pictures) == len(truths) == 1 and truths[0].is_file():
        return [(pictures[0], truths[0])]
    own = {path.resolve() for path in pictures}
    found = [path for path in _found(truths, DEPTH_SUFFIXES, "depth") if path.resolve() not in own]
    by_stem = _by_stem(found, "depth")
    _by_stem(pictures, "picture")
    pairs = [(picture, by_stem.get(_stem(picture))) for picture in pictures]
    if all(truth is None for _, truth in pairs):
        names = ", ".join(sorted(path.name for path in found)[:5]) or "nothing"
        raise PairError(f"no depth file has the stem of an image ({pictures[0].name}, ... against {names}, ...)")
    return pairs


def unit_warning(depth_m: NDArray[np.floating]) -> str:
    """Warning if a ground-truth depth in metres (0 = unknown) seems to have the wrong unit; otherwise empty."""
    median = float(np.median(depth_m[depth_m > 0]))
    if median < _NEAREST_MEDIAN_M:
        return f"median {median:.4f} m: metres where millimetres belong (a PNG holds millimetres)?"
    if median > _FARTHEST_MEDIAN_M:
        return f"median {median:.0f} m: millimetres where metres belong (only a PNG holds millimetres)?"
    return ""


def _found(paths: Sequence[Path], suffixes: tuple[str, ...], what: str) -> list[Path]:
    found: list[Path] = []
    for path in paths:
        if path.is_dir():
            inside = sorted(file for file in path.iterdir() if file.is_file() and file.suffix.lower() in suffixes)
            if what == "picture":
                inside = [file for file in inside if not file.stem.endswith("_depth")]
            if not inside:
                raise PairError(f"{path}: no {what} in this folder ({', '.join(suffixes)})")
            found += inside
        elif path.is_file():
            found.append(path)
        else:
            raise PairError(f"{path}: no such file or folder")
    return list(dict.fromkeys(found))


def _stem(path: Path) -> str:
    stem = path.stem
    for ending in ("_rgb", "_color", "_depth"):
        stem = stem.removesuffix(ending)
    return stem


def _by_stem(paths: Iterable[Path], what: str) -> dict[str, Path]:
    found: dict[str, Path] = {}
    for path in paths:
        other = found.setdefault(_stem(path), path)
        if other != path:
            raise PairError(f"{other} and {path}: two {what} files with the same stem: pass the files one by one")
    return found
