"""A trained space as one file: version, configuration, parameters, keyframes, checksum."""

from __future__ import annotations

import dataclasses
import hashlib
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
from instant_ic.vspace.prior import MOVED, ROBOT, ROOM, SKY, PanoramaPrior

FORMAT, VERSION = "instant_ic virtual space", 4
_CONTENT_3 = np.array([ROOM, ROBOT, SKY, MOVED], np.uint8)  # codes of ``content`` in version 3
FILE_NAME = "space.npz"
"""Name of the file in a folder."""


class SpaceFileError(ValueError):
    """A file holds no usable space; the message names the file and the reason."""


@dataclass(frozen=True)
class Progress:
    """Progress of training."""

    psnr_db: float
    iteration: int
    refresh: bool
    ready_iterations: int
    train_seconds: float
    ready: bool
    shows_field: bool


@dataclass(frozen=True)
class SavedSpace:
    """Content of a file: the keyframes (newest first), their gains (K, 3), and the trained field."""

    config: VirtualSpaceConfig
    priors: tuple[PanoramaPrior, ...]
    gains: Floats
    lattice: Lattice
    parameters: FieldParameters
    progress: Progress


def space_file(path: str | Path) -> Path:
    """The file itself, where ``path`` may be the folder it lies in."""
    path = Path(path)
    return path if path.suffix == ".npz" and not path.is_dir() else path / FILE_NAME


def write(path: str | Path, saved: SavedSpace) -> Path:
    """Write the file atomically, creating folders; returns its path.

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
        np.savez(stream, allow_pickle=False, sha256=np.frombuffer(_checksum(arrays), np.uint8), **arrays)
    return file


def read(path: str | Path) -> SavedSpace:
    """Reads a file that ``write`` has made.

    Raises:
        SpaceFileError: missing, damaged, foreign, or of a newer version.
    """
    file = space_file(path)
    try:
        if file.is_file() and zipfile.is_zipfile(file):
            check_arrays(file)
        with np.load(file, allow_pickle=False) as loaded:
            if not isinstance(loaded, np.lib.npyio.NpzFile) or not {"head", "sha256"} <= set(loaded.files):
                raise SpaceFileError(f"{file}: not a saved virtual space")
            arrays = {name: loaded[name] for name in loaded.files}
    except FileNotFoundError as error:
        raise SpaceFileError(f"{file}: no such file; make one with: ic vspace train") from error
    except SpaceFileError:
        raise
    except (
        OSError,
        ValueError,
        EOFError,
        MemoryError,
        zipfile.BadZipFile,
        AttributeError,
        NotImplementedError,
    ) as error:
        raise SpaceFileError(f"{file}: damaged, or not a saved virtual space: {error}") from error
    if arrays.pop("sha256").tobytes() != _checksum(arrays):
        raise SpaceFileError(f"{file}: damaged: its content does not have its own SHA-256")
    try:
        head = json.loads(arrays["head"].tobytes())
        if head["format"] != FORMAT:
            raise SpaceFileError(f"{file}: not a saved virtual space (format {head['format']!r})")
        if head["version"] > VERSION:
            raise SpaceFileError(f"{file}: version {head['version']}, this program reads up to {VERSION}: update it")
        if head["version"] == 3:
            for name in (f"prior.{number}.content" for number in range(head["keyframes"])):
                arrays[name] = _CONTENT_3[arrays[name]]
        elif head["version"] < VERSION:
            raise SpaceFileError(f"{file}: version {head['version']}, of an older program: train it again")
        priors = tuple(_group(PanoramaPrior, f"prior.{number}", arrays) for number in range(head["keyframes"]))
        if not priors:
            raise SpaceFileError(f"{file}: holds no keyframe")
        return SavedSpace(
            _built(VirtualSpaceConfig, head["config"], known_only=head["version"] == 3),
            priors,
            arrays["gains"],
            _group(Lattice, "lattice", arrays),
            _group(FieldParameters, "parameters", arrays),
            _built(Progress, head["progress"]),
        )
    except SpaceFileError:
        raise
    except (IndexError, KeyError, TypeError, ValueError) as error:
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
    names = [field.name for field in dataclasses.fields(kind)]
    values = {name: arrays[f"{group}.{name}"] for name in names}
    return kind(**{name: value.item() if value.ndim == 0 else value for name, value in values.items()})


def _built(kind: Any, value: Any, known_only: bool = False) -> Any:
    """A configuration from nested dictionaries; a key that it does not know is an error, or left out."""
    if dataclasses.is_dataclass(kind):
        hints = get_type_hints(kind)
        parts = {key: part for key, part in value.items() if key in hints or not known_only}
        return kind(**{key: _built(hints.get(key), part, known_only) for key, part in parts.items()})  # type: ignore[operator]
    return tuple(value) if isinstance(value, list) else value  # JSON knows no tuples
