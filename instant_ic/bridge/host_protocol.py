"""Messages between two bridges: one kind byte and a body; JSON for rare messages, fixed fields for frequent ones.

A topic's message is sent in chunks, so that a command never waits for the end of an image.
"""

from __future__ import annotations

import json
import struct
from dataclasses import asdict, dataclass, field, fields
from typing import Any, ClassVar, Self, get_origin, get_type_hints

VERSION = 1
"""Protocol version, compared in the handshake. Increase it with every incompatible change."""

MAX_CHUNK = 64 * 1024
MAX_JSON = 64 * 1024
MAX_FRAME = MAX_CHUNK + 1024
"""Largest frame; the socket disconnects a host that sends more."""

LANES = ("command", "state", "bulk")
"""Priority classes on the link; a later lane never delays an earlier one."""

_DATA = struct.Struct("<BBHIIQqqq")


class HostProtocolError(ValueError):
    """Bytes that violate this protocol."""


class _Json:
    """A message with a JSON object as body, which has exactly the fields of the class."""

    KIND: ClassVar[int]

    def encode(self) -> bytes:
        body = json.dumps(asdict(self), separators=(",", ":")).encode()  # type: ignore[call-overload]
        if len(body) > MAX_JSON:
            raise HostProtocolError(f"{type(self).__name__} of {len(body)} bytes is longer than {MAX_JSON}")
        return bytes([self.KIND]) + body

    @classmethod
    def decode(cls, data: memoryview) -> Self:
        try:
            content = json.loads(bytes(data[1:]))
        except (ValueError, RecursionError) as error:
            raise HostProtocolError(f"{cls.__name__}: not JSON: {error}") from None
        hints = get_type_hints(cls)
        names = [f.name for f in fields(cls)]  # type: ignore[arg-type]
        if isinstance(content, dict) and "version" in names and content.get("version") != VERSION:
            # Another version may greet with other fields; the reply needs only the known ones.
            content = {name: content.get(name) for name in names}
            kinds = {name: get_origin(hints[name]) or hints[name] for name in names}
            content = {n: value if isinstance(value, kinds[n]) else kinds[n]() for n, value in content.items()}
        if not isinstance(content, dict) or set(content) != set(names):
            raise HostProtocolError(f"{cls.__name__}: expected the fields {', '.join(names)}")
        for name in names:
            kind = get_origin(hints[name]) or hints[name]
            value = content[name]
            if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
                raise HostProtocolError(f"{cls.__name__}: {name} must be {kind.__name__} (got {value!r:.60})")
        return cls(**content)


@dataclass(frozen=True)
class Greeting(_Json):
    """First message of a host.

    Attributes:
        version: :data:`VERSION`.
        name: the host's own name.
        instance: new with every start of the bridge.
        wants: topic → most messages per second that this host takes from the other (0: all).
    """

    version: int
    name: str
    instance: str
    wants: dict[str, Any]


class Hello(Greeting):
    """Greeting of the host that connects; the answer is :class:`Welcome` or :class:`Bye`."""

    KIND: ClassVar[int] = 1


class Welcome(Greeting):
    """Answer to :class:`Hello`."""

    KIND: ClassVar[int] = 2


@dataclass(frozen=True)
class Bye(_Json):
    """Last message of a link.

    Attributes:
        code: version, revoked, replaced, unknown, protocol or closing.
        reason: text for the other host's user.
    """

    KIND: ClassVar[int] = 3
    code: str
    reason: str


@dataclass(frozen=True)
class Announce(_Json):
    """Announces one publisher's topic.

    Attributes:
        channel: number that identifies the topic in :class:`Data`.
        topic: name without the sender's namespace.
        origin: node that publishes it on the sending host.
        type_name: message type.
        digest: hash of the type's name and fields (ROS 2's RIHS01).
        qos: name of the preset.
    """

    KIND: ClassVar[int] = 4
    channel: int
    topic: str
    origin: str
    type_name: str
    digest: str
    qos: str


@dataclass(frozen=True)
class Refuse(_Json):
    """Refuses an announced topic.

    Attributes:
        channel: channel of the announcement.
        reason: text for the other host's user.
    """

    KIND: ClassVar[int] = 5
    channel: int
    reason: str


@dataclass(frozen=True)
class HostNotice(_Json):
    """Information for the other host's user; an empty text withdraws it.

    Attributes:
        name: subject.
    """

    KIND: ClassVar[int] = 6
    name: str
    text: str


class _Fixed:
    """A message of numbers, in the order of the class's fields; ``FORM`` begins with the kind."""

    KIND: ClassVar[int]
    FORM: ClassVar[struct.Struct]

    def encode(self) -> bytes:
        return self.FORM.pack(self.KIND, *vars(self).values())

    @classmethod
    def decode(cls, data: memoryview) -> Self:
        return cls(*cls._numbers(data))

    @classmethod
    def _numbers(cls, data: memoryview) -> tuple[int, ...]:
        if len(data) != cls.FORM.size:
            raise HostProtocolError(f"message of kind {data[0]} has {len(data)} bytes, {cls.FORM.size} expected")
        return cls.FORM.unpack(data)[1:]


@dataclass(frozen=True)
class Ping(_Fixed):
    """Heartbeat and time request.

    Attributes:
        number: increases by one, modulo 2^32.
        mono_ns: the sender's monotonic clock.
        epoch_ns: time of day at which that clock was zero.
    """

    KIND: ClassVar[int] = 16
    FORM: ClassVar[struct.Struct] = struct.Struct("<BIqq")
    number: int
    mono_ns: int
    epoch_ns: int


@dataclass(frozen=True)
class Pong(_Fixed):
    """Answer to a ping: its number and ``mono_ns``, and the answering host's clock at arrival and departure."""

    KIND: ClassVar[int] = 17
    FORM: ClassVar[struct.Struct] = struct.Struct("<BIqqqq")
    number: int
    echo_ns: int
    arrived_ns: int
    mono_ns: int
    epoch_ns: int


@dataclass(frozen=True)
class Ack(_Fixed):
    """Bytes received so far in each lane since the session began.

    Attributes:
        echo_ns: ``sent_ns`` of the newest chunk received.
        taken: bytes by lane, in the order of :data:`LANES`.
    """

    KIND: ClassVar[int] = 18
    FORM: ClassVar[struct.Struct] = struct.Struct("<Bq3Q")
    echo_ns: int
    taken: tuple[int, ...]

    def encode(self) -> bytes:
        return self.FORM.pack(self.KIND, self.echo_ns, *self.taken)

    @classmethod
    def decode(cls, data: memoryview) -> Self:
        echo_ns, *taken = cls._numbers(data)
        return cls(echo_ns, tuple(taken))


@dataclass(frozen=True)
class Data:
    """A chunk of a topic's message.

    Attributes:
        channel: see :class:`Announce`.
        sequence: number of the message, from 1; a gap is a loss.
        publish_ns: time of the first publication.
        born_ns: the same time by the sending host's monotonic clock.
        sent_ns: time at which this chunk leaves, by the same clock.
        total: bytes of the message.
        offset: position of this chunk in the message.
        lane: the sender's lane, as an index of :data:`LANES`; the messages of a lane do not overlap.
        wall_time: whether ``publish_ns`` is the machine's time of day (a simulated clock is the same on both hosts).
    """

    KIND: ClassVar[int] = 19
    channel: int
    sequence: int
    publish_ns: int
    born_ns: int
    sent_ns: int
    total: int
    offset: int
    chunk: bytes | memoryview = field(repr=False)
    lane: int = 0
    wall_time: bool = True

    def encode(self) -> bytes:
        head = (self.KIND, self.lane << 1 | self.wall_time, self.channel, self.total, self.offset, self.sequence)
        return _DATA.pack(*head, self.publish_ns, self.born_ns, self.sent_ns) + self.chunk

    @classmethod
    def decode(cls, data: memoryview) -> Data:
        if len(data) < _DATA.size:
            raise HostProtocolError(f"Data of {len(data)} bytes is too short")
        _, flags, channel, total, offset, sequence, publish, born, sent = _DATA.unpack(data[: _DATA.size])
        chunk = data[_DATA.size :]
        if len(chunk) > MAX_CHUNK or offset + len(chunk) > total or (len(chunk) == 0 and total > 0):
            raise HostProtocolError(f"Data: {len(chunk)} bytes at {offset} of {total} are impossible")
        if flags >> 1 >= len(LANES):
            raise HostProtocolError(f"Data: unknown lane {flags >> 1}")
        return cls(channel, sequence, publish, born, sent, total, offset, chunk, flags >> 1, bool(flags & 1))


Message = Hello | Welcome | Bye | Announce | Refuse | HostNotice | Ping | Pong | Ack | Data

_KINDS: dict[int, Any] = {
    kind.KIND: kind for kind in (Hello, Welcome, Bye, Announce, Refuse, HostNotice, Ping, Pong, Ack, Data)
}
DATA_OVERHEAD = _DATA.size


def decode(data: bytes | memoryview) -> Message:
    """Decode a message; the chunk of a ``Data`` is a view of ``data``.

    Raises:
        HostProtocolError: the bytes are not a message.
    """
    view = memoryview(data)
    kind = _KINDS.get(view[0]) if len(view) else None
    if kind is None:
        raise HostProtocolError(f"unknown message ({bytes(view[:8]).hex() or 'empty'})")
    message: Message = kind.decode(view)
    return message
