"""A node's publishers, its subscriptions and their newest messages."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from instant_ic.bus.clock import Clock
from instant_ic.bus.transport import Buffer, RawPublisher, RawSubscription, Received
from instant_ic.msg import MessageError, serializer, stamp_ns, type_name

WENT_BACK_NS = 100_000_000
"""Largest step back in time that counts as jitter. At a larger step, the clock was set back or restarted."""


class Publisher:
    """Typed publisher. Any thread may call :meth:`publish`."""

    def __init__(self, raw: RawPublisher) -> None:
        self.raw = raw
        self.topic = raw.topic

    @property
    def subscriber_count(self) -> int:
        """Number of connected readers. Without one, costly messages need not be made."""
        return self.raw.subscriber_count

    def publish(self, message: Any) -> None:
        """Send one message.

        Raises:
            MessageError: the message has another type, or a field has a wrong value.
        """
        if type_name(message) != self.raw.type_name:
            raise MessageError(f"{self.topic} carries {self.raw.type_name}, not {type_name(message)}")
        self.raw.send_filled(*serializer(message))

    def publish_bytes(self, payload: Buffer, publish_ns: int | None = None) -> None:
        """Send CDR bytes as they are.

        Args:
            payload: CDR bytes; do not change them afterwards, because they may still be on their way.
            publish_ns: publication time of a forwarded message; None uses the present time.
        """
        self.raw.send(payload, publish_ns)


class Subscription:
    """A subscribed topic with its callback."""

    def __init__(self, topic: str, callback: Callable[[Received], None]) -> None:
        self.label = f"callback of {topic}"
        self.callback = callback
        self.raw: RawSubscription  # set by the node right after construction


class Latest:
    """The newest message of a topic while it is fresh."""

    def __init__(self, clock: Clock, max_age_s: float) -> None:
        self._clock = clock
        self.max_age_s = max_age_s
        self._message: Any = None
        self._received_ns = 0  # on the steady clock, so that ages do not change when the machine's clock is set
        self._given_ns = 0
        self.instances: dict[str, bytes] = {}
        """Identities of publishers (:attr:`Received.instance`), by the name of their node."""

    def put(self, message: Any, received: Received) -> None:
        """Store a newer message with its reception data."""
        self._message, self._received_ns = message, received.steady_ns
        self.note(received)
        self._given_ns = received.given_ns(stamp_ns(message)) if hasattr(message, "header") else received.steady_ns

    def note(self, received: Received) -> None:
        """Record the publisher of a message without storing the message."""
        self.instances[received.publisher] = received.instance

    def forget(self) -> None:
        """Drop the message, as if none had arrived."""
        self._message = None

    @property
    def message(self) -> Any:
        """The newest message, or None if it arrived more than ``max_age_s`` ago."""
        return self._message if self.age_s <= self.max_age_s else None

    @property
    def fresh(self) -> Any:
        """The newest message, or None if it was measured or commanded more than ``max_age_s`` ago.

        Use this for inputs by which a robot drives, because ``message`` treats a message that has waited for this node
        as new.
        """
        return self._message if self.stamp_age_s <= self.max_age_s else None

    @property
    def age_s(self) -> float:
        """Seconds since the message arrived; inf before the first."""
        return self._since_s(self._received_ns)

    @property
    def stamp_age_s(self) -> float:
        """Seconds since the message was measured or commanded (:meth:`Received.given_ns`); inf before the first."""
        return self._since_s(self._given_ns)

    def _since_s(self, instant_ns: int) -> float:
        if self._message is None:
            return float("inf")
        age_ns = self._clock.steady_ns() - instant_ns
        # A message from the future is stale: the clock was set back since, for example when a player restarted.
        return age_ns / 1e9 if age_ns >= -WENT_BACK_NS else float("inf")
