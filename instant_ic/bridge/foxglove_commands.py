"""Commands from Foxglove clients."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any

from instant_ic.bridge.commands import DRIVE, STOP
from instant_ic.bridge.foxglove_protocol import ClientChannel
from instant_ic.bus import ERROR, LATCHED, OK, SENSOR, Node, Publisher
from instant_ic.control.command_gate import CommandGate
from instant_ic.control.robot_lease import RELEASED, Refusal
from instant_ic.msg import MessageError, deserialize, message_type, stamp_ns, twist_stamped, twist_values

_COMMAND_TYPES = {DRIVE: ("TwistStamped", "Twist"), STOP: ("Bool",)}


class Commands:
    """Checks the commands of clients and publishes them as the console does. Called on the server's thread.

    Args:
        node: publishes the commands.
        gate: checks them.
        notify: called with a client's number, a text for that client, and its level.
    """

    def __init__(self, node: Node[Any], gate: CommandGate, notify: Callable[[int, str, int], None]) -> None:
        self._node = node
        self._gate = gate
        self._notify = notify
        self._channels: dict[tuple[int, int], ClientChannel] = {}
        self._told: dict[int, str] = {}
        self._drive: Publisher = node.publisher(DRIVE, message_type("TwistStamped"), SENSOR)
        self._stop: Publisher = node.publisher(STOP, message_type("Bool"), LATCHED)

    def advertised(self, client: int, channel: ClientChannel) -> None:
        kinds = _COMMAND_TYPES.get(channel.topic)
        name = channel.schema_name.rsplit("/", 1)[-1]
        if kinds is None or name not in kinds or channel.encoding not in ("cdr", "json"):
            known = "; ".join(f"{topic} ({' or '.join(names)})" for topic, names in _COMMAND_TYPES.items())
            what = f"{channel.topic:.100} {channel.schema_name:.100} {channel.encoding:.20}"
            self._notify(client, f"{what} is not accepted; only {known}, cdr or json", ERROR)
            return
        self._channels[client, channel.id] = channel

    def unadvertised(self, client: int, channel_id: int) -> None:
        """Handle a client's ``unadvertise``. If the client drove, stop the robot immediately."""
        channel = self._channels.pop((client, channel_id), None)
        lease = self._gate.lease
        if channel is not None and channel.topic == DRIVE and lease is not None and lease.release(_name(client)):
            self._drive.publish(twist_stamped(0.0, 0.0, self._node.clock.now_ns(), _name(client) + RELEASED))

    def left(self, client: int) -> None:
        """Release the channels of a disconnected client."""
        for number, channel_id in [key for key in self._channels if key[0] == client]:
            self.unadvertised(number, channel_id)
        self._told.pop(client, None)

    def message(self, client: int, channel_id: int, data: bytes) -> None:
        channel = self._channels.get((client, channel_id))
        if channel is None:  # reported when it was advertised
            return
        try:
            if channel.topic == STOP:
                refusal = self._stop_by(client, channel.encoding, data)
            else:
                refusal = self._drive_by(client, channel.schema_name.rsplit("/", 1)[-1], channel.encoding, data)
            if refusal is not None:
                self._refused(client, f"command refused: {refusal.text}")
        except (MessageError, AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:  # any JSON
            self._refused(client, f"command refused: {channel.topic}: {type(error).__name__}: {error}")

    def _stop_by(self, client: int, encoding: str, data: bytes) -> Refusal | None:
        value = _json(data)["data"] if encoding == "json" else deserialize(data, "Bool").data
        if not isinstance(value, bool):
            raise MessageError(f"data must be true or false (got {value!r})")
        refusal = None if value else self._gate.admit_release(_name(client), 0.0, time.monotonic_ns())
        if refusal is not None:
            return refusal
        self._stop.publish(message_type("Bool")(value))
        return None

    def _drive_by(self, client: int, name: str, encoding: str, data: bytes) -> Refusal | None:
        now_ns = self._node.clock.now_ns()
        sent_ns = 0
        if encoding == "cdr":
            message = deserialize(data, name)
            v, w = twist_values(message)
            sent_ns = stamp_ns(message) if name == "TwistStamped" else 0
        else:
            content = _json(data)
            twist = content["twist"] if name == "TwistStamped" else content
            v, w = float(twist["linear"]["x"]), float(twist["angular"]["z"])
            stamp = content.get("header", {}).get("stamp", {})
            sent_ns = int(stamp.get("sec", 0)) * 1_000_000_000 + int(stamp.get("nanosec", stamp.get("nsec", 0)))
        # Foxglove's Teleop panel has no clock and sends no stamp: the time of arrival counts
        age_s = (now_ns - sent_ns) / 1e9 if sent_ns else 0.0
        if (refusal := self._gate.admit(v, w, age_s, _name(client), time.monotonic_ns())) is not None:
            return refusal
        self._drive.publish(twist_stamped(v, w, sent_ns or now_ns, _name(client)))
        if self._told.pop(client, None) is not None:
            self._node.call_soon(self._node.diagnose, "commands", OK, "commands are accepted")
        return None

    def _refused(self, client: int, words: str) -> None:
        """Send a refusal to the client, once until its text changes."""
        words = words[:300]
        if self._told.get(client) == words:
            return
        self._told[client] = words
        self._notify(client, words, ERROR)
        self._node.call_soon(self._node.diagnose, "commands", ERROR, words)


def _name(client: int) -> str:
    return f"client {client}"


def _json(data: bytes) -> dict[str, Any]:
    try:
        content = json.loads(data)
    except RecursionError:
        raise MessageError("JSON nested too deeply") from None
    if not isinstance(content, dict):
        raise MessageError("not a JSON object")
    return content
