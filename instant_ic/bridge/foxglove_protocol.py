"""Frames of Foxglove's WebSocket protocol (foxglove/ws-protocol, docs/spec.md); no socket, no bus."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from typing import Any

SUBPROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")
"""Names of the protocol since foxglove-sdk 0.14, and before it. The messages used here are the same in both."""

WARNING, ERROR = 1, 2
"""Levels of a status message."""

_MESSAGE_DATA = struct.Struct("<BIQ")
_MAX_NUMBER = (1 << 32) - 1


class FoxgloveProtocolError(ValueError):
    """A client's frame violates the protocol; the message says how."""


def text(op: str, **content: Any) -> str:
    """Return a text message for a client."""
    return json.dumps({"op": op, **content}, separators=(",", ":"), allow_nan=False)


def status(level: int, message: str) -> str:
    """Return an entry of a client's list of problems."""
    return text("status", level=level, message=message[:1000])


def message_data(subscription: int, log_ns: int, payload: bytes | memoryview) -> bytes:
    """Return a channel's message for one subscription."""
    return _MESSAGE_DATA.pack(1, subscription, log_ns) + payload


def parameter_values(values: Mapping[str, Any], request: str) -> str:
    """Return the answer to a request for parameters. Infinity and NaN become text because JSON lacks them."""
    values = json.loads(json.dumps(values), parse_constant=str)
    entries = [{"name": name, "value": value} for name, value in values.items() if value is not None]
    return text("parameterValues", parameters=entries, id=request)


def parse(data: str) -> tuple[str, list[Any], str]:
    """Parse a client's text message.

    Returns:
        The message's op, arguments and request id. The arguments are pairs (subscription, channel) for ``subscribe``,
        subscriptions for ``unsubscribe`` and names for ``getParameters``; other messages have none.

    Raises:
        FoxgloveProtocolError: the message or one of its fields is malformed.
    """
    try:
        content = json.loads(data)
        op, request = str(content["op"]), str(content.get("id", ""))
        arguments: list[Any] = []
        if op == "subscribe":
            arguments = [(_number(each["id"]), _number(each["channelId"])) for each in content["subscriptions"]]
        elif op == "unsubscribe":
            arguments = [_number(each) for each in content["subscriptionIds"]]
        elif op == "getParameters":
            arguments = [str(each) for each in content["parameterNames"]]
    except (LookupError, TypeError, ValueError, RecursionError) as error:
        raise FoxgloveProtocolError(f"Invalid message: {type(error).__name__}: {error}") from None
    return op, arguments, request


def _number(value: Any) -> int:
    """Return the number of a channel or subscription."""
    if type(value) is not int or not 0 <= value <= _MAX_NUMBER:
        raise ValueError(f"{value!r:.40} is not a 32-bit number")
    return value
