"""Encodes and decodes Foxglove's WebSocket protocol (foxglove/ws-protocol, docs/spec.md); no socket, no bus."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

SUBPROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")
"""Names of the protocol: since foxglove-sdk 0.14, and earlier. The messages used here are the same in both."""

INFO, WARNING, ERROR = range(3)
"""Levels of a status message."""

_Names = Mapping[str, Sequence[str]]

_MESSAGE_DATA = struct.Struct("<BIQ")
_CLIENT_DATA = struct.Struct("<BI")
_TIME = struct.Struct("<BQ")
_MAX_NUMBER = (1 << 32) - 1


class ProtocolError(ValueError):
    """A client's frame violates the protocol; the message says how."""


@dataclass(frozen=True)
class ClientChannel:
    """A channel that a client wants to publish on."""

    id: int
    topic: str
    encoding: str
    schema_name: str


# -- server to client ----------------------------------------------------------------------------------


def text(op: str, **content: Any) -> str:
    """Return a text message; fields that are None are omitted."""
    fields = {key: value for key, value in content.items() if value is not None}
    return json.dumps({"op": op, **fields}, separators=(",", ":"), allow_nan=False)


def message_data(subscription: int, log_ns: int, payload: bytes | memoryview) -> bytes:
    """Return a channel's message for one subscription."""
    return _MESSAGE_DATA.pack(1, subscription, log_ns) + payload


def time_data(now_ns: int) -> bytes:
    return _TIME.pack(2, now_ns)


def parameters(values: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return parameters in the protocol's form; those without a value are omitted."""
    found = []
    for name, value in values.items():
        if value is None:
            continue
        entry: dict[str, Any] = {"name": name, "value": _finite(value)}
        if isinstance(value, float):
            entry["type"] = "float64"
        elif isinstance(value, (list, tuple)) and all(isinstance(item, float) for item in value):
            entry["type"] = "float64_array"
        if entry["value"] != value:  # converted to text
            entry.pop("type", None)
        found.append(entry)
    return found


def _finite(value: Any) -> Any:
    """Return a value that JSON can carry: infinity and NaN become text."""
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    return value


def graph_update(before: Graph, now: Graph) -> str | None:
    """Return the difference of two connection graphs; None if they are equal."""
    removed = sorted(before.topics - now.topics)
    published = _changed(before.published, now.published, removed)
    subscribed = _changed(before.subscribed, now.subscribed, removed)
    if not (published or subscribed or removed):
        return None
    return _graph_text(published, subscribed, removed)


def _changed(before: _Names, now: _Names, removed: Sequence[str]) -> _Names:
    """Return the topics whose names changed, except removed topics."""
    return {
        topic: now.get(topic, ())
        for topic in {*before, *now}
        if now.get(topic) != before.get(topic) and topic not in removed
    }


@dataclass(frozen=True)
class Graph:
    """Publishers and subscribers by topic."""

    published: _Names
    subscribed: _Names

    @property
    def topics(self) -> set[str]:
        return {*self.published, *self.subscribed}

    def encode(self) -> str:
        """Return the whole graph as a message for a new subscriber."""
        return _graph_text(self.published, self.subscribed, [])


def _graph_text(published: _Names, subscribed: _Names, removed: Sequence[str]) -> str:
    return text(
        "connectionGraphUpdate",
        publishedTopics=[{"name": name, "publisherIds": list(ids)} for name, ids in sorted(published.items())],
        subscribedTopics=[{"name": name, "subscriberIds": list(ids)} for name, ids in sorted(subscribed.items())],
        advertisedServices=[],
        removedTopics=list(removed),
        removedServices=[],
    )


# -- client to server: each function raises ProtocolError for a frame or field of another form ----------


def parse_text(data: str) -> dict[str, Any]:
    """Parse a client's text message: a JSON object with a text field ``op``."""
    try:
        content = json.loads(data, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise ProtocolError(f"not JSON: {error}") from None
    if not isinstance(content, dict) or not isinstance(content.get("op"), str):
        raise ProtocolError("not a JSON object with an op")
    return content


def _no_constant(name: str) -> Any:
    raise ValueError(f"{name} is not a number")


def parse_data(data: bytes) -> tuple[int, bytes]:
    """Return channel and payload of a client's message."""
    if len(data) < _CLIENT_DATA.size or data[0] != 1:
        raise ProtocolError(f"unknown binary message ({data[:1].hex() or 'empty'}, {len(data)} bytes)")
    return int(_CLIENT_DATA.unpack_from(data)[1]), data[_CLIENT_DATA.size :]


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
        raise ProtocolError(f"{content.get('op')}: {key} must be a list of {what}")
    return value


def number(content: Mapping[str, Any], key: str) -> int:
    """Return a field that must be a 32-bit number."""
    value = content.get(key)
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= _MAX_NUMBER:
        raise ProtocolError(f"{key} must be a 32-bit number (got {value!r:.40})")
    return value


def client_channel(content: Mapping[str, Any]) -> ClientChannel:
    """Parse one entry of a client's ``advertise``."""
    fields = [content.get(key) for key in ("topic", "encoding", "schemaName")]
    if not all(isinstance(field, str) for field in fields):
        raise ProtocolError("advertise: topic, encoding and schemaName must be strings")
    return ClientChannel(number(content, "id"), *(str(field) for field in fields))
