"""Messages as text: for people YAML with shortened arrays, for programs a line of JSON."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import numpy as np
import yaml


def field(message: Any, path: str) -> Any:
    """Return a field by its dotted path. An index selects an entry of a list (``transforms.0.transform``).

    Raises:
        AttributeError: the field does not exist; the message lists the existing ones.
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


class _MessageDumper(getattr(yaml, "CSafeDumper", yaml.SafeDumper)):  # type: ignore[misc]
    """A YAML dumper that writes lists of plain values on one line."""

    def represent_sequence(self, tag: str, sequence: Any, flow_style: bool | None = None) -> Any:
        return super().represent_sequence(tag, sequence, not any(isinstance(entry, dict) for entry in sequence))


def describe(value: Any, most: int | None = 12) -> str:
    """Return a message, or a field of one, as YAML.

    Args:
        value: the message or field.
        most: number of values above which arrays are shortened; for strings, ten times as many characters; None: never.
    """
    style: dict[str, Any] = {"default_flow_style": False, "sort_keys": False, "allow_unicode": True, "width": 1 << 20}
    text = str(yaml.dump(_shortened(value, most), Dumper=_MessageDumper, **style))
    return text.removesuffix("...\n").rstrip("\n")


def _shortened(value: Any, most: int | None) -> Any:
    if dataclasses.is_dataclass(value):
        return {name: _shortened(inner, most) for name, inner in _fields(value)}
    if isinstance(value, (np.ndarray, list)):
        whole = most is None or len(value) <= most
        head = [_shortened(entry, most) for entry in (value if whole else value[: max(1, (most or 0) // 2)])]
        return head if whole else [*head, f"... {len(value)} values"]
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, float):
        return float(f"{value:.9g}")
    if most is not None and isinstance(value, str) and len(value) > 10 * most:
        return f"{value[: 10 * most]}... {len(value)} characters"
    return value


def json_line(value: Any) -> str:
    """Return a message, or a field of one, as one line of JSON with all values."""
    return json.dumps(_plain(value), ensure_ascii=False)


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return {name: _plain(inner) for name, inner in _fields(value)}
    if isinstance(value, list):
        return [_plain(entry) for entry in value]
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value
