"""Parameter changes as messages for ``/parameter_events`` (rcl_interfaces/ParameterEvent)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from instant_ic.msg import message_type, to_time

TOPIC = "/parameter_events"

_NOT_SET, _BOOL, _INTEGER, _DOUBLE, _STRING, _BYTES, _BOOLS, _INTEGERS, _DOUBLES, _STRINGS = range(10)


def parameter_event(node: str, changed: Mapping[str, Any], stamp_ns: int) -> Any:
    """ParameterEvent for the values (plain JSON) that a node has accepted."""
    return message_type("rcl_interfaces/ParameterEvent")(
        stamp=to_time(stamp_ns),
        node=f"/{node}",
        new_parameters=[],
        changed_parameters=[parameter(name, value) for name, value in changed.items()],
        deleted_parameters=[],
    )


def parameter(name: str, value: Any) -> Any:
    """One rcl_interfaces/Parameter; a value without a type there (a mixed list) becomes JSON text."""
    return message_type("rcl_interfaces/Parameter")(name=name, value=_parameter_value(value))


def _parameter_value(value: Any) -> Any:
    import numpy as np

    kind, field, content = _field(value)
    empty = {
        "type": kind,
        "bool_value": False,
        "integer_value": 0,
        "double_value": 0.0,
        "string_value": "",
        "byte_array_value": np.zeros(0, np.uint8),
        "bool_array_value": np.zeros(0, np.bool_),
        "integer_array_value": np.zeros(0, np.int64),
        "double_array_value": np.zeros(0, np.float64),
        "string_array_value": [],
    }
    arrays = {_BOOLS: np.bool_, _INTEGERS: np.int64, _DOUBLES: np.float64}
    if kind in arrays:
        content = np.array(content, arrays[kind])
    return message_type("rcl_interfaces/ParameterValue")(**empty | ({field: content} if field else {}))


def _field(value: Any) -> tuple[int, str, Any]:
    if value is None:
        return _NOT_SET, "", None
    scalars = {
        bool: (_BOOL, "bool_value"),
        int: (_INTEGER, "integer_value"),
        float: (_DOUBLE, "double_value"),
        str: (_STRING, "string_value"),
    }
    if type(value) in scalars:
        return (*scalars[type(value)], value)
    arrays = {
        bool: (_BOOLS, "bool_array_value"),
        int: (_INTEGERS, "integer_array_value"),
        float: (_DOUBLES, "double_array_value"),
        str: (_STRINGS, "string_array_value"),
    }
    kinds = {type(part) for part in value} if isinstance(value, list) else set()
    if len(kinds) == 1 and (kind := kinds.pop()) in arrays:
        return (*arrays[kind], value)
    return _STRING, "string_value", json.dumps(value)
