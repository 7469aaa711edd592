"""Parameter changes as messages for ``/parameter_events`` (rcl_interfaces/ParameterEvent)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from instant_ic.msg import message_type, to_time

TOPIC = "/parameter_events"

_NOT_SET, _STRING = 0, 4
_SCALARS = {bool: (1, "bool_value"), int: (2, "integer_value"), float: (3, "double_value"), str: (4, "string_value")}
_ARRAYS = {
    bool: (6, "bool_array_value", np.bool_),
    int: (7, "integer_array_value", np.int64),
    float: (8, "double_array_value", np.float64),
}
_STRINGS = 9


def parameter_event(node: str, changed: Mapping[str, Any], stamp_ns: int) -> Any:
    """Return a ParameterEvent for the values (plain JSON) that a node has accepted."""
    return message_type("rcl_interfaces/ParameterEvent")(
        stamp=to_time(stamp_ns),
        node=f"/{node}",
        new_parameters=[],
        changed_parameters=[_parameter(name, value) for name, value in changed.items()],
        deleted_parameters=[],
    )


def _parameter(name: str, value: Any) -> Any:
    """Return a rcl_interfaces/Parameter; a value without a type there (a mixed list) becomes JSON text."""
    fields = {field: kind() for kind, (_, field) in _SCALARS.items()}
    fields |= {field: np.zeros(0, dtype) for _, field, dtype in _ARRAYS.values()}
    fields |= {"type": _NOT_SET, "byte_array_value": np.zeros(0, np.uint8), "string_array_value": []}
    kinds = {type(part) for part in value} if isinstance(value, list) else set()
    element = kinds.pop() if len(kinds) == 1 else None
    if type(value) in _SCALARS:
        fields["type"], field = _SCALARS[type(value)]
        fields[field] = value
    elif element in _ARRAYS:
        fields["type"], field, dtype = _ARRAYS[element]
        fields[field] = np.array(value, dtype)
    elif element is str:
        fields |= {"type": _STRINGS, "string_array_value": value}
    elif value is not None:
        fields |= {"type": _STRING, "string_value": json.dumps(value)}
    return message_type("rcl_interfaces/Parameter")(
        name=name, value=message_type("rcl_interfaces/ParameterValue")(**fields)
    )
