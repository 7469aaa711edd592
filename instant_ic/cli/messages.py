"""Messages as text: YAML-like with long arrays shortened for people, a line of JSON for programs."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import numpy as np


def field(message: Any, path: str) -> Any:
    """Return a field by its dotted path; an index selects an entry of a list (``transforms.0.transform``).

    Raises:
        AttributeError: there is no such field; the message lists the existing ones.
    """
    value = message
    for part in path.split(".") if path else []:
        if part.lstrip("-").isdigit() and isinstance(value, (list, np.ndarray)):
            try:
                value = value[int(part)]
            except IndexError:
                raise AttributeError(f"{path}: index {part} is out of range (entries: {len(value)})") from None
            continue
        names = [name for name, _ in _fields(value)] if dataclasses.is_dataclass(value) else []
        if part not in names:
            raise AttributeError(f"no field {part!r} in {path!r} (fields: {', '.join(names) or 'none'})")
        value = getattr(value, part)
    return value


def _fields(message: Any) -> list[tuple[str, Any]]:
    return [(f.name, getattr(message, f.name)) for f in dataclasses.fields(message) if not f.name.startswith("__")]


def describe(value: Any, most: int | None = 12, indent: str = "") -> str:
    """Format a message, or a field of one, as indented lines.

    Args:
        value: the message or field.
        most: shorten arrays above this many values, and strings above ten times as many characters; None: never.
        indent: spaces before each line.
    """
    if dataclasses.is_dataclass(value):
        lines = []
        for name, inner in _fields(value):
            if dataclasses.is_dataclass(inner) or _is_nested(inner):
                lines += [f"{indent}{name}:", describe(inner, most, indent + "  ")]
            else:
                lines.append(f"{indent}{name}: {describe(inner, most)}")
        return "\n".join(lines)
    if _is_nested(value):
        return "\n".join(f"{indent}- {describe(entry, most, indent + '  ').lstrip()}" for entry in value)
    if isinstance(value, (np.ndarray, list)):
        if most is None or len(value) <= most:
            return f"{indent}[{', '.join(_scalar(entry, most) for entry in value)}]"
        head = ", ".join(_scalar(entry, most) for entry in value[: max(1, most // 2)])
        return f"{indent}[{head}, ... {len(value)} values]"
    return indent + _scalar(value, most)


def _is_nested(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and dataclasses.is_dataclass(value[0])


def _scalar(value: Any, most: int | None) -> str:
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return f"{value:.9g}"
    if not isinstance(value, str):
        return str(value)
    if most is None or len(value) <= 10 * most:
        return repr(value)
    return f"{value[: 10 * most]!r}... {len(value)} characters"


def json_line(value: Any) -> str:
    """Return a message, or a field of one, as one line of JSON with every value."""
    return json.dumps(_plain(value), ensure_ascii=False)


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return {name: _plain(inner) for name, inner in _fields(value)}
    if isinstance(value, list):
        return [_plain(entry) for entry in value]
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value
