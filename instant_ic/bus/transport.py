"""What a node needs of a transport; the local and the lockstep bus implement it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

from instant_ic.bus.qos import QoS

Buffer = bytes | bytearray | memoryview

Payload = Buffer | Sequence[Buffer]
"""CDR bytes: one buffer, or several that follow each other on the wire."""


class TransportError(RuntimeError):
    """A message that the bus cannot carry."""


class Received(NamedTuple):
    """One message as it came.

    ``payload`` is read-only. A large one is a view of its publisher's memory: it stays as it is for as long as
    anything refers to it, and a reader that keeps many gets copies.
    """

    topic: str
    type_name: str
    payload: bytes | memoryview
    publish_ns: int
    received_ns: int
    order: int
    """Place in the order of arrival over all subscriptions of a node."""
    publisher: str = ""
    """Name of the node that published it."""
    steady_ns: int = 0
    """When it came, by the node's steady clock; for ages."""

    def given_ns(self, stamp_ns: int) -> int:
        """When its content was measured or given, by the node's steady clock; every age counts from there.

        The stamp is compared with the machine's clock once, on arrival. From then on only the steady clock counts, so
        setting the machine's clock makes nothing older or younger. A stamp that is ahead counts as the arrival.
        """
        return self.steady_ns - max(0, self.received_ns - stamp_ns)


_TOLERANCE_S = 0.1  # simulated time may go back a little


class Stats:
    """Counts, rate, age and losses of one direction of a topic.

    Times are of the node's steady clock: setting the machine's clock changes no rate and no age.
    """

    def __init__(self) -> None:
        self.count = 0
        self.lost_by: dict[str, int] = {}
        self.rejected = 0
        self.torn = 0
        self.bytes = 0
        self.newest_ns = 0
        self._arrivals: deque[int] = deque(maxlen=50)

    @property
    def lost(self) -> int:
        """Messages that never came, of all publishers together."""
        return sum(self.lost_by.values())

    def lose(self, publisher: str, count: int) -> None:
        """Counts messages that a publisher (the name of its node) sent and that did not come."""
        if count > 0:
            self.lost_by = {**self.lost_by, publisher: self.lost_by.get(publisher, 0) + count}

    def add(self, now_ns: int, size: int) -> None:
        """Counts one message."""
        self.count += 1
        self.bytes += size
        self.newest_ns = now_ns
        self._arrivals.append(now_ns)

    def rate_hz(self, now_ns: int) -> float:
        """Messages a second over the last 50 or 5 s, whichever is shorter."""
        recent = [t for t in list(self._arrivals) if 0 <= now_ns - t < 5_000_000_000]
        if len(recent) < 2 or recent[-1] <= recent[0]:
            return 0.0
        # The silence since the last message counts too: a topic that stopped must not keep its old rate.
        span = max(recent[-1] - recent[0], (now_ns - recent[0]) * (len(recent) - 1) // len(recent))
        return (len(recent) - 1) * 1e9 / span

    def age_s(self, now_ns: int) -> float:
        """Seconds since the newest message; inf before the first, and when simulated time went back since."""
        age = (now_ns - self.newest_ns) / 1e9
        return age if self.count and age >= -_TOLERANCE_S else float("inf")


class PublisherStats(Stats):
    """Of a publisher; ``not_shared`` counts large messages for which there was no shared memory, and why."""

    def __init__(self) -> None:
        super().__init__()
        self.not_shared = 0
        self.not_shared_why = ""


class RawPublisher(Protocol):
    """Sends CDR bytes."""

    topic: str
    type_name: str
    qos: QoS
    stats: PublisherStats

    @property
    def subscriber_count(self) -> int: ...
    def send(self, payload: Payload, publish_ns: int | None = None) -> None:
        """Sends one message; ``publish_ns`` keeps the publication time of a message that is only passed on."""
        ...

    def send_filled(self, size: int, fill: Callable[[memoryview], None], publish_ns: int | None = None) -> None:
        """Sends ``size`` bytes that ``fill`` writes straight to where readers find them."""
        ...

    def close(self) -> None: ...


def joined(payload: Payload) -> bytes | memoryview:
    """A payload as one piece; copied only where it comes in several."""
    if isinstance(payload, (bytes, memoryview)):
        return payload
    return memoryview(payload) if isinstance(payload, bytearray) else b"".join(payload)


class RawSubscription(Protocol):
    """Receives CDR bytes."""

    topic: str
    type_name: str | None
    qos: QoS
    stats: Stats

    def take(self) -> list[Received]:
        """What came since the last call, in the order of arrival; with ``sensor`` the newest of each publisher."""
        ...

    def close(self) -> None: ...


class Waker(Protocol):
    """What a node's thread waits on; a :class:`threading.Event` is one."""

    def set(self) -> None: ...
    def clear(self) -> None: ...
    def wait(self, timeout: float) -> object: ...


class Transport(Protocol):
    """Topics in and out of one node."""

    @property
    def run_dir(self) -> Path | None:
        """Where the topics are found; None in lockstep."""
        ...

    def waker(self) -> Waker:
        """For the node's own thread; waiting on it may read the node's sockets."""
        ...

    def advertise(self, topic: str, type_name: str, qos: QoS) -> RawPublisher: ...
    def subscribe(
        self, topic: str, type_name: str | None, qos: QoS, on_ready: Callable[[], None]
    ) -> RawSubscription: ...
    def close(self) -> None: ...
