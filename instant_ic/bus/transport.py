"""Interface between a node and its transport, which the local and the lockstep bus implement."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, Protocol

from instant_ic.bus.qos import QoS

Buffer = bytes | bytearray | memoryview


class TransportError(RuntimeError):
    """The bus cannot carry this message."""


class Received(NamedTuple):
    """One received message.

    ``payload`` is read-only. A large payload is a view of its publisher's memory and does not change while anything
    refers to it. A reader that keeps many messages gets copies.
    """

    topic: str
    type_name: str
    payload: bytes | memoryview
    publish_ns: int
    received_ns: int
    order: int
    """Position in the order of arrival over all subscriptions of a node."""
    publisher: str = ""
    """Name of the node that published the message."""
    steady_ns: int = 0
    """Time of arrival on the node's steady clock."""
    instance: bytes = b""
    """Identity of the publisher, which changes when its node restarts. Empty if unknown."""

    def given_ns(self, stamp_ns: int) -> int:
        """Return the time on the node's steady clock at which the content was measured or commanded.

        The stamp is compared with the machine's clock once, on arrival. After that only the steady clock counts, so
        setting the machine's clock changes no age. A stamp in the future counts as the time of arrival.
        """
        return self.steady_ns - max(0, self.received_ns - stamp_ns)

    @property
    def published_ns(self) -> int:
        """Time of publication on the node's steady clock, which may be long before the node reads the message."""
        return self.given_ns(self.publish_ns)


_TOLERANCE_S = 0.1  # simulated time may go back by this much


class Stats:
    """Counts, rate, age and losses of one input or output.

    Times are on the node's steady clock, so setting the machine's clock changes no rate and no age.
    """

    def __init__(self) -> None:
        self.count = 0
        self.lost_by: dict[str, int] = {}
        self.rejected = 0
        self.rejected_why = ""  # reason of the newest rejection
        self.overwritten = 0
        self.newest_ns = 0
        self._arrivals: deque[int] = deque(maxlen=50)

    @property
    def lost(self) -> int:
        """Number of messages that never arrived, over all publishers."""
        return sum(self.lost_by.values())

    def lose(self, publisher: str, count: int) -> None:
        """Count messages of a publisher, given by its node's name, that did not arrive."""
        if count > 0:
            self.lost_by = {**self.lost_by, publisher: self.lost_by.get(publisher, 0) + count}

    def add(self, now_ns: int) -> None:
        """Count a message."""
        self.count += 1
        self.newest_ns = now_ns
        self._arrivals.append(now_ns)

    def rate_hz(self, now_ns: int) -> float:
        """Return the message rate in 1/s over the last 50 messages or 5 s, whichever is shorter."""
        recent = [t for t in list(self._arrivals) if 0 <= now_ns - t < 5_000_000_000]
        if len(recent) < 2 or recent[-1] <= recent[0]:
            return 0.0
        # The time since the last message counts too, so that a topic that has stopped does not keep its old rate.
        span = max(recent[-1] - recent[0], (now_ns - recent[0]) * (len(recent) - 1) // len(recent))
        return (len(recent) - 1) * 1e9 / span

    def age_s(self, now_ns: int) -> float:
        """Return the seconds since the newest message; inf before the first and after simulated time went back."""
        age = (now_ns - self.newest_ns) / 1e9
        return age if self.count and age >= -_TOLERANCE_S else float("inf")


class PublisherStats(Stats):
    """Statistics of a publisher; ``not_shared`` counts large messages that were sent without shared memory."""

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
    def send(self, payload: Buffer, publish_ns: int | None = None) -> None:
        """Send one message; ``publish_ns`` is the publication time of a forwarded message."""
        ...

    def send_filled(self, size: int, fill: Callable[[memoryview], None], publish_ns: int | None = None) -> None:
        """Send ``size`` bytes that ``fill`` writes straight into the message's memory."""
        ...

    def close(self) -> None: ...


class RawSubscription(Protocol):
    """Receives CDR bytes."""

    topic: str
    type_name: str | None
    qos: QoS
    stats: Stats

    def take(self) -> list[Received]:
        """Return the messages since the last call, in order of arrival; at depth 1, the newest of each publisher."""
        ...

    def close(self) -> None: ...


class Transport(Protocol):
    """Topics of one node, and the event that its thread waits for. A wait may read the node's sockets.

    Attributes:
        patient: true if messages do not end a wait of the node's thread; they are read at its end.
    """

    patient: bool

    @property
    def run_dir(self) -> Path | None:
        """Run directory of the topics; None in lockstep."""
        ...

    def set(self) -> None: ...
    def clear(self) -> None: ...
    def wait(self, timeout: float) -> object: ...
    def advertise(self, topic: str, type_name: str, qos: QoS) -> RawPublisher: ...
    def subscribe(
        self, topic: str, type_name: str | None, qos: QoS, on_ready: Callable[[], None]
    ) -> RawSubscription: ...
    def close(self) -> None: ...
