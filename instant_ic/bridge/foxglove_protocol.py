"""Frames of Foxglove's WebSocket protocol (foxglove/ws-protocol, docs/spec.md); no socket, no bus."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping
from typing import Any

SUBPROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")
"""Names of the protocol: since foxglove-sdk 0.14, and earlier. The messages used here are the same in both."""

WARNING, ERROR = 1, 2
"""Levels of a status message."""

_MESSAGE_DATA = struct.Struct("<BIQ")
_MAX_NUMBER = (1 << 32) - 1


class FoxgloveProtocolError(ValueError):
    """A client's frame violates the protocol; the message says how."""


# -- server to client ----------------------------------------------------------------------------------


def text(op: str, **content: Any) -> str:
    """Return a text message; fields that are None are omitted."""
    fields = {key: value for key, value in content.items() if value is not None}
    return json.dumps({"op": op, **fields}, separators=(",", ":"), allow_nan=False)


def status(level: int, message: str) -> str:
    """Return an entry of a client's list of problems."""
    return text("status", level=level, message=message[:1000])


def message_data(subscription: int, log_ns: int, payload: bytes | memoryview) -> bytes:
    """Return a channel's message for one subscription."""
    return _MESSAGE_DATA.pack(1, subscription, log_ns) + payload


def parameters(values: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return parameters in the protocol's form; those without a value are omitted."""
    found = []
    for name, value in values.items():
        if value is None:
            continue
        entry: dict[str, Any] = {"name": name, "value": _finite(value)}
        if entry["value"] == value:  # else converted to text
            if isinstance(value, float):
                entry["type"] = "float64"
            elif isinstance(value, (list, tuple)) and all(isinstance(item, float) for item in value):
                entry["type"] = "float64_array"
        found.append(entry)
    return found


def _finite(value: Any) -> Any:
    """Return a value that JSON can carry: infinity and NaN become text."""
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    return value


# -- client to server: each function raises FoxgloveProtocolError for a frame or field of another form ---


def parse_text(data: str) -> dict[str, Any]:
    """Parse a client's text message: a JSON object with a text field ``op``."""
    try:
        content = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise FoxgloveProtocolError(f"not JSON: {error}") from None
    if not isinstance(content, dict) or not isinstance(content.get("op"), str):
        raise FoxgloveProtocolError("not a JSON object with an op")
    return content


def objects(content: Mapping[str, Any], key: str) -> list[dict[str, Any]]:
    """Return a field that must be a list of objects."""
    return _listed(content, key, dict, "objects")


def strings(content: Mapping[str, Any], key: str) -> list[str]:
    """Return a field that must be a list of strings."""
    return _listed(content, key, str, "strings")


def numbers(content: Mapping[str, Any], key: str) -> list[int]:
    """Return a field that must be a list of channel or subscription numbers."""
    return [number({key: item}, key) for item in _listed(content, key, object, "numbers")]


def _listed(content: Mapping[str, Any], key: str, kind: type, what: str) -> list[Any]:
    value = content.get(key)
    if not isinstance(value, list) or not all(isinstance(item, kind) for item in value):
        raise FoxgloveProtocolError(f"{content.get('op')}: {key} must be a list of {what}")
    return value


def number(content: Mapping[str, Any], key: str) -> int:
    """Return a field that must be a 32-bit number."""
    value = content.get(key)
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= _MAX_NUMBER:
        raise FoxgloveProtocolError(f"{key} must be a 32-bit number (got {value!r:.40})")
    return value
