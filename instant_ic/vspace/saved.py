"""A trained virtual space as one ``.npz`` file: configuration, keyframes, the field's parameters, and its progress."""

from __future__ import annotations

import dataclasses
import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
from numpy.typing import NDArray

from instant_ic.util.files import replacing
from instant_ic.util.limits import check_arrays
from instant_ic.vspace.config import VirtualSpaceConfig
from instant_ic.vspace.nerf.field import FieldParameters, Floats, Lattice
from instant_ic.vspace.prior import PanoramaPrior

FORMAT, VERSION = "instant_ic virtual space", 5
FILE_NAME = "space.npz"
"""Name of the file in a folder."""


class SpaceFileError(ValueError):
    """A file holds no usable space; the message names the file and the reason."""


@dataclass(frozen=True)
class TrainingProgress:
    """Progress of training, with ``VirtualSpace``'s own fields."""

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
        gains: factors that bring their colours to the newest's exposure, (K, 3).
        lattice: lattice of the field.
        parameters: the trained field.
        progress: progress of its training.
    """

    config: VirtualSpaceConfig
    priors: tuple[PanoramaPrior, ...]
    gains: Floats
    lattice: Lattice
    parameters: FieldParameters
    progress: TrainingProgress


def space_file(path: str | Path) -> Path:
    """Return the file of a space, which ``path`` names directly or by its folder."""
    path = Path(path)
    return path if path.suffix == ".npz" and not path.is_dir() else path / FILE_NAME


def write(path: str | Path, saved: SavedSpace) -> Path:
    """Write a space, creating folders, and return its file. An older file is replaced only by a complete one.

    Args:
        path: the file, or its folder.
        saved: content of the file.

    Raises:
        OSError: it cannot be written.
    """
    file = space_file(path)
    head = {
        "format": FORMAT,
        "version": VERSION,
        "config": dataclasses.asdict(saved.config),
        "keyframes": len(saved.priors),
        "progress": dataclasses.asdict(saved.progress),
    }
    arrays: dict[str, NDArray[Any]] = {"head": np.frombuffer(json.dumps(head).encode(), np.uint8), "gains": saved.gains}
    groups: dict[str, Any] = {f"prior.{number}": prior for number, prior in enumerate(saved.priors)}
    for group, part in (groups | {"lattice": saved.lattice, "parameters": saved.parameters}).items():
        for field in dataclasses.fields(part):
            arrays[f"{group}.{field.name}"] = np.asarray(getattr(part, field.name))
    file.parent.mkdir(parents=True, exist_ok=True)
    with replacing(file, sync=True) as stream:
        np.savez(stream, allow_pickle=False, **arrays)
    return file


def read(path: str | Path) -> SavedSpace:
    """Read a file that ``write`` has made.

    Args:
        path: the file, or its folder.

    Raises:
        SpaceFileError: missing, damaged, foreign, or of another version.
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
    try:
        head = json.loads(arrays["head"].tobytes())
        if (head["format"], head["version"]) != (FORMAT, VERSION):
            found = f"{head['format']!r}, version {head['version']}; this program reads version {VERSION}"
            raise SpaceFileError(f"{file}: {found}. Train it again with: ic vspace train")
        priors = tuple(_group(PanoramaPrior, f"prior.{number}", arrays) for number in range(head["keyframes"]))
        if not priors:
            raise SpaceFileError(f"{file}: holds no keyframe. Train it again with: ic vspace train")
        return SavedSpace(
            _built(VirtualSpaceConfig, head["config"]),
            priors,
            arrays["gains"],
            _group(Lattice, "lattice", arrays),
            _group(FieldParameters, "parameters", arrays),
            _built(TrainingProgress, head["progress"]),
        )
    except SpaceFileError:
        raise
    except (KeyError, TypeError, ValueError) as error:
        raise SpaceFileError(f"{file}: not a saved virtual space of this program: {error}") from error


def _group(kind: type[Any], group: str, arrays: dict[str, NDArray[Any]]) -> Any:
    """Build a dataclass of arrays and numbers."""
    values = {field.name: arrays[f"{group}.{field.name}"] for field in dataclasses.fields(kind)}
    return kind(**{name: value.item() if value.ndim == 0 else value for name, value in values.items()})


def _built(kind: Any, value: Any) -> Any:
    """Build a configuration from nested dictionaries; an unknown key is a TypeError."""
    if dataclasses.is_dataclass(kind):
        hints = get_type_hints(kind)
        return kind(**{key: _built(hints.get(key), part) for key, part in value.items()})  # type: ignore[operator]
    return tuple(value) if isinstance(value, list) else value  # JSON knows no tuples
