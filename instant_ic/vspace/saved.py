"""Storage of a trained virtual space in one ``.npz`` file: configuration, keyframes, field and training progress."""

from __future__ import annotations

import dataclasses
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from instant_ic.util.files import replacing
from instant_ic.util.limits import check_arrays
from instant_ic.vspace.config import VirtualSpaceConfig
from instant_ic.vspace.nerf.field import FieldParameters, Floats, Lattice
from instant_ic.vspace.prior import PanoramaPrior

FORMAT = "instant_ic virtual space, version 6"
FILE_NAME = "space.npz"
"""Name of the file in a folder."""
Arrays = dict[str, NDArray[Any]]


class SpaceFileError(ValueError):
    """A file contains no usable space; the message names the file and the reason."""


@dataclass(frozen=True)
class TrainingProgress:
    """Progress of training, in the state variables of ``VirtualSpace``."""

    psnr_db: float
    iteration: int
    refresh: bool
    ready_iterations: int
    train_seconds: float
    ready: bool
    shows_field: bool


@dataclass(frozen=True)
class SavedSpace:
    """Content of a file.

    Attributes:
        config: parameters of the space.
        priors: the keyframes, newest first.
        gains: factors that bring each keyframe's colours to the newest's exposure, (K, 3).
        lattice: lattice of the field.
        parameters: the trained field.
        progress: progress of training.
    """

    config: VirtualSpaceConfig
    priors: tuple[PanoramaPrior, ...]
    gains: Floats
    lattice: Lattice
    parameters: FieldParameters
    progress: TrainingProgress


def space_file(path: str | Path) -> Path:
    """Return the file of a space for a path to the file or to its folder."""
    path = Path(path)
    return path if path.suffix == ".npz" and not path.is_dir() else path / FILE_NAME


def write(path: str | Path, saved: SavedSpace) -> Path:
    """Write a space, creating folders, and return its file. An older file is replaced only by a complete one.

    Args:
        path: the file, or its folder.
        saved: content of the file.

    Raises:
        OSError: the file cannot be written.
    """
    file, arrays = space_file(path), {"format": np.asarray(FORMAT)}
    _flatten("", saved, arrays)
    file.parent.mkdir(parents=True, exist_ok=True)
    with replacing(file, sync=True) as stream:
        np.savez(stream, allow_pickle=False, **arrays)
    return file


def read(path: str | Path) -> SavedSpace:
    """Read a file written by ``write``.

    Args:
        path: the file, or its folder.

    Raises:
        SpaceFileError: the file is missing, damaged, not a space, or of another version.
    """
    file = space_file(path)
    try:
        if zipfile.is_zipfile(file):
            check_arrays(file)
        with np.load(file, allow_pickle=False) as loaded:
            arrays = {name: loaded[name] for name in loaded.files}
    except FileNotFoundError as error:
        raise SpaceFileError(f"{file}: no such file. Make one with: ic vspace train") from error
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, AttributeError, NotImplementedError) as error:
        raise SpaceFileError(f"{file}: damaged, or not a saved virtual space: {error}") from error
    if (found := str(arrays.get("format", "not a saved virtual space"))) != FORMAT:
        raise SpaceFileError(f"{file}: {found}; this program reads {FORMAT}. Train it again with: ic vspace train")
    try:
        saved: SavedSpace = _built("", SavedSpace, arrays)
    except (KeyError, TypeError, ValueError) as error:
        raise SpaceFileError(f"{file}: damaged: {error}. Train it again with: ic vspace train") from error
    if not saved.priors:
        raise SpaceFileError(f"{file}: holds no keyframe. Train it again with: ic vspace train")
    return saved


def _flatten(name: str, value: Any, arrays: Arrays) -> None:
    """Store a value in ``arrays`` under dotted names; dataclasses and tuples of them are stored field by field."""
    if dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            _flatten(f"{name}.{field.name}", getattr(value, field.name), arrays)
    elif isinstance(value, tuple) and value and dataclasses.is_dataclass(value[0]):
        for number, one in enumerate(value):
            _flatten(f"{name}.{number}", one, arrays)
    else:
        arrays[name] = np.asarray(value)


def _built(name: str, kind: Any, arrays: Arrays) -> Any:
    """Build a value of type ``kind`` from the arrays of ``_flatten``."""
    if dataclasses.is_dataclass(kind):
        hints = get_type_hints(kind)
        return kind(**{field.name: _built(f"{name}.{field.name}", hints[field.name], arrays)
                       for field in dataclasses.fields(kind)})  # type: ignore[operator]  # fmt: skip
    if get_origin(kind) is tuple and dataclasses.is_dataclass(one := get_args(kind)[0]):
        numbers = {int(key.removeprefix(f"{name}.").partition(".")[0]) for key in arrays if key.startswith(f"{name}.")}
        return tuple(_built(f"{name}.{number}", one, arrays) for number in sorted(numbers))
    value = arrays[name]
    if get_origin(kind) is tuple:
        return tuple(value.tolist())
    return value.item() if value.ndim == 0 else value
