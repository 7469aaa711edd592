"""Rules for topics on the link (rate, lane, age), and the counts of their messages."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, fields

from instant_ic.bridge.host_protocol import LANES
from instant_ic.msg import MessageError, deserialize, twist_values

_COMMANDS = ("geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped")
_TOPIC = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+\Z")


def releases(type_name: str, payload: bytes | bytearray) -> bool:
    """Return whether a message on a shared state releases the emergency stop."""
    try:
        return type_name == "std_msgs/msg/Bool" and not deserialize(payload, type_name).data
    except MessageError:  # not a readable message; the subscriber refuses and reports it
        return False


def moves(type_name: str, payload: bytes | bytearray) -> bool:
    """Return whether a message is a command to move."""
    try:
        return type_name in _COMMANDS and any(twist_values(deserialize(payload, type_name)))
    except MessageError:
        return False


@dataclass(frozen=True)
class TopicRule:
    """Rate, lane and age limit of one topic on the link; written as ``/scan rate_hz=5 lane=state``.

    Attributes:
        topic: name of the topic, without namespace.
        rate_hz: most messages per second, keeping the newest; 0 sends all.
        lane: priority class, one of :data:`~.host_protocol.LANES`.
        max_age_s: messages older than this since publication are dropped and counted, on either side; 0 keeps all.
        shared: accept the topic from every driver's host, not only from the one that drives. A false Bool, which
            releases an emergency stop, is accepted from the driving host only.
    """

    topic: str
    rate_hz: float = 0.0
    lane: str = "state"
    max_age_s: float = 0.0
    shared: bool = False

    def __post_init__(self) -> None:
        if not _TOPIC.match(self.topic):
            raise ValueError(f"{self.topic!r} is not a topic: it must look like /camera/image")
        if self.lane not in LANES:
            raise ValueError(f"{self.topic}: lane must be {', '.join(LANES)} (got {self.lane!r})")
        for key in ("rate_hz", "max_age_s"):
            value = getattr(self, key)
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(f"{self.topic}: {key} must be >= 0 (got {value})")

    @classmethod
    def parse(cls, text: str) -> TopicRule:
        """Parse the rule in one line.

        Raises:
            ValueError: the line is wrong; the message says how.
        """
        words = text.split()
        if not words:
            raise ValueError("an empty line is not a topic")
        kinds = {f.name: f.type for f in fields(cls) if f.name != "topic"}
        values: dict[str, object] = {}
        for word in words[1:]:
            key, separator, value = word.partition("=")
            if not separator or key not in kinds or key in values:
                raise ValueError(f"{words[0]}: {word!r} is not one of {', '.join(f'{k}=' for k in kinds)}, once each")
            try:
                values[key] = _READERS[str(kinds[key])](value)
            except ValueError:
                raise ValueError(f"{words[0]}: {key} must be {kinds[key]} (got {value!r})") from None
        return cls(words[0], **values)  # type: ignore[arg-type]


def _bool(text: str) -> bool:
    if text not in ("true", "false"):
        raise ValueError(text)
    return text == "true"


_READERS: dict[str, Callable[[str], object]] = {"float": float, "str": str, "bool": _bool}


def parse_rules(lines: tuple[str, ...]) -> dict[str, TopicRule]:
    """Parse rules; return them by topic.

    Raises:
        ValueError: a line is wrong, or a topic is listed twice.
    """
    rules: dict[str, TopicRule] = {}
    for line in lines:
        rule = TopicRule.parse(line)
        if rule.topic in rules:
            raise ValueError(f"{rule.topic} is listed twice")
        rules[rule.topic] = rule
    return rules


@dataclass
class TopicCounts:
    """Counts of a topic's messages in one direction of one link.

    Attributes:
        messages, bytes: sent, or received and passed on.
        thinned: dropped by the rate limit, as configured.
        superseded: replaced by a newer message before the link had room: the link is too slow for the rate.
        expired: older than ``max_age_s``.
        overflowed: dropped from the full queue of a reliable topic.
        lost: gaps in the sequence, on the receiving side.
        not_driving: from a host that does not drive, or whose operator must let go of the controls first.
    """

    messages: int = 0
    bytes: int = 0
    thinned: int = 0
    superseded: int = 0
    expired: int = 0
    overflowed: int = 0
    lost: int = 0
    not_driving: int = 0

    @property
    def bad(self) -> int:
        """Messages whose loss may matter; thinning is configured, and a newer image replaces an older one."""
        return self.expired + self.overflowed + self.lost

    def add(self, other: TopicCounts) -> None:
        for each in fields(self):
            setattr(self, each.name, getattr(self, each.name) + getattr(other, each.name))
