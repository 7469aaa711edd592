"""Messages as text, for people: YAML-like, long arrays shortened."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

MAX_VALUES = 12
"""A longer array is shortened."""


def field(message: Any, path: str) -> Any:
    """A field by dotted path; an index picks from a list or array (``transforms.0.transform``).

    Raises:
        AttributeError: no such field; the message names those that there are.
    """
    value = message
    for part in path.split(".") if path else []:
        if part.lstrip("-").isdigit() and isinstance(value, (list, np.ndarray)):
            try:
                value = value[int(part)]
            except IndexError:
                raise AttributeError(f"{path}: there are {len(value)} entries, no index {part}") from None
            continue
        names = [f.name for f in dataclasses.fields(value)] if dataclasses.is_dataclass(value) else []
        names = [name for name in names if not name.startswith("__")]
        if part not in names:
            raise AttributeError(f"no field {part!r} in {path!r} (there are: {', '.join(names) or 'none'})")
        value = getattr(value, part)
    return value


def describe(value: Any, full: bool = False, indent: str = "") -> str:
    """A message, or a field of one, as indented lines."""
    if dataclasses.is_dataclass(value):
        lines = []
        for item in dataclasses.fields(value):
            if item.name.startswith("__"):
                continue
            inner = getattr(value, item.name)
            if dataclasses.is_dataclass(inner) or (isinstance(inner, list) and inner and _nested(inner)):
                lines.append(f"{indent}{item.name}:")
                lines.append(describe(inner, full, indent + "  "))
            else:
                lines.append(f"{indent}{item.name}: {describe(inner, full)}")
        return "\n".join(lines)
    if isinstance(value, list) and value and _nested(value):
        return "\n".join(f"{indent}- {describe(entry, full, indent + '  ').lstrip()}" for entry in value)
    if isinstance(value, (np.ndarray, list)):
        return indent + _array(value, full)
    return indent + _scalar(value)


def _nested(values: list[Any]) -> bool:
    return dataclasses.is_dataclass(values[0])


def _array(values: Any, full: bool) -> str:
    if full or len(values) <= MAX_VALUES:
        return "[" + ", ".join(_scalar(v) for v in values) + "]"
    head = ", ".join(_scalar(v) for v in values[: MAX_VALUES // 2])
    return f"[{head}, ... {len(values)} values]"


def _scalar(value: Any) -> str:
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return f"{value:.9g}"
    return repr(value) if isinstance(value, str) else str(value)
