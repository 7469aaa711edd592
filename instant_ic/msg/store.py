"""Message types of a process. Classes and CDR code are generated at first use, from a cache of all definitions.

`rosbags` generates several hundred classes at its import, and twelve functions for each type used. A node needs a few
dozen classes with two or three functions each, so generating them on demand saves a third of the CPU of its start.
"""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from instant_ic.util import paths
from instant_ic.util.files import replacing

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

Entry = Mapping[str, Any]
"""Definition of a type: ``constants`` (values by name), ``fields`` (name and rosbags' description), ``hints`` (type
hints of the fields as text), ``hash`` (RIHS01)."""


class Definition:
    """Class and CDR code of a type, with the interface that rosbags' generated code expects."""

    def __init__(self, name: str, entry: Entry, store: TypeIndex) -> None:
        self.fields: list[tuple[str, Any]] = entry["fields"]
        self._name, self._entry = name, entry
        self._store: Any = store  # replaces rosbags' Typestore for the generated code

    @functools.cached_property
    def cls(self) -> Any:
        """The dataclass of the type."""
        names = [name for name, _ in self.fields]
        body = {
            "__doc__": f"Class for {self._name}.",
            "__module__": __name__,
            "__msgtype__": self._name,
            "__annotations__": dict(zip(names, self._entry["hints"], strict=True)),
            **self._entry["constants"],
        }
        if names == ["structure_needs_at_least_one_member"]:
            body[names[0]] = 0
        return dataclass(type(self._name.replace("/", "__"), (), body))

    @functools.cached_property
    def _size(self) -> tuple[Callable[..., int], int]:
        from rosbags.serde.cdr import generate_getsize_cdr

        function, size = generate_getsize_cdr(self.fields, self._store)
        return function, size

    @property
    def getsize_cdr(self) -> Callable[..., int]:
        """Function that returns the position after a message."""
        return self._size[0]

    @property
    def size_cdr(self) -> int:
        """Size of a message in bytes; 0 if it varies."""
        return self._size[1]

    @functools.cached_property
    def serialize_cdr_le(self) -> Callable[..., int]:
        """Function that writes a message."""
        from rosbags.serde.cdr import generate_serialize_cdr

        return generate_serialize_cdr(self.fields, self._store, "le")

    @functools.cached_property
    def deserialize_cdr_le(self) -> Callable[..., tuple[Any, int]]:
        """Function that reads a little-endian message."""
        from rosbags.serde.cdr import generate_deserialize_cdr

        return generate_deserialize_cdr(self.fields, self._store, "le")

    @functools.cached_property
    def deserialize_cdr_be(self) -> Callable[..., tuple[Any, int]]:
        """Function that reads a big-endian message."""
        from rosbags.serde.cdr import generate_deserialize_cdr

        return generate_deserialize_cdr(self.fields, self._store, "be")

    def deserialize(self, data: bytes | memoryview) -> Any:
        """Return the message in CDR bytes. On wrong bytes, the generated code may raise any exception."""
        if len(data) < 4 or data[0] or data[1] > 1:
            raise ValueError("no header of plain CDR")
        read = self.deserialize_cdr_le if data[1] else self.deserialize_cdr_be
        message, end = read(data[4:], 0, self.cls, self._store)
        if end + 4 + 3 < len(data):  # CDR may be padded by up to 3 bytes
            raise ValueError(f"{len(data) - end - 4} bytes are left over")
        return message


class TypeIndex:
    """Definitions of types by full name."""

    max_sequence_length = 2**32 - 1

    def __init__(self, entries: dict[str, Entry]) -> None:
        self.entries = entries
        self._definitions: dict[str, Definition] = {}

    def get_msgdef(self, name: str) -> Definition:
        """Return the definition of a type.

        Raises:
            KeyError: there is no such type.
        """
        found = self._definitions.get(name)
        if found is None:
            found = self._definitions[name] = Definition(name, self.entries[name], self)
        return found


def entries_of(store: Typestore, names: set[str] | None = None) -> dict[str, Entry]:
    """Return the definitions of a store's types.

    Args:
        store: store that also has all nested types.
        names: full names of the wanted types; None for all.
    """
    from rosbags.typesys.base import normalize_fieldname
    from rosbags.typesys.codegen import get_typehint

    return {
        name: {
            "constants": {normalize_fieldname(constant): value for constant, _, value in constants},
            "fields": [(normalize_fieldname(field), description) for field, description in fields],
            "hints": [get_typehint(description) for _, description in fields],
            "hash": store.hash_rihs01(name),
        }
        for name, (constants, fields) in store.fielddefs.items()
        if names is None or name in names
    }


def read_entries(definitions: Path, make: Callable[[], Typestore]) -> dict[str, Entry]:
    """Return all definitions, from the cache if it matches this version of rosbags and these files.

    Args:
        definitions: folder of our own ``.msg`` files.
        make: function that creates the store if the cache cannot be used.
    """
    key, file = _key(definitions), paths.cache_dir() / "message_types.json"
    with suppress(OSError, ValueError):
        found = json.loads(file.read_bytes())
        if isinstance(found, dict) and found.get("key") == key and isinstance(found.get("types"), dict):
            types: dict[str, Entry] = found["types"]
            return types
    types = entries_of(make())
    with suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        with replacing(file) as out:
            out.write(json.dumps({"key": key, "types": types}).encode())
    return types


def _key(definitions: Path) -> str:
    """Return the cache's key: a hash of everything on which the definitions depend."""
    import rosbags

    digest = hashlib.sha256(Path(__file__).read_bytes())
    for file in sorted(definitions.glob("*/*.msg")):
        digest.update(f"{file.parent.name}/{file.name}".encode() + file.read_bytes())
    for file in sorted(Path(rosbags.__path__[0], "typesys", "stores").glob("*.py")):
        digest.update(f"{file} {(status := file.stat()).st_mtime_ns} {status.st_size}".encode())
    return digest.hexdigest()
