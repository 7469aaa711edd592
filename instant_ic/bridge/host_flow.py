"""Queues messages to one host: in which order they leave, and how many bytes may be in flight.

A slow or stalled link must neither fill with images that are outdated on arrival nor delay a command. Therefore the
link gets only as much as it carries in a few hundredths of a second, and newer messages replace those that wait.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field

from instant_ic.bridge.host_protocol import DATA_OVERHEAD, LANES, MAX_CHUNK, Announce, Data
from instant_ic.bridge.host_topics import TopicCounts, TopicRule

QUEUE_DEPTH = 1000
"""Messages of a reliable topic that may wait for the link; above this the oldest is dropped and counted."""

_COMMAND_IN_FLIGHT = 4 * 1024  # some 20 commands: more would be outdated on arrival
_STATE_EXTRA = 16 * 1024  # state may exceed the window when images fill it
_LEAST_CHUNK = 4 * 1024
_COMMAND, _STATE, _BULK = range(3)


@dataclass(frozen=True)
class Item:
    """A message that waits.

    Attributes:
        payload: CDR bytes.
        publish_ns: time of the first publication.
        born_ns: the same time by this host's monotonic clock, which is never set.
        sequence: sequence number on a queued channel; on other channels it is assigned when the message leaves.
        wall_time: whether ``publish_ns`` is the machine's time of day, not simulated time.
    """

    payload: bytes = field(repr=False)
    publish_ns: int
    born_ns: int
    sequence: int = 0
    wall_time: bool = True


@dataclass
class Channel:
    """One publisher's topic on the sending side.

    Attributes:
        number, origin, type_name, digest, qos: see :class:`Announce`.
        rule: rate, lane and age limit of the topic.
        latched: send the last value to every host that connects.
        queued: send every message; otherwise only the newest.
        sequence: number of the newest message of a queued channel.
        last: newest message of a latched channel.
    """

    number: int
    rule: TopicRule
    origin: str
    type_name: str
    digest: str
    qos: str
    latched: bool
    queued: bool
    sequence: int = 0
    last: Item | None = None

    def announce(self) -> Announce:
        return Announce(self.number, self.rule.topic, self.origin, self.type_name, self.digest, self.qos)


class Window:
    """Limits the bytes in flight, so that the link is used and its queues stay short.

    Delay-based, as LEDBAT (RFC 6817): the window grows while the round trip is close to the shortest known, and shrinks
    when the round trip shows that a queue has formed.

    Args:
        target_s: time that a chunk may wait in queues.
        least, most, start: smallest, largest and initial window in bytes.
    """

    def __init__(
        self, target_s: float = 0.05, least: int = 2 * _LEAST_CHUNK, most: int = 4 << 20, start: int = 64 << 10
    ) -> None:
        self.target_ns = int(target_s * 1e9)
        self.least, self.most = least, most
        self.size = float(start)
        self.queue_ns = 0
        self._base: deque[tuple[int, int]] = deque([(0, 1 << 62)], maxlen=4)
        self._newest: deque[int] = deque(maxlen=2)
        self._next_cut_ns = 0

    @property
    def base_ns(self) -> int:
        """Shortest round trip of about the last half minute."""
        return min(rtt for _, rtt in self._base)

    def observe(self, rtt_ns: int, now_ns: int) -> None:
        """Add a round trip of any kind."""
        begun, least = self._base[-1]
        if now_ns - begun > 10_000_000_000:  # the path may have become longer for good
            self._base.append((now_ns, rtt_ns))
        else:
            self._base[-1] = (begun, min(least, rtt_ns))

    def acked(self, taken: int, rtt_ns: int, in_flight: int, now_ns: int) -> None:
        """Process an acknowledgement: ``taken`` more bytes have arrived, of ``in_flight``."""
        self.observe(rtt_ns, now_ns)
        # A queue delays several answers. A process that waits for the CPU delays only one, which must not cost images.
        self._newest.append(rtt_ns)
        self.queue_ns = min(self._newest) - self.base_ns
        if self.queue_ns > self.target_ns:
            if now_ns >= self._next_cut_ns:  # once per round trip: the next answers still reflect the same queue
                self._next_cut_ns = now_ns + rtt_ns
                self.size *= max(0.5, self.target_ns / self.queue_ns)
        elif in_flight * 2 >= self.size:  # the window limited the sender
            if self.queue_ns * 2 < self.target_ns:
                self.size += taken
            else:
                self.size += taken * _LEAST_CHUNK / self.size
        self.size = min(max(self.size, self.least), self.most)

    @property
    def chunk(self) -> int:
        """Bytes per chunk: small on a slow link, where a command waits for the end of a chunk."""
        return int(min(max(self.size / 4, _LEAST_CHUNK), MAX_CHUNK))


@dataclass
class _Outgoing:
    """State of a channel for one host."""

    channel: Channel
    period_ns: int
    waiting: deque[Item] = field(default_factory=deque)
    due_ns: int = 0
    turn: int = 0
    announced: bool = False
    refused: str = ""

    @property
    def queued(self) -> bool:
        """True if every message is kept until it is sent; False if only the newest is."""
        return self.channel.queued and not self.period_ns


class Outbox:
    """Everything that waits for one host.

    Args:
        wants: topic → most messages per second that the other host takes (0: all); other topics are not sent.
        window: limits the bytes in flight.
        sequences: channel → number of the last message sent. It is kept across the links with one host, so that the
            host can detect the messages that a broken link lost.
    """

    def __init__(
        self, wants: dict[str, float], window: Window | None = None, sequences: dict[int, int] | None = None
    ) -> None:
        self.wants = wants
        self.window = window or Window()
        self.counts: dict[str, TopicCounts] = {}
        self._sequences = {} if sequences is None else sequences
        self._channels: dict[int, _Outgoing] = {}
        self._new: deque[_Outgoing] = deque()
        self._current: list[tuple[_Outgoing, Item, int] | None] = [None] * len(LANES)
        self._turns = itertools.count(1)
        self.sent = [0] * len(LANES)
        self.taken = [0] * len(LANES)

    # -- in ---------------------------------------------------------------------------------------

    def offer(self, channel: Channel, item: Item, now_ns: int) -> None:
        """Queue a message that the other host may take."""
        out = self._outgoing(channel)
        if out is None or out.refused:
            return
        counts = self.counts[channel.rule.topic]
        if out.queued:
            if len(out.waiting) >= QUEUE_DEPTH:
                out.waiting.popleft()
                counts.overflowed += 1
            out.waiting.append(item)
            return
        if out.period_ns and not channel.latched:
            # Keep a fixed grid of periods, with tolerance for a source that is slightly early.
            if now_ns < out.due_ns - out.period_ns // 4:
                counts.thinned += 1
                return
            late = now_ns - out.due_ns
            out.due_ns = out.due_ns + out.period_ns if late < out.period_ns else now_ns + out.period_ns
        if out.waiting:
            held = channel.latched and out.period_ns and now_ns < out.due_ns  # waits for its period, not for the link
            counts.thinned += bool(held)
            counts.superseded += not held
            out.waiting.clear()
        out.waiting.append(item)

    def open(self, channel: Channel) -> None:
        """Announce a channel before its first message, so that subscribers on the other host exist in time."""
        self._outgoing(channel)

    def _outgoing(self, channel: Channel) -> _Outgoing | None:
        topic = channel.rule.topic
        if topic not in self.wants:
            return None
        out = self._channels.get(channel.number)
        if out is None:
            rates = [rate for rate in (channel.rule.rate_hz, self.wants[topic]) if rate > 0]
            out = _Outgoing(channel, int(1e9 / min(rates)) if rates else 0)
            self._channels[channel.number] = out
            self._new.append(out)
            self.counts.setdefault(topic, TopicCounts())
        return out

    def refuse(self, number: int, reason: str) -> Channel | None:
        """Mark a channel as refused by the other host; return None if it was never announced."""
        out = self._channels.get(number)
        if out is None or not out.announced:
            return None
        out.refused = reason
        out.waiting.clear()
        return out.channel

    def acked(self, taken: tuple[int, ...], rtt_ns: int, now_ns: int) -> bool:
        """Process the other host's byte counts; return False if they are impossible."""
        if any(not old <= new <= sent for old, new, sent in zip(self.taken, taken, self.sent, strict=True)):
            return False
        in_flight = self._in_flight(_STATE) + self._in_flight(_BULK)
        more = sum(taken[1:]) - sum(self.taken[1:])
        self.taken = list(taken)
        if more:
            self.window.acked(more, rtt_ns, in_flight, now_ns)
        else:
            self.window.observe(rtt_ns, now_ns)
        return True

    # -- out --------------------------------------------------------------------------------------

    def next(self, now_ns: int) -> Data | Announce | None:
        """Return the next message to send; None when nothing waits or the window is full."""
        if self._new:
            out = self._new.popleft()
            out.announced = True
            return out.channel.announce()
        for lane in range(len(LANES)):
            if not self._room(lane):
                continue
            current = self._current[lane] or self._begin(lane, now_ns)
            if current is not None:
                return self._chunk(lane, *current, now_ns)
        return None

    def next_due_ns(self) -> int | None:
        """Earliest time at which a message that waits for its period may leave."""
        dues = [out.due_ns for out in self._channels.values() if out.waiting and out.period_ns and out.channel.latched]
        return min(dues, default=None)

    def _in_flight(self, lane: int) -> int:
        return self.sent[lane] - self.taken[lane]

    def _room(self, lane: int) -> bool:
        if lane == _COMMAND:
            return self._in_flight(_COMMAND) < _COMMAND_IN_FLIGHT
        filled = self._in_flight(_STATE) + self._in_flight(_BULK)
        return filled < self.window.size + (_STATE_EXTRA if lane == _STATE else 0)

    def _begin(self, lane: int, now_ns: int) -> tuple[_Outgoing, Item, int] | None:
        """Return the message of the lane that has waited for its turn the longest."""
        name = LANES[lane]
        for out in sorted(self._ready(name, now_ns), key=lambda out: out.turn):
            rule = out.channel.rule
            counts = self.counts[rule.topic]
            while out.waiting and rule.max_age_s and now_ns - out.waiting[0].born_ns > rule.max_age_s * 1e9:
                counts.expired += 1
                out.waiting.popleft()
            if not out.waiting:
                continue
            item = out.waiting.popleft()
            out.turn = next(self._turns)
            if out.period_ns and out.channel.latched:
                out.due_ns = now_ns + out.period_ns
            number = out.channel.number
            self._sequences[number] = item.sequence if out.queued else self._sequences.get(number, 0) + 1
            return out, item, 0
        return None

    def _ready(self, lane: str, now_ns: int) -> Iterable[_Outgoing]:
        for out in self._channels.values():
            its_turn = now_ns >= out.due_ns or not (out.period_ns and out.channel.latched)
            if out.waiting and out.channel.rule.lane == lane and its_turn:
                yield out

    def _chunk(self, lane: int, out: _Outgoing, item: Item, offset: int, now_ns: int) -> Data:
        total = len(item.payload)
        end = min(total, offset + self.window.chunk)
        chunk = item.payload if end - offset == total else memoryview(item.payload)[offset:end]
        self.sent[lane] += len(chunk) + DATA_OVERHEAD
        if end == total:
            self._current[lane] = None
            counts = self.counts[out.channel.rule.topic]
            counts.messages += 1
            counts.bytes += total
        else:
            self._current[lane] = (out, item, end)
        return Data(
            out.channel.number,
            self._sequences[out.channel.number],
            item.publish_ns,
            item.born_ns,
            now_ns,
            total,
            offset,
            chunk,
            lane,
            item.wall_time,
        )
