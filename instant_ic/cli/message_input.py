"""Messages built from YAML that the user types. Errors name the path of the field."""

from __future__ import annotations

import difflib
from typing import Any

import numpy as np

from instant_ic.cli.errors import UserError
from instant_ic.cli.names import find_type
from instant_ic.config.params import ParameterError, yaml_value
from instant_ic.config.scalars import READERS, Scalar, to_whole_number
from instant_ic.msg import message_type, to_time, type_name, typestore

_FLOATS = ("float32", "float64")
_NOT_FINITE = tuple(f"{sign}{word}" for sign in ("", "+", "-") for word in (".inf", ".nan", "inf", "nan"))
_BASE, _NAME, _ARRAY, _SEQUENCE = 1, 2, 3, 4

TIME = "builtin_interfaces/msg/Time"
HEADER = "std_msgs/msg/Header"
QUATERNION = "geometry_msgs/msg/Quaternion"  # its w defaults to 1, as its definition says


def parse(text: str, name: str) -> Any:
    """Parse YAML text into the values of a message.

    Raises:
        UserError: the text is not YAML, or not a mapping.
    """
    try:
        values = yaml_value(text, name) if text.strip() else {}
    except ParameterError as error:
        raise UserError(str(error), 2) from None
    if not isinstance(values, dict):
        example = next(iter(fields(name)), ("field", None))[0]
        raise UserError(f"the values of a {name} must be a mapping such as '{{{example}: ...}}' (got {text!r})", 2)
    return values


def fields(name: str) -> list[tuple[str, Any]]:
    """Return the fields of a message type, with their types as rosbags describes them.

    Raises:
        UserError: the type is unknown.
    """
    return list(typestore().get_msgdef(find_type(name)).fields)


def build(name: str, values: Any, now_ns: int, path: str = "") -> Any:
    """Build a message from the given values; other fields are zero or empty.

    ``header: auto`` and ``stamp: now`` take the current time.

    Args:
        name: message type, full or short.
        values: mapping of field → value.
        now_ns: current time for ``auto`` and ``now``.
        path: path of this message within the whole one, for errors.

    Raises:
        UserError: a field is unknown, or its value does not fit; the message names the path of the field.
    """
    known = dict(fields(name))
    full = type_name(message_type(name))
    if full == TIME and _word(values) == "now":
        return to_time(now_ns)
    if full == HEADER and _word(values) == "auto":
        values = {"stamp": "now"}
    if not isinstance(values, dict):
        raise _misfit(path, f"a mapping with the fields of {full}", values)
    if full == QUATERNION:
        values = {"w": 1.0, **values}
    for key in values:
        if key not in known:
            close = difflib.get_close_matches(str(key), known, n=1)
            hint = f"did you mean {close[0]!r}?" if close else f"fields: {', '.join(known)}"
            raise UserError(f"{full} has no field {_join(path, key)!r} ({hint})", 2)
    arguments = {
        key: _value(kind, values[key], now_ns, _join(path, key)) if key in values else _empty(kind, now_ns)
        for key, kind in known.items()
    }
    return message_type(full)(**arguments)


def _join(path: str, key: Any) -> str:
    return f"{path}.{key}" if path else str(key)


def _misfit(path: str, wanted: str, value: Any) -> UserError:
    return UserError(f"{path or 'the message'} must be {wanted} (got {value!r})", 2)


def _empty(kind: Any, now_ns: int) -> Any:
    node, detail = kind
    if node == _NAME:
        return build(detail, {}, now_ns)
    if node == _BASE:
        return {"string": "", "wstring": "", "bool": False}.get(detail[0], 0.0 if detail[0] in _FLOATS else 0)
    inner, length = detail
    if inner[0] == _BASE and inner[1][0] not in ("string", "wstring"):
        return np.zeros(length if node == _ARRAY else 0, _dtype(inner[1][0]))
    return [_empty(inner, now_ns) for _ in range(length if node == _ARRAY else 0)]


def _dtype(base: str) -> Any:
    return np.dtype({"byte": "uint8", "char": "uint8", "octet": "uint8", "bool": "bool"}.get(base, base))


def _value(kind: Any, value: Any, now_ns: int, path: str) -> Any:
    node, detail = kind
    if node == _NAME:
        return build(detail, value, now_ns, path)
    if node == _BASE:
        return _scalar(detail[0], detail[1], value, path)
    inner, length = detail
    if not isinstance(value, list):
        raise _misfit(path, "a list", value)
    if node == _ARRAY and len(value) != length:
        raise UserError(f"{path} must have {length} values (got {len(value)})", 2)
    if node == _SEQUENCE and length and len(value) > length:
        raise UserError(f"{path} must have at most {length} values (got {len(value)})", 2)
    parts = [_value(inner, part, now_ns, f"{path}[{index}]") for index, part in enumerate(value)]
    if inner[0] == _BASE and inner[1][0] not in ("string", "wstring"):
        return np.array(parts, _dtype(inner[1][0]))
    return parts


def _word(values: Any) -> Any:
    return values.text if isinstance(values, Scalar) else values


def _scalar(base: str, most: int, value: Any, path: str) -> Any:
    kind = {"bool": bool, "string": str, "wstring": str}.get(base, float if base in _FLOATS else int)
    if kind is float and isinstance(value, float):
        return value
    # Infinity must be accepted: a scan's range is infinite where nothing returns.
    if kind is float and isinstance(value, Scalar) and value.text.lower() in _NOT_FINITE:
        return float(value.text.replace(".", ""))
    try:
        found: Any = to_whole_number(value) if kind is int else READERS[kind](value)
    except ValueError:
        raise _misfit(path, base, value) from None
    if kind is str and most and len(found) > most:
        raise UserError(f"{path} must have at most {most} characters (got {len(found)})", 2)
    if kind is int:
        limits = np.iinfo(_dtype(base))
        if not limits.min <= found <= limits.max:
            raise _misfit(path, f"{base}, {limits.min}..{limits.max}", value)
    return found
