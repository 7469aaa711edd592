"""A trained space as one file: version, configuration, parameters, keyframes, checksum."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
from numpy.typing import NDArray

from .config import VirtualSpaceConfig
from .field import FieldParameters, Lattice
from .prior import PanoramaPrior

FORMAT, VERSION = "instant_ic virtual space", 1
FILE_NAME = "space.npz"
"""Of the file where a folder is named."""


class SpaceFileError(ValueError):
    """A file that holds no space that can be used; the message names it and says why."""


@dataclass(frozen=True)
class Progress:
    """How far training had come."""

    psnr_db: float
    iteration: int
    refresh: bool
    ready_iterations: int
    train_seconds: float


@dataclass(frozen=True)
class SavedKeyframe:
    """One keyframe and the field that has learnt it."""

    prior: PanoramaPrior
    lattice: Lattice
    parameters: FieldParameters
    progress: Progress


@dataclass(frozen=True)
class SavedSpace:
    """What a file holds. ``keyframes``: newest first."""

    config: VirtualSpaceConfig
    keyframes: tuple[SavedKeyframe, ...]


_GROUPS = {"prior": PanoramaPrior, "lattice": Lattice, "parameters": FieldParameters}
"""The parts of a keyframe that are arrays."""


def space_file(path: str | Path) -> Path:
    """The file itself, where ``path`` may be the folder it lies in."""
    path = Path(path)
    return path if path.suffix == ".npz" and not path.is_dir() else path / FILE_NAME


def write(path: str | Path, saved: SavedSpace) -> Path:
    """Writes the file whole or not at all; folders are made. Returns its path.

    Raises:
        OSError: it cannot be written.
    """
    file = space_file(path)
    head = {
        "format": FORMAT,
        "version": VERSION,
        "config": dataclasses.asdict(saved.config),
        "keyframes": [dataclasses.asdict(keyframe.progress) for keyframe in saved.keyframes],
    }
    arrays = {"head": np.frombuffer(json.dumps(head).encode(), np.uint8)}
    for number, keyframe in enumerate(saved.keyframes):
        for group, kind in _GROUPS.items():
            for field in dataclasses.fields(kind):
                value = getattr(getattr(keyframe, group), field.name)
                arrays[f"{number}.{group}.{field.name}"] = np.asarray(value)
    file.parent.mkdir(parents=True, exist_ok=True)
    part = file.with_name(f".{file.name}.{os.getpid()}.part")
    try:
        with part.open("wb") as stream:
            np.savez(stream, allow_pickle=False, sha256=np.frombuffer(_checksum(arrays), np.uint8), **arrays)
            stream.flush()
            os.fsync(stream.fileno())
        part.replace(file)
    finally:
        part.unlink(missing_ok=True)
    return file


def read(path: str | Path) -> SavedSpace:
    """Reads a file that ``write`` has made.

    Raises:
        SpaceFileError: missing, damaged, foreign, or of a newer version.
    """
    file = space_file(path)
    try:
        with np.load(file, allow_pickle=False) as loaded:
            if not isinstance(loaded, np.lib.npyio.NpzFile) or not {"head", "sha256"} <= set(loaded.files):
                raise SpaceFileError(f"{file}: not a saved virtual space")
            arrays = {name: loaded[name] for name in loaded.files}
    except FileNotFoundError as error:
        raise SpaceFileError(f"{file}: no such file; make one with: ic vspace train") from error
    except SpaceFileError:
        raise
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, AttributeError, NotImplementedError) as error:
        raise SpaceFileError(f"{file}: damaged, or not a saved virtual space: {error}") from error
    if arrays.pop("sha256").tobytes() != _checksum(arrays):
        raise SpaceFileError(f"{file}: damaged: its content does not have its own SHA-256")
    try:
        head = json.loads(arrays["head"].tobytes())
        if head["format"] != FORMAT:
            raise SpaceFileError(f"{file}: not a saved virtual space (format {head['format']!r})")
        if head["version"] > VERSION:
            raise SpaceFileError(f"{file}: version {head['version']}, this program reads up to {VERSION}: update it")
        keyframes = [
            SavedKeyframe(
                **{group: _group(kind, f"{number}.{group}", arrays) for group, kind in _GROUPS.items()},
                progress=_built(Progress, progress),
            )
            for number, progress in enumerate(head["keyframes"])
        ]
        if not keyframes:
            raise SpaceFileError(f"{file}: holds no keyframe")
        return SavedSpace(_built(VirtualSpaceConfig, head["config"]), tuple(keyframes))
    except SpaceFileError:
        raise
    except (KeyError, TypeError, ValueError) as error:
        raise SpaceFileError(f"{file}: does not fit this program: {error}") from error


def _checksum(arrays: dict[str, NDArray[Any]]) -> bytes:
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(array.tobytes())
    return digest.digest()


def _group(kind: type[Any], group: str, arrays: dict[str, NDArray[Any]]) -> Any:
    """A dataclass of arrays and numbers."""
    values = {field.name: arrays[f"{group}.{field.name}"] for field in dataclasses.fields(kind)}
    return kind(**{name: value.item() if value.ndim == 0 else value for name, value in values.items()})


def _built(kind: type[Any], values: dict[str, Any]) -> Any:
    """A configuration from nested dictionaries; a key that it does not know is an error."""
    hints = get_type_hints(kind)
    return kind(**{k: _built(hints[k], v) if dataclasses.is_dataclass(hints.get(k)) else v for k, v in values.items()})
