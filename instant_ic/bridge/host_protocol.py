"""Messages between two bridges: one kind byte and a body; JSON where it is rare, fixed fields where it is often.

A message of a topic travels in chunks, so that a command never waits for the end of a picture.
"""

from __future__ import annotations

import json
import struct
from dataclasses import asdict, dataclass, field, fields
from typing import Any, ClassVar, TypeVar, get_origin, get_type_hints

VERSION = 1
"""Grows with every change that an older bridge would misunderstand; the handshake compares it."""

MAX_CHUNK = 64 * 1024
MAX_JSON = 64 * 1024
MAX_FRAME = MAX_CHUNK + 1024
"""No frame is longer; the socket drops who sends one."""

LANES = ("command", "state", "bulk")
"""Ways through the link by rank: a later one never holds up an earlier one."""

_DATA = struct.Struct("<BBHIIQqqq")
_PING = struct.Struct("<BIqq")
_PONG = struct.Struct("<BIqqqq")
_ACK = struct.Struct("<Bq3Q")


class ProtocolError(ValueError):
    """Bytes that this protocol does not know."""


class _Json:
    """A message whose body is a JSON object with exactly its fields."""

    KIND: ClassVar[int]

    def encode(self) -> bytes:
        """Bytes of the message."""
        body = json.dumps(asdict(self), separators=(",", ":")).encode()  # type: ignore[call-overload]
        if len(body) > MAX_JSON:
            raise ProtocolError(f"{type(self).__name__} of {len(body)} bytes is longer than {MAX_JSON}")
        return bytes([self.KIND]) + body

    @classmethod
    def decode(cls, data: memoryview) -> Any:
        """The message of these bytes."""
        try:
            content = json.loads(bytes(data[1:]))
        except (ValueError, RecursionError) as error:
            raise ProtocolError(f"{cls.__name__}: not JSON: {error}") from None
        hints = get_type_hints(cls)
        names = [f.name for f in fields(cls)]  # type: ignore[arg-type]
        if isinstance(content, dict) and "version" in names and content.get("version") != VERSION:
            # Another version greets with other fields: only who it is matters, for the answer.
            content = {name: content.get(name) for name in names}
            kinds = {name: get_origin(hints[name]) or hints[name] for name in names}
            content = {n: value if isinstance(value, kinds[n]) else kinds[n]() for n, value in content.items()}
        if not isinstance(content, dict) or set(content) != set(names):
            raise ProtocolError(f"{cls.__name__}: expected the fields {', '.join(names)}")
        for name in names:
            kind = get_origin(hints[name]) or hints[name]
            value = content[name]
            if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
                raise ProtocolError(f"{cls.__name__}: {name} must be {kind.__name__} (got {value!r:.60})")
        return cls(**content)


@dataclass(frozen=True)
class Hello(_Json):
    """First word of the host that connects; the answer is :class:`Welcome` or :class:`Bye`.

    Attributes:
        version: :data:`VERSION`.
        name: what the host calls itself.
        instance: new with every start of the bridge.
        wants: topic → most messages a second that it takes (0: all), of what the other sends.
    """

    KIND: ClassVar[int] = 1
    version: int
    name: str
    instance: str
    wants: dict[str, Any]


@dataclass(frozen=True)
class Welcome(_Json):
    """Answer to :class:`Hello`; the fields are the same."""

    KIND: ClassVar[int] = 2
    version: int
    name: str
    instance: str
    wants: dict[str, Any]


@dataclass(frozen=True)
class Bye(_Json):
    """Last word: why the link ends.

    Attributes:
        code: version, revoked, replaced, unknown, protocol or closing.
        reason: in words, for the other's user.
    """

    KIND: ClassVar[int] = 3
    code: str
    reason: str


@dataclass(frozen=True)
class Announce(_Json):
    """A topic of one publisher is coming.

    Attributes:
        channel: number by which :class:`Data` names it.
        topic: without the sender's namespace.
        origin: node that publishes it there.
        type_name: message type.
        digest: of name and fields of the type (ROS 2's RIHS01).
        qos: preset's name.
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
    """An announced topic is not taken.

    Attributes:
        channel: of the announcement.
        reason: in words, for the other's user.
    """

    KIND: ClassVar[int] = 5
    channel: int
    reason: str


@dataclass(frozen=True)
class Notice(_Json):
    """Something that the other's user should know; empty when it is over.

    Attributes:
        name: what it is about.
        text: in words.
    """

    KIND: ClassVar[int] = 6
    name: str
    text: str


@dataclass(frozen=True)
class Ping:
    """Sign of life and question for the time.

    Attributes:
        number: grows by one.
        mono_ns: the sender's monotonic clock.
        epoch_ns: time of day at which that clock was zero.
    """

    KIND: ClassVar[int] = 16
    number: int
    mono_ns: int
    epoch_ns: int

    def encode(self) -> bytes:
        """Bytes of the message."""
        return _PING.pack(self.KIND, self.number & 0xFFFFFFFF, self.mono_ns, self.epoch_ns)

    @classmethod
    def decode(cls, data: memoryview) -> Ping:
        """The message of these bytes."""
        return cls(*_unpack(_PING, data)[1:])


@dataclass(frozen=True)
class Pong:
    """Answer to a ping: its number and ``mono_ns``, when it came, and when this leaves, by the answerer's clock."""

    KIND: ClassVar[int] = 17
    number: int
    echo_ns: int
    arrived_ns: int
    mono_ns: int
    epoch_ns: int

    def encode(self) -> bytes:
        """Bytes of the message."""
        number = self.number & 0xFFFFFFFF
        return _PONG.pack(self.KIND, number, self.echo_ns, self.arrived_ns, self.mono_ns, self.epoch_ns)

    @classmethod
    def decode(cls, data: memoryview) -> Pong:
        """The message of these bytes."""
        return cls(*_unpack(_PONG, data)[1:])


@dataclass(frozen=True)
class Ack:
    """What came so far: bytes of each lane since the session began.

    Attributes:
        echo_ns: ``sent_ns`` of the newest chunk that came.
        taken: bytes by lane, as :data:`LANES`.
    """

    KIND: ClassVar[int] = 18
    echo_ns: int
    taken: tuple[int, ...]

    def encode(self) -> bytes:
        """Bytes of the message."""
        return _ACK.pack(self.KIND, self.echo_ns, *self.taken)

    @classmethod
    def decode(cls, data: memoryview) -> Ack:
        """The message of these bytes."""
        _, echo_ns, *taken = _unpack(_ACK, data)
        return cls(echo_ns, tuple(taken))


@dataclass(frozen=True)
class Data:
    """A chunk of a topic's message.

    Attributes:
        channel: see :class:`Announce`.
        sequence: of the message, from 1; a gap is a loss.
        publish_ns: when it was published first.
        born_ns: the same by the sending host's monotonic clock.
        sent_ns: when this chunk leaves, by the same clock.
        total: bytes of the message.
        offset: where this chunk begins.
        chunk: the bytes.
        lane: the sender's, as an index of :data:`LANES`; a lane carries one message after the other.
        wall_time: ``publish_ns`` is the machine's time (a simulated clock is the same on both hosts).
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
        """Bytes of the message."""
        flags = self.lane << 1 | self.wall_time
        head = _DATA.pack(
            self.KIND,
            flags,
            self.channel,
            self.total,
            self.offset,
            self.sequence,
            self.publish_ns,
            self.born_ns,
            self.sent_ns,
        )
        return head + self.chunk

    @classmethod
    def decode(cls, data: memoryview) -> Data:
        """The message of these bytes."""
        if len(data) < _DATA.size:
            raise ProtocolError(f"Data of {len(data)} bytes is too short")
        _, flags, channel, total, offset, sequence, publish, born, sent = _DATA.unpack(data[: _DATA.size])
        chunk = data[_DATA.size :]
        if len(chunk) > MAX_CHUNK or offset + len(chunk) > total or (len(chunk) == 0 and total > 0):
            raise ProtocolError(f"Data: {len(chunk)} bytes at {offset} of {total} cannot be")
        if flags >> 1 >= len(LANES):
            raise ProtocolError(f"Data: unknown lane {flags >> 1}")
        return cls(channel, sequence, publish, born, sent, total, offset, chunk, flags >> 1, bool(flags & 1))


Message = Hello | Welcome | Bye | Announce | Refuse | Notice | Ping | Pong | Ack | Data

_KINDS: dict[int, Any] = {
    kind.KIND: kind for kind in (Hello, Welcome, Bye, Announce, Refuse, Notice, Ping, Pong, Ack, Data)
}
DATA_OVERHEAD = _DATA.size

_T = TypeVar("_T")


def decode(data: bytes | memoryview) -> Message:
    """The message of these bytes; a ``Data``'s chunk is a view of them.

    Raises:
        ProtocolError: they are none.
    """
    view = memoryview(data)
    kind = _KINDS.get(view[0]) if len(view) else None
    if kind is None:
        raise ProtocolError(f"unknown message ({bytes(view[:8]).hex() or 'empty'})")
    message: Message = kind.decode(view)
    return message


def _unpack(form: struct.Struct, data: memoryview) -> tuple[Any, ...]:
    if len(data) != form.size:
        raise ProtocolError(f"message of kind {data[0]} has {len(data)} bytes, {form.size} expected")
    return form.unpack(data)
