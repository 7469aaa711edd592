"""Loading of images and depth from files.

Depth files are 16-bit PNGs in millimetres, or ``.npy`` and ``.npz`` (key ``depth``) in metres.
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instant_ic.util.limits import check_arrays, load_image

DEPTH_SUFFIXES = (".png", ".npy", ".npz")
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp")
_BEYOND_M = 1e4
"""Depth from which a value is unknown, because renderers write inf or 1e10 where a ray hits nothing."""


class DepthFileError(ValueError):
    """A file contains no depth or no image; the message names the file and the reason."""


def load_rgb(path: str | Path) -> NDArray[np.uint8]:
    """Load an image as (H, W, 3) uint8 RGB.

    Raises:
        DepthFileError: the file is missing, or not an image.
    """
    import cv2

    _check_readable(path)
    picture = load_image(path, cv2.IMREAD_COLOR)
    if picture is None:
        raise DepthFileError(f"{path}: not a readable image ({', '.join(s[1:] for s in IMAGE_SUFFIXES)})")
    return np.ascontiguousarray(picture[..., ::-1], np.uint8)


def load_depth(path: str | Path, png_unit_m: float = 1e-3) -> NDArray[np.float32]:
    """Load depth in metres, (H, W) float32. Values that are not finite, negative or above 10 km become 0 (unknown).

    Args:
        path: the file.
        png_unit_m: metres per unit of a PNG (Stanford 2D-3D-S: 1/512, Matterport3D: 1/4000); 65535 is unknown.

    Raises:
        DepthFileError: the file is missing, damaged, of another kind or shape, or has no known depth.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind not in DEPTH_SUFFIXES:
        raise DepthFileError(f"{path}: depth files must be {', '.join(DEPTH_SUFFIXES)} (got {kind or 'no suffix'!r})")
    _check_readable(path)
    values = _png(path, png_unit_m) if kind == ".png" else _numpy(path)
    values = np.squeeze(values) if values.ndim == 3 and 1 in values.shape else values
    if values.ndim != 2 or min(values.shape) < 2:
        raise DepthFileError(f"{path}: depth must be (H, W) (got {values.shape})")
    values = values.astype(np.float32)
    values[~(np.isfinite(values) & (values > 0) & (values < _BEYOND_M))] = 0  # NaN compares false
    if not values.any():
        raise DepthFileError(f"{path}: no known depth; all values are 0, negative or not finite")
    return values


def _check_readable(path: str | Path) -> None:
    try:
        with Path(path).open("rb") as file:
            empty = not file.read(1)
    except OSError as error:
        raise DepthFileError(f"{path}: cannot be read: {error.strerror or error}") from error
    if empty:
        raise DepthFileError(f"{path}: the file is empty")


def _png(path: Path, unit_m: float) -> NDArray[Any]:
    import cv2

    values = load_image(path, cv2.IMREAD_UNCHANGED)
    if values is None:
        raise DepthFileError(f"{path}: not a readable PNG")
    if values.dtype != np.uint16 or values.ndim != 2:
        channels = 1 if values.ndim == 2 else values.shape[2]
        raise DepthFileError(
            f"{path}: a depth PNG must have one channel of 16 bits "
            f"(got {channels} of {8 * values.dtype.itemsize} bits; perhaps a coloured image of depth)"
        )
    return np.where(values < 65535, values * np.float32(unit_m), np.float32(0))


def _numpy(path: Path) -> NDArray[Any]:
    try:
        if path.suffix.lower() == ".npz":
            check_arrays(path)
        loaded = np.load(path, allow_pickle=False)
        if path.suffix.lower() == ".npz":
            with loaded:
                if "depth" not in loaded:
                    raise DepthFileError(f"{path}: no key 'depth' (has: {', '.join(loaded.files) or 'nothing'})")
                loaded = loaded["depth"]
    except DepthFileError:
        raise
    except (OSError, ValueError, EOFError, MemoryError, zipfile.BadZipFile) as error:
        raise DepthFileError(f"{path}: not a readable numpy file: {error}") from error
    if not isinstance(loaded, np.ndarray) or loaded.dtype.kind not in "fiu":
        raise DepthFileError(f"{path}: must be an array of numbers in metres (got {getattr(loaded, 'dtype', 'none')})")
    return loaded
