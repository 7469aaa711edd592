"""Message types of ROS 2 Jazzy, from `rosbags`, and our own, from the ``.msg`` files beside this module."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from instant_ic.msg.store import Definition, TypeIndex, entries_of, read_entries

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

DEFINITIONS = Path(__file__).resolve().parent / "definitions"

_LARGE = 1 << 16  # below this size, clearing the whole message is faster than finding the parts that need it

# Short names that several packages of Jazzy share, with the type that they mean in this stack.
_PREFERRED = {
    "GoalStatus": "action_msgs/msg/GoalStatus",
    "GoalStatusArray": "action_msgs/msg/GoalStatusArray",
    "KeyValue": "diagnostic_msgs/msg/KeyValue",
}


class MessageError(ValueError):
    """The type is unknown, or the bytes or values are not a message of the type."""


@functools.cache
def typestore() -> Typestore:
    """Return rosbags' store with Jazzy's types and our own, for tools. Its creation takes 0.1 s, once per process.

    Its classes differ from those of :func:`message_type`.
    """
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    types: dict[str, Any] = {}
    for path in sorted(DEFINITIONS.glob("*/*.msg")):
        types.update(get_types_from_msg(path.read_text(), f"{path.parent.name}/msg/{path.stem}"))
    store.register(types)
    return store


@functools.cache
def _index() -> TypeIndex:
    return TypeIndex(read_entries(DEFINITIONS, typestore))


def register_type(name: str, definition: str) -> None:
    """Register a type of another project in this process, from the definition in a bag.

    Types that are already known, including nested ones, stay unchanged.

    Args:
        name: full name, for example ``rover_msgs/msg/Cells``.
        definition: text in the ``ros2msg`` format, with the definitions of nested types.

    Raises:
        MessageError: the text is not a valid definition.
    """
    if name in _index().entries:
        return
    from rosbags.typesys import TypesysError, get_types_from_msg

    try:
        found = get_types_from_msg(definition, name)
        known = typestore().fielddefs
        new = {inner: fields for inner, fields in found.items() if inner not in known}
        typestore().register(new)
        _index().entries.update(entries_of(typestore(), set(new)))
    except TypesysError as error:
        raise MessageError(f"the definition of {name} cannot be read: {error}") from None


@functools.cache
def message_type(name: str) -> Any:
    """Return the class of a type by full (``sensor_msgs/msg/Image``, ``sensor_msgs/Image``) or short name (``Image``).

    Raises:
        MessageError: there is no such type.
    """
    types = _index().entries
    parts = name.split("/")
    if len(parts) == 1:
        full = _PREFERRED.get(name) or next((t for t in types if t.rsplit("/", 1)[1] == name), name)
    else:
        full = f"{parts[0]}/msg/{parts[-1]}"
    if full not in types:
        raise MessageError(f"no message type {name!r} in ROS 2 Jazzy or {DEFINITIONS}")
    return _index().get_msgdef(full).cls


def type_name(message_or_class: Any) -> str:
    """Return the full type name, for example ``sensor_msgs/msg/Image``.

    Raises:
        MessageError: the object is not a message.
    """
    name = getattr(message_or_class, "__msgtype__", None)
    if not isinstance(name, str):
        raise MessageError(f"{message_or_class!r} is not a message")
    return name


@functools.cache
def type_hash(name: str) -> str:
    """Return the RIHS01 hash of a type, as ROS 2 computes it."""
    return str(_index().entries[name]["hash"])


def serialize(message: Any) -> memoryview:
    """Serialize to little-endian CDR bytes with the 4-byte encapsulation header.

    Raises:
        MessageError: a field has a value of the wrong type or length.
    """
    size, write = serializer(message)
    data = memoryview(bytearray(size))
    write(data)
    return data.toreadonly()


def serializer(message: Any) -> tuple[int, Callable[[memoryview], None]]:
    """Return the size of a message's CDR bytes, and a function that writes them into memory of that size.

    A large message can thus be written straight into shared memory. The memory need not be cleared before.

    Raises:
        MessageError: a field has a value of the wrong type or length. The returned function raises this too.
    """
    name = type_name(message)
    store = _index()
    definition = store.get_msgdef(name)
    try:
        size = 4 + definition.getsize_cdr(0, message, store)
    except Exception as error:  # generated code may raise anything on a wrong value
        raise _explained(message, error) from error

    def write(target: memoryview) -> None:
        # Padding must be zero, or equal messages would differ in their bytes. Arrays have no padding inside, so only
        # the `rest` bytes before and after the largest array are cleared.
        rest = size
        if size >= _LARGE:
            rest -= max((v.nbytes for v in vars(message).values() if isinstance(v, np.ndarray)), default=0)
            target[size - rest :] = bytes(rest)
        target[:rest] = bytes(rest)
        target[1] = 1  # little-endian
        try:
            end = definition.serialize_cdr_le(target[4:], 0, message, store)
        except Exception as error:  # generated code may raise anything on a wrong value
            raise _explained(message, error) from error
        if end + 4 != size:
            raise MessageError(f"{name}: {end + 4} bytes written where {size} were expected")

    return size, write


def _explained(message: Any, error: Exception) -> MessageError:
    return MessageError(f"{type_name(message)}: {_first_bad_field(message) or error}")


def deserialize(data: bytes | bytearray | memoryview, name: str) -> Any:
    """Deserialize CDR bytes. Large arrays are read-only views of ``data``.

    Raises:
        MessageError: the type is unknown, or the bytes are truncated or of another type.
    """
    definition = _definition(name)
    try:
        return definition.deserialize(data if isinstance(data, (bytes, memoryview)) else memoryview(data))
    except Exception as error:  # generated code may raise struct, index, unicode or value errors on foreign bytes
        full = type_name(definition.cls)
        raise MessageError(f"{len(data)} bytes are not a {full}: {type(error).__name__}: {error}") from error


@functools.cache
def _definition(name: str) -> Definition:
    return _index().get_msgdef(type_name(message_type(name)))


def _first_bad_field(message: Any) -> str | None:
    """Describe the first field that cannot be serialized, for the error message."""
    for field in _index().get_msgdef(type_name(message)).fields:
        value = getattr(message, field[0], None)
        if value is None:
            return f"field {field[0]} is missing"
    return None
