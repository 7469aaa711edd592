"""State machine of one link between two hosts: bytes in, bytes and events out; no sockets, no threads."""

from __future__ import annotations

import re
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Annotated, Any

from instant_ic.bridge.commands import COMMANDS
from instant_ic.bridge.host_clock import ClockFilter
from instant_ic.bridge.host_flow import Channel, Item, Outbox, Window
from instant_ic.bridge.host_protocol import (
    DATA_OVERHEAD,
    LANES,
    VERSION,
    Ack,
    Announce,
    Bye,
    Data,
    Greeting,
    Hello,
    HostNotice,
    HostProtocolError,
    Message,
    Ping,
    Pong,
    Refuse,
    Welcome,
    decode,
)
from instant_ic.bridge.host_topics import TopicCounts, TopicRule, moves, releases
from instant_ic.config.ranges import Range, check_ranges
from instant_ic.util.web_access import TokenBucket

MAX_MESSAGE = 64 << 20
"""Largest message that is reassembled, in bytes."""

MAX_CHANNELS = 1024
"""Most channels that the other host may announce on one link; a robot has a few hundred."""

SHARED_BYTES_PER_S, SHARED_BURST = 512 << 10, 2 << 20
"""Rate and burst of shared topics from a host that does not drive, except stops; reports of ten nodes take 20 kB/s."""

MAX_NAME = 128
MAX_NOTICES = 16
_NAME = re.compile(rf"[A-Za-z0-9_/.:-]{{1,{MAX_NAME}}}\Z")
_MAX_TEXT = 300

_FIRST_PINGS = 8
_FIRST_PING_S = 0.02
_CLOCK_STEP_NS = 20_000_000


class Clocks:
    """The machine's two clocks: the monotonic clock, and the time of day."""

    def mono_ns(self) -> int:
        return time.monotonic_ns()

    def wall_ns(self) -> int:
        return time.time_ns()

    def epoch_ns(self) -> int:
        """Return the time of day at the monotonic clock's zero; it changes only when the time of day is set."""
        reads = []
        for _ in range(3):  # a busy machine may pause between the two clocks: keep the fastest reading
            before, wall, after = self.mono_ns(), self.wall_ns(), self.mono_ns()
            reads.append((after - before, wall - (before + after) // 2))
        return min(reads)[1]


@dataclass(frozen=True)
class LinkTimes:
    """Timing of a link; seconds.

    Attributes:
        ping_s: ping period.
        timeout_s: time without any message after which the link is lost.
        queue_s: time that an image may wait in the link's queues.
    """

    ping_s: Annotated[float, Range(0.02, 5)] = 0.25
    timeout_s: Annotated[float, Range(0.1, 60)] = 1.0
    queue_s: Annotated[float, Range(0.005, 1)] = 0.05

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.timeout_s < 2 * self.ping_s:
            raise ValueError(f"timeout_s must be at least two ping_s (got {self.timeout_s} and {self.ping_s})")


@dataclass(frozen=True)
class Side:
    """One host's side of a link.

    Attributes:
        name: the host's own name.
        instance: new with every start.
        imports: topics that it imports, by name.
        digest: returns the RIHS01 hash of a message type; raises ValueError for an unknown type.
    """

    name: str
    instance: str
    imports: dict[str, TopicRule]
    digest: Callable[[str], str]


@dataclass(frozen=True)
class Up:
    """The link is up; ``name`` is the other host's own name."""

    name: str


@dataclass(frozen=True)
class Ended:
    """The link has ended; ``code`` is that of :class:`Bye`, or timeout, or gone."""

    code: str
    reason: str


@dataclass(frozen=True)
class Announced:
    """A topic was announced and accepted."""

    announce: Announce


@dataclass(frozen=True)
class Arrived:
    """A complete message of a topic.

    Attributes:
        announce: topic, type, QoS and publisher.
        payload: CDR bytes.
        publish_ns: time of publication, by this host's time of day.
        born_ns: time of publication by this host's monotonic clock; never in the future.
    """

    announce: Announce
    payload: bytes | bytearray = field(repr=False)
    publish_ns: int
    born_ns: int = 0


@dataclass(frozen=True)
class Refused:
    """A topic was refused, by this host (``here``) or by the other."""

    topic: str
    reason: str
    here: bool


@dataclass(frozen=True)
class ClockStepped:
    """The other host's clock stepped by ``step_ns``."""

    step_ns: int


Event = Up | Ended | Announced | Arrived | Refused | ClockStepped


@dataclass
class PeerMemory:
    """State kept for each host across links, so that lost messages are detected after a reconnect.

    Attributes:
        sent: channel → number of the last message sent.
        received: (the other host's instance, topic, publisher) → number of the last message received.
        latched: (the other host's instance, topic, publisher) → ``born_ns`` of the last latched value passed on, since
            a new link sends it again.
        held: (the other host's instance, topic, publisher) → time of its last command to move, if that was dropped.
        counts_out, counts_in: counts by topic, over all links with this host.
    """

    sent: dict[int, int] = field(default_factory=dict)
    received: dict[tuple[str, str, str], int] = field(default_factory=dict)
    latched: dict[tuple[str, str, str], int] = field(default_factory=dict)
    held: dict[tuple[str, str, str], int] = field(default_factory=dict)
    counts_out: dict[str, TopicCounts] = field(default_factory=dict)
    counts_in: dict[str, TopicCounts] = field(default_factory=dict)


@dataclass
class _Incoming:
    announce: Announce
    rule: TopicRule
    counts: TopicCounts
    refused: str = ""
    kept: tuple[Arrived, int] | None = None  # latched value of a host that does not drive yet, with its born_ns


class Session:
    """One side of one link, from the first message to the last.

    Args:
        side: this host.
        connecting: whether this side sends :class:`Hello`.
        memory: state of earlier links with the other host.
        clocks: the machine's clocks, or simulated ones.
        times: ping period and timeouts.
        may_send: whether the other host's topics are accepted; a viewer's are not.
    """

    def __init__(
        self,
        side: Side,
        connecting: bool,
        memory: PeerMemory | None = None,
        clocks: Clocks | None = None,
        times: LinkTimes | None = None,
        may_send: bool = True,
    ) -> None:
        self.side = side
        self.clocks = clocks or Clocks()
        self.times = times or LinkTimes()
        self.memory = memory or PeerMemory()
        self.may_send = may_send
        self.drives = connecting  # the connecting side accepts all topics; the robot's link decides who drives
        self.up = False
        self.ended: Ended | None = None
        self.peer_name = ""
        self.peer_instance = ""
        self.notices: dict[str, str] = {}
        self.clock = ClockFilter()
        self.outbox = Outbox({}, Window(self.times.queue_s), self.memory.sent)
        now = self.clocks.mono_ns()
        self.heard_ns = self.up_ns = now
        self._connecting = connecting
        self._peer_epoch_ns: int | None = None
        self._incoming: dict[int, _Incoming] = {}
        self._partial: dict[int, tuple[Data, bytearray]] = {}
        self._early: list[tuple[_Incoming, Data, bytes | bytearray]] = []
        self._early_bytes = 0
        self._shared = TokenBucket(SHARED_BYTES_PER_S, SHARED_BURST)
        self._replies: deque[Message] = deque()
        self._taken = [0] * len(LANES)
        self._ack: int | None = None
        self._pings = 0
        self._next_ping_ns = now
        if connecting:
            self._replies.append(Hello(VERSION, side.name, side.instance, self._wants()))

    def _wants(self) -> dict[str, Any]:
        if not self.may_send:
            return {}
        return {topic: rule.rate_hz for topic, rule in self.side.imports.items()}

    # -- out --------------------------------------------------------------------------------------

    def offer(self, channel: Channel, item: Item) -> None:
        """Queue a message for the other host."""
        if self.up:
            self.outbox.offer(channel, item, self.clocks.mono_ns())

    def open(self, channel: Channel) -> None:
        """Announce a topic before its first message."""
        if self.up:
            self.outbox.open(channel)

    def outgoing(self) -> Iterator[bytes]:
        """Yield the frames to send now."""
        now = self.clocks.mono_ns()
        while self._replies:
            yield self._replies.popleft().encode()
        if not self.up:
            return
        if self._ack is not None:
            yield Ack(self._ack, tuple(self._taken)).encode()
            self._ack = None
        if now >= self._next_ping_ns:
            self._pings += 1
            period_s = _FIRST_PING_S if self._pings < _FIRST_PINGS else self.times.ping_s
            self._next_ping_ns = now + int(period_s * 1e9)
            yield Ping(self._pings & 0xFFFFFFFF, self.clocks.mono_ns(), self.clocks.epoch_ns()).encode()
        while self.up and (message := self.outbox.next(self.clocks.mono_ns())) is not None:
            yield message.encode()

    def next_due_ns(self) -> int:
        """Return when :meth:`outgoing` or :meth:`check` must be called next if nothing happens before."""
        dues = [self.heard_ns + int(self.times.timeout_s * 1e9)]
        if self.up:
            dues.append(self._next_ping_ns)
            due = self.outbox.next_due_ns()
            if due is not None:
                dues.append(due)
        return min(dues)

    def check(self) -> list[Event]:
        """End a link that has timed out."""
        silent_s = (self.clocks.mono_ns() - self.heard_ns) / 1e9
        if self.ended is None and silent_s > self.times.timeout_s:
            return self.end("timeout", f"nothing heard for {silent_s:.1f} s")
        return []

    def end(self, code: str, reason: str, inform: bool = False) -> list[Event]:
        """End the link from this side; ``inform`` sends the reason to the other host."""
        if self.ended is not None:
            return []
        self.up, reason = False, _text(reason)  # it may quote the other host
        self._replies.clear()
        if inform:
            self._replies.append(Bye(code, reason))
        for topic, counts in self.outbox.counts.items():
            self.memory.counts_out.setdefault(topic, TopicCounts()).add(counts)
        self.outbox.counts = {}
        self.ended = Ended(code, reason)
        return [self.ended]

    def notify(self, name: str, text: str) -> None:
        """Send a notice to the other host's user; an empty text withdraws it."""
        self._replies.append(HostNotice(name, text))

    def set_drives(self, drives: bool) -> list[Event]:
        """Set whether the other host's commands are accepted; if so, return its topics and latched values so far."""
        self.drives = drives
        if not drives:
            return []
        taken = [each for each in self._incoming.values() if not (each.refused or each.rule.shared)]
        events: list[Event] = [Announced(incoming.announce) for incoming in taken]
        for incoming in self._incoming.values():
            if incoming.kept is not None:
                events += self._deliver(incoming, *incoming.kept)
                incoming.kept = None
        return events

    # -- clocks -----------------------------------------------------------------------------------

    @property
    def wall_offset_ns(self) -> int | None:
        """The other host's time of day minus ours; None before the first exchange."""
        if self._peer_epoch_ns is None or not self.clock.ready:
            return None
        return self._peer_epoch_ns - self.clocks.epoch_ns() + self.clock.offset_ns

    def _heard_clock(self, epoch_ns: int) -> list[Event]:
        before, self._peer_epoch_ns = self._peer_epoch_ns, epoch_ns
        if before is not None and abs(epoch_ns - before) > _CLOCK_STEP_NS:
            return [ClockStepped(epoch_ns - before)]
        return []

    # -- in ---------------------------------------------------------------------------------------

    def receive(self, data: bytes | memoryview) -> list[Event]:
        """Process one frame of the other host; an invalid frame ends the link."""
        if self.ended is not None:
            return []
        self.heard_ns = self.clocks.mono_ns()
        try:
            return self._take(decode(data))
        except HostProtocolError as error:
            return self.end("protocol", str(error), inform=True)

    def _take(self, message: Message) -> list[Event]:
        now = self.clocks.mono_ns()
        match message:
            case Bye():
                return self.end(_text(message.code), _text(message.reason))
            case Greeting() if isinstance(message, Welcome) == self._connecting and not self.up:
                return self._begin(message)
            case _ if not self.up:
                raise HostProtocolError(f"{type(message).__name__} before the greeting")
            case Ping():
                self._replies.append(
                    Pong(message.number, message.mono_ns, now, self.clocks.mono_ns(), self.clocks.epoch_ns())
                )
                return self._heard_clock(message.epoch_ns)
            case Pong():
                sample = self.clock.add(message.echo_ns, message.arrived_ns, message.mono_ns, now)
                events = self._heard_clock(message.epoch_ns)
                if sample is not None:
                    self.outbox.window.observe(sample.rtt_ns, now)
                    events += self._release_early(now)
                return events
            case Ack():
                if not self.outbox.acked(message.taken, now - message.echo_ns, now):
                    raise HostProtocolError(f"{message} acknowledges data that were not sent")
                return []
            case HostNotice():
                if message.name not in self.notices and len(self.notices) >= MAX_NOTICES:
                    raise HostProtocolError(f"more than {MAX_NOTICES} notices of different names")
                self.notices[_checked("HostNotice: name", message.name)] = _text(message.text)
                return []
            case Refuse():
                channel = self.outbox.refuse(message.channel, message.reason)
                return [] if channel is None else [Refused(channel.rule.topic, _text(message.reason), here=False)]
            case Announce():
                return self._announced(message)
            case Data():
                return self._data(message, now)
        raise HostProtocolError(f"{type(message).__name__} is not expected here")

    def _begin(self, message: Greeting) -> list[Event]:
        if message.version != VERSION:
            return self.end(
                "version",
                f"{message.name} uses bridge protocol version {message.version}, {self.side.name} version {VERSION}: "
                "install the same Instant IC on both",
                inform=True,
            )
        if not self._connecting:
            self._replies.append(Welcome(VERSION, self.side.name, self.side.instance, self._wants()))
        wants = message.wants
        for topic, rate in wants.items():
            # The period of a tiny rate would be infinite.
            if not isinstance(rate, (int, float)) or isinstance(rate, bool) or not (rate == 0 or 1e-6 < rate < 1e6):
                raise HostProtocolError(
                    f"{type(message).__name__}: rate of {topic} must be a number >= 0 (got {rate!r})"
                )
        self.peer_name, self.peer_instance = _text(message.name)[:64], message.instance[:64]
        self.outbox.wants = {topic: float(rate) for topic, rate in wants.items()}
        self.up, self.up_ns = True, self.clocks.mono_ns()
        if not self.may_send:
            self.notify("role", f"this host may only watch {self.side.name} (role viewer)")
        self._next_ping_ns = self.up_ns
        # Drop entries of the other host's earlier instances: their numbers mean nothing now.
        for known in (self.memory.received, self.memory.latched, self.memory.held):
            for key in [key for key in known if key[0] != self.peer_instance]:
                del known[key]
        return [Up(self.peer_name)]

    def _announced(self, announce: Announce) -> list[Event]:
        for key in ("topic", "origin", "type_name", "digest", "qos"):
            _checked(f"Announce: {key}", getattr(announce, key))
        if len(self._incoming) >= MAX_CHANNELS and announce.channel not in self._incoming:
            raise HostProtocolError(f"more than {MAX_CHANNELS} channels are announced on one link")
        rule = self.side.imports.get(announce.topic)
        reason = ""
        if rule is None:
            reason = f"{announce.topic} is not on the topic list of {self.side.name}"
        elif not self.may_send:
            reason = f"{self.peer_name} may only watch {self.side.name} (role viewer)"
        elif announce.type_name != (wanted := COMMANDS.get(announce.topic, announce.type_name)):
            # The first announcement sets a topic's type. A wrong type must not keep others from stopping the robot.
            reason = f"{announce.topic} must be {wanted} (got {announce.type_name})"
        else:
            try:
                if self.side.digest(announce.type_name) != announce.digest:
                    reason = (
                        f"{announce.type_name} has different fields on {self.peer_name} and {self.side.name}: "
                        "install the same Instant IC on both"
                    )
            except ValueError as error:
                reason = str(error)
        topic = announce.topic
        counts = self.memory.counts_in.setdefault(topic, TopicCounts()) if rule is not None else TopicCounts()
        self._incoming[announce.channel] = _Incoming(announce, rule or TopicRule("/none"), counts, reason)
        if reason:
            return self.refuse(announce, reason)
        # A host that does not drive must not set a topic's type.
        return [Announced(announce)] if self.drives or rule is None or rule.shared else []

    def refuse(self, announce: Announce, reason: str) -> list[Event]:
        """Report to the other host that one of its topics is refused."""
        self._incoming[announce.channel].refused = reason
        self._replies.append(Refuse(announce.channel, reason))
        return [Refused(announce.topic, reason, here=True)]

    def _data(self, data: Data, now: int) -> list[Event]:
        incoming = self._incoming.get(data.channel)
        if incoming is None:
            raise HostProtocolError(f"data of channel {data.channel}, which was not announced")
        lane = data.lane  # the sender's lane: its list may assign another one
        self._taken[lane] += len(data.chunk) + DATA_OVERHEAD
        self._ack = data.sent_ns
        if incoming.refused:
            return []
        payload = self._assemble(lane, data)
        if payload is None:
            return []
        if self.clock.ready:
            return self._whole(incoming, data, payload, now)
        self._early.append((incoming, data, payload))  # its age is unknown until our ping is answered
        self._early_bytes += len(payload) + DATA_OVERHEAD
        if self._early_bytes > MAX_MESSAGE:
            raise HostProtocolError(f"{self._early_bytes} bytes received before the answer to a ping")
        return []

    def _release_early(self, now: int) -> list[Event]:
        early, self._early = self._early, []
        return [event for incoming, data, payload in early for event in self._whole(incoming, data, payload, now)]

    def _assemble(self, lane: int, data: Data) -> bytes | bytearray | None:
        """Return the complete message after its last chunk, otherwise None."""
        if data.offset == 0:
            if len(data.chunk) == data.total:
                return bytes(data.chunk)
            if data.total > MAX_MESSAGE:
                raise HostProtocolError(f"message of {data.total} bytes; {MAX_MESSAGE} at most")
            self._partial[lane] = (data, bytearray(data.chunk))
            return None
        first, payload = self._partial.get(lane, (None, bytearray()))
        if (
            first is None
            or (first.channel, first.sequence, first.total) != (data.channel, data.sequence, data.total)
            or len(payload) != data.offset
        ):
            raise HostProtocolError(f"chunk at {data.offset} of channel {data.channel} does not continue its message")
        payload += data.chunk
        if len(payload) < data.total:
            return None
        del self._partial[lane]
        return payload

    def _whole(self, incoming: _Incoming, data: Data, payload: bytes | bytearray, now: int) -> list[Event]:
        announce, counts = incoming.announce, incoming.counts
        key = (self.peer_instance, announce.topic, announce.origin)
        last = self.memory.received.get(key)
        if last is not None and data.sequence > last + 1:
            counts.lost += data.sequence - last - 1
        _remember(self.memory.received, key, data.sequence)
        born_ns = min(data.born_ns - self.clock.offset_ns, now)  # by our monotonic clock
        rule = incoming.rule
        # Checked before the age, because an old command also shows whether the operator holds a key.
        held = not rule.shared and self._is_held(key, announce, payload, now)
        if rule.max_age_s and now - born_ns > rule.max_age_s * 1e9:
            counts.expired += 1
            return []
        publish_ns = data.publish_ns
        if data.wall_time and (offset := self.wall_offset_ns) is not None:
            publish_ns -= offset
        if not 0 <= publish_ns < 1 << 63:
            raise HostProtocolError(f"{announce.topic}: time of publication {publish_ns} ns is impossible")
        arrived = Arrived(announce, payload, publish_ns, born_ns)
        if held or (not self.drives and not self._shares(arrived, rule, now)):
            counts.not_driving += 1
            # A refused release is dropped for good: handing over the lease must not end an emergency stop.
            if announce.qos == "latched" and not rule.shared and not held:
                incoming.kept = arrived, data.born_ns
                kept = sum(len(each.kept[0].payload) for each in self._incoming.values() if each.kept is not None)
                if kept > MAX_MESSAGE:
                    raise HostProtocolError(f"{kept} bytes of latched values before this host drives")
            return []
        return self._deliver(incoming, arrived, data.born_ns)

    def _shares(self, arrived: Arrived, rule: TopicRule, now: int) -> bool:
        """Return whether a host that does not drive may send this: a shared topic, no release, within the rate."""
        announce, payload = arrived.announce, arrived.payload
        if not rule.shared or releases(announce.type_name, payload):
            return False
        return announce.topic in COMMANDS or self._shared.take(now / 1e9, len(payload) + DATA_OVERHEAD)

    def _is_held(self, key: tuple[str, str, str], announce: Announce, payload: bytes | bytearray, now: int) -> bool:
        """Return whether the operator has held a key since before the other host drove; no robot starts under it.

        A zero command counts as letting go, and so does a silence longer than any link survives. A shorter silence may
        be a stall of the network.
        """
        held, last_ns = self.memory.held, self.memory.held.get(key)
        if self.drives and last_ns is None:
            return False
        moving = moves(announce.type_name, payload)
        silent_ns = now - max(last_ns or 0, self.up_ns)
        if moving and (not self.drives or silent_ns <= 2e9 * self.times.timeout_s):
            _remember(held, key, now)
            if self.drives:
                self.notify("held", f"let go of the controls once: {self.side.name} does not start under a held key")
            return True
        if held.pop(key, None) is not None:
            self.notify("held", "")
        return False

    def _deliver(self, incoming: _Incoming, arrived: Arrived, born_ns: int) -> list[Event]:
        announce, counts = incoming.announce, incoming.counts
        if announce.qos == "latched":
            # A new link repeats the latched values. An old release among them must not end an emergency stop that
            # another host has set since.
            key = (self.peer_instance, announce.topic, announce.origin)
            if self.memory.latched.get(key) == born_ns:
                return []
            _remember(self.memory.latched, key, born_ns)
        counts.messages += 1
        counts.bytes += len(arrived.payload)
        return [arrived]


def _checked(what: str, name: str) -> str:
    """Return a name received from the other host, if it is valid.

    Raises:
        HostProtocolError: the name is too long, or has characters that names may not contain.
    """
    if not _NAME.match(name):
        raise HostProtocolError(
            f"{what} {name[:40]!r} of {len(name)} characters must have 1 to {MAX_NAME} letters, digits or _ / . : -"
        )
    return name


def _text(text: str) -> str:
    """Return the other host's text in a form fit for logs: one line, limited length."""
    return "".join(c if c.isprintable() else " " for c in text[:_MAX_TEXT])


def _remember(memory: dict[tuple[str, str, str], int], key: tuple[str, str, str], value: int) -> None:
    """Store a number for a publisher; when there are too many, drop the one updated longest ago."""
    memory.pop(key, None)
    memory[key] = value
    if len(memory) > MAX_CHANNELS:
        del memory[next(iter(memory))]
