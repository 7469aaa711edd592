"""Messages as text: YAML-like with long arrays shortened for people, a line of CSV or JSON for programs."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Style:
    """How much of a message is shown.

    Attributes:
        full: show long arrays and strings in full.
        length: shorten arrays above this many values, and strings above ten times as many characters.
        arrays: show the values of arrays.
        strings: show strings.
    """

    full: bool = False
    length: int = 12
    arrays: bool = True
    strings: bool = True


def field(message: Any, path: str) -> Any:
    """Field by dotted path; an index selects an entry of a list or array (``transforms.0.transform``).

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


def describe(value: Any, style: Style | None = None, indent: str = "") -> str:
    """Format a message, or a field of one, as indented lines."""
    style = style or Style()
    if dataclasses.is_dataclass(value):
        lines = []
        for name, inner in _fields(value):
            if dataclasses.is_dataclass(inner) or (isinstance(inner, list) and inner and _nested(inner)):
                lines.append(f"{indent}{name}:")
                lines.append(describe(inner, style, indent + "  "))
            else:
                lines.append(f"{indent}{name}: {describe(inner, style)}")
        return "\n".join(lines)
    if isinstance(value, list) and value and _nested(value):
        return "\n".join(f"{indent}- {describe(entry, style, indent + '  ').lstrip()}" for entry in value)
    if isinstance(value, (np.ndarray, list)):
        return indent + _array(value, style)
    return indent + _scalar(value, style)


def _nested(values: list[Any]) -> bool:
    return dataclasses.is_dataclass(values[0])


def _array(values: Any, style: Style) -> str:
    if not style.arrays:
        return f"<{len(values)} values>"
    if style.full or len(values) <= style.length:
        return "[" + ", ".join(_scalar(v, style) for v in values) + "]"
    head = ", ".join(_scalar(v, style) for v in values[: max(1, style.length // 2)])
    return f"[{head}, ... {len(values)} values]"


def _scalar(value: Any, style: Style) -> str:
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return f"{value:.9g}"
    if not isinstance(value, str):
        return str(value)
    if not style.strings:
        return f"<{len(value)} characters>"
    most = 10 * style.length
    return repr(value) if style.full or len(value) <= most else f"{value[:most]!r}... {len(value)} characters"


def json_line(value: Any) -> str:
    """A message, or a field of one, as one line of JSON with every value."""
    return json.dumps(_plain(value), ensure_ascii=False)


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return {name: _plain(inner) for name, inner in _fields(value)}
    if isinstance(value, list):
        return [_plain(entry) for entry in value]
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value


def csv_line(value: Any, style: Style | None = None) -> str:
    """All values of a message, or of a field of one, in the order of its definition, separated by commas."""
    import csv
    import io

    out = io.StringIO()
    csv.writer(out, lineterminator="").writerow(_cells(value, style or Style()))
    return out.getvalue()


def _cells(value: Any, style: Style) -> Iterator[str]:
    if dataclasses.is_dataclass(value):
        for _, inner in _fields(value):
            yield from _cells(inner, style)
    elif isinstance(value, (list, np.ndarray)):
        for entry in value if style.arrays else ():
            yield from _cells(entry, style)
    elif isinstance(value, str):
        if style.strings:
            yield value
    else:
        yield _scalar(value, style)
