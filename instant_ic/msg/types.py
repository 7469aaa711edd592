"""The type store: ROS 2 Jazzy's messages from `rosbags`, and our own from the ``.msg`` files beside this module."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

DEFINITIONS = Path(__file__).resolve().parent / "definitions"

# Short names that several packages of Jazzy share: the one that this stack means.
_PREFERRED = {
    "GoalStatus": "action_msgs/msg/GoalStatus",
    "GoalStatusArray": "action_msgs/msg/GoalStatusArray",
    "KeyValue": "diagnostic_msgs/msg/KeyValue",
}


class MessageError(ValueError):
    """An unknown type, or bytes that are not a message of the type they claim to be."""


@functools.cache
def typestore() -> Typestore:
    """Jazzy's types and ours; made once a process (about 0.1 s)."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    types: dict[str, Any] = {}
    for path in sorted(DEFINITIONS.glob("*/*.msg")):
        types.update(get_types_from_msg(path.read_text(), f"{path.parent.name}/msg/{path.stem}"))
    store.register(types)
    return store


@functools.cache
def message_type(name: str) -> Any:
    """Class of a type by full name (``sensor_msgs/msg/Image``, ``sensor_msgs/Image``) or short name (``Image``).

    Raises:
        MessageError: no such type.
    """
    types = typestore().types
    parts = name.split("/")
    if len(parts) == 1:
        full = _PREFERRED.get(name) or next((t for t in types if t.rsplit("/", 1)[1] == name), name)
    else:
        full = f"{parts[0]}/msg/{parts[-1]}"
    if full not in types:
        raise MessageError(f"no message type {name!r} in ROS 2 Jazzy or {DEFINITIONS}")
    return types[full]


def type_name(message_or_class: Any) -> str:
    """Full name, for example ``sensor_msgs/msg/Image``.

    Raises:
        MessageError: the object is no message.
    """
    name = getattr(message_or_class, "__msgtype__", None)
    if not isinstance(name, str):
        raise MessageError(f"{message_or_class!r} is not a message")
    return name


@functools.cache
def type_hash(name: str) -> str:
    """RIHS01 hash of a type, as ROS 2 computes it."""
    return typestore().hash_rihs01(name)


def serialize(message: Any) -> bytes | memoryview:
    """CDR bytes, little-endian, with the 4-byte encapsulation header.

    Raises:
        MessageError: a field has a value of the wrong type or length.
    """
    name = type_name(message)
    try:
        return typestore().serialize_cdr(message, name)
    except (TypeError, ValueError, AttributeError, AssertionError, OverflowError) as error:
        raise MessageError(f"{name}: {_first_bad_field(message) or error}") from error
    except Exception as error:  # struct.error and numba/numpy errors of generated code have no common base
        raise MessageError(f"{name}: {error}") from error


def deserialize(data: bytes | bytearray | memoryview, name: str) -> Any:
    """Message of CDR bytes; large arrays are read-only views of ``data``.

    Raises:
        MessageError: unknown type, or the bytes are cut or of another type.
    """
    full = type_name(message_type(name))
    view = data if isinstance(data, (bytes, memoryview)) else memoryview(data)
    try:
        return typestore().deserialize_cdr(view, full)
    except Exception as error:  # whatever generated code raises on foreign bytes: struct, index, unicode, value
        raise MessageError(f"{len(data)} bytes are not a {full}: {type(error).__name__}: {error}") from error


def _first_bad_field(message: Any) -> str | None:
    """Names the field that does not serialize, for the error message."""
    for field in typestore().get_msgdef(type_name(message)).fields:
        value = getattr(message, field[0], None)
        if value is None:
            return f"field {field[0]} is missing"
    return None
