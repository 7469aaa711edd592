"""A bus in one process, without threads or sockets, on which real nodes run in lockstep with their messages.

Every message goes through CDR, in the order of publication. A node therefore behaves as it does in a process of its
own, and the same input gives bit-identical output.
"""

from __future__ import annotations

import itertools
import logging
import threading
from collections import defaultdict, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from instant_ic.bus.clock import ManualClock
from instant_ic.bus.node import Node
from instant_ic.bus.qos import LATCHED, QoS
from instant_ic.bus.transport import Buffer, PublisherStats, Received, Stats
from instant_ic.msg import deserialize, serialize, type_name
from instant_ic.util.closing import Closing

NodeT = TypeVar("NodeT", bound=Node[Any])


@dataclass(frozen=True)
class Record:
    """One message that was sent over the bus."""

    topic: str
    type_name: str
    payload: bytes
    stamp_ns: int
    node: str
    qos: QoS
    instance: bytes = b""
    """Identity of the publisher; empty for a message from outside."""


class _Publisher:
    def __init__(self, bus: LockstepBus, node: str, topic: str, name: str, qos: QoS) -> None:
        self._bus = bus
        self._node = node
        self._instance = bus.new_instance()
        self.topic, self.type_name, self.qos = topic, name, qos
        self.stats = PublisherStats()

    @property
    def subscriber_count(self) -> int:
        return len(self._bus.subscriptions.get(self.topic, ()))

    def send(self, payload: Buffer, publish_ns: int | None = None) -> None:
        data = bytes(payload)
        self.stats.add(self._bus.clock.steady_ns())
        self._bus.route(self.topic, self.type_name, data, self._node, self.qos, publish_ns, self._instance)

    def send_filled(self, size: int, fill: Callable[[memoryview], None], publish_ns: int | None = None) -> None:
        data = bytearray(size)
        fill(memoryview(data))
        self.send(data, publish_ns)

    def close(self) -> None:
        pass


@dataclass
class _Subscription:
    bus: LockstepBus
    transport: _Transport
    topic: str
    type_name: str | None
    qos: QoS
    stats: Stats = field(default_factory=Stats)
    queue: deque[Received] = field(default_factory=deque)

    def take(self) -> list[Received]:
        messages = list(self.queue)
        self.queue.clear()
        self.transport.waiting -= len(messages)
        return messages

    def close(self) -> None:
        self.take()
        self.bus.subscriptions[self.topic].remove(self)


class _Transport(threading.Event):
    patient = False

    def __init__(self, bus: LockstepBus, node: str, run_dir: Path | None) -> None:
        super().__init__()
        self.run_dir = run_dir
        self._bus = bus
        self._node = node
        self.waiting = 0
        """Number of messages in all queues."""

    def advertise(self, topic: str, name: str, qos: QoS) -> _Publisher:
        return _Publisher(self._bus, self._node, topic, name, qos)

    def subscribe(self, topic: str, name: str | None, qos: QoS, on_ready: Callable[[], None]) -> _Subscription:
        subscription = _Subscription(self._bus, self, topic, name, qos)
        self._bus.subscriptions[topic].append(subscription)
        for record in self._bus.latched.get(topic, {}).values():
            self._bus.deliver(subscription, record)
        return subscription

    def close(self) -> None:
        pass


class LockstepBus(Closing):
    """Runs nodes with a manual clock.

    Args:
        start_ns: first value of the clock.
        keep: keep all messages for :meth:`messages`; set it to False for long replays.
        on_record: function called with every message that a node publishes, for a recorder.
        run_dir: run directory of the nodes; None if they have none.
    """

    def __init__(
        self,
        start_ns: int = 1_000_000_000,
        keep: bool = True,
        on_record: Callable[[Record], None] | None = None,
        run_dir: Path | None = None,
    ) -> None:
        self._run_dir = run_dir
        self.clock = ManualClock(start_ns)
        self.nodes: list[Node[Any]] = []
        self._transports: dict[Node[Any], _Transport] = {}
        self.subscriptions: dict[str, list[_Subscription]] = defaultdict(list)
        self.latched: dict[str, dict[str, Record]] = defaultdict(dict)
        self._records: dict[str, list[Record]] = defaultdict(list)
        self._keep = keep
        self._on_record = on_record
        self._orders = itertools.count()
        self._instances = itertools.count(1)

    def add(
        self,
        node_class: type[NodeT],
        config: Any = None,
        name: str | None = None,
        namespace: str = "",
        remaps: dict[str, str] | None = None,
        **parts: Any,
    ) -> NodeT:
        """Create a node and run its ``setup``.

        Args:
            node_class: class of the node.
            config: parameters; None uses the defaults.
            name: name of the node; None uses its class's name.
            namespace: prefix of its topics.
            remaps: names of topics and their replacements.
            parts: further arguments of the node's constructor, such as a simulated device.
        """
        configuration = node_class.config_class()() if config is None else config
        label = name or node_class.name
        transport = _Transport(self, label, self._run_dir)
        node = node_class(configuration, transport, self.clock, name, namespace, remaps, lockstep=True, **parts)
        self.nodes.append(node)
        self._transports[node] = transport
        node.start()
        self._run()
        return node

    def publish(
        self, topic: str, message: Any, stamp_ns: int | None = None, latched: bool = False, publisher: str = ""
    ) -> None:
        """Publish as node ``publisher``, after the clock has advanced to ``stamp_ns`` and the timers up to it fired."""
        self.publish_bytes(topic, type_name(message), bytes(serialize(message)), stamp_ns, latched, publisher)

    def publish_bytes(
        self,
        topic: str,
        name: str,
        payload: bytes,
        stamp_ns: int | None = None,
        latched: bool = False,
        publisher: str = "",
    ) -> None:
        """Publish CDR bytes; see :meth:`publish`."""
        if stamp_ns is not None:
            self.advance_to(stamp_ns)
        qos = LATCHED if latched else QoS("outside", 1000)
        self.route(topic, name, payload, publisher, qos)
        self._run()

    def advance_to(self, now_ns: int) -> None:
        """Advance the clock and fire every timer at its own time. A time in the past changes nothing."""
        while True:
            due = [t for node in self.nodes if (t := node.timers.next_ns()) is not None]
            if not due or min(due) > now_ns:
                break
            self.clock.set(max(min(due), self.clock.now_ns()))
            self._run()
        self.clock.set(max(now_ns, self.clock.now_ns()))
        self._run()

    def advance(self, seconds: float) -> None:
        self.advance_to(self.clock.now_ns() + int(seconds * 1e9))

    def records(self, topic: str) -> list[Record]:
        """Return all messages of a topic as they were sent."""
        return list(self._records.get(topic, ()))

    def messages(self, topic: str) -> list[Any]:
        """Return all messages of a topic, decoded."""
        return [deserialize(r.payload, r.type_name) for r in self._records.get(topic, ())]

    def last(self, topic: str) -> Any:
        """Return the newest message of a topic, decoded, or None before the first."""
        records = self._records.get(topic)
        return deserialize(records[-1].payload, records[-1].type_name) if records else None

    def kill(self, node: Node[Any]) -> None:
        """Remove a node as SIGKILL does: without teardown, and with the loss of its latched values."""
        self.nodes.remove(node)
        transport = self._transports.pop(node)
        for subscriptions in self.subscriptions.values():
            subscriptions[:] = [each for each in subscriptions if each.transport is not transport]
        for values in self.latched.values():
            values.pop(node.node_name, None)

    def close(self) -> None:
        """Run every node's ``teardown``, in the reverse order of :meth:`add`."""
        for node in reversed(self.nodes):
            node.close()
        self.nodes.clear()
        self._transports.clear()

    # -- for publishers and subscriptions --------------------------------------------------------

    def new_instance(self) -> bytes:
        """Return the identity of a new publisher."""
        return next(self._instances).to_bytes(8)

    def route(
        self,
        topic: str,
        name: str,
        payload: bytes,
        node: str,
        qos: QoS,
        publish_ns: int | None = None,
        instance: bytes = b"",
    ) -> None:
        """Deliver a message to every subscription of its topic."""
        stamp_ns = self.clock.now_ns() if publish_ns is None else publish_ns
        record = Record(topic, name, payload, stamp_ns, node, qos, instance)
        if self._keep:
            self._records[topic].append(record)
        if qos.latched:
            self.latched[topic][node] = record
        if self._on_record is not None and node:
            self._on_record(record)
        for subscription in self.subscriptions.get(topic, ()):
            self.deliver(subscription, record)

    def deliver(self, subscription: _Subscription, record: Record) -> None:
        """Put a message into the queue of one subscription."""
        if subscription.type_name not in (None, record.type_name):
            subscription.stats.rejected += 1
            subscription.stats.rejected_why = f"{record.type_name} received, {subscription.type_name} expected"
            logging.getLogger(__name__).error("%s: %s; refused", record.topic, subscription.stats.rejected_why)
            return
        now = self.clock.now_ns()
        steady = self.clock.steady_ns()
        subscription.stats.add(steady)
        subscription.transport.waiting += 1
        subscription.queue.append(
            Received(
                record.topic,
                record.type_name,
                record.payload,
                record.stamp_ns,
                now,
                next(self._orders),
                record.node,
                steady,
                record.instance,
            )
        )

    def _run(self) -> None:
        """Run the nodes in turn until none has anything left to do at the present time."""
        for _ in range(100_000):
            ran = False
            for node in list(self.nodes):
                # Most nodes have nothing to do most of the time, and polling all their queues is slow.
                if (self._transports[node].waiting or self._due(node)) and node.spin_once():
                    ran = True
            if not ran:
                return
        raise RuntimeError("the nodes answer each other endlessly at one instant")

    def _due(self, node: Node[Any]) -> bool:
        """Return whether a worker's result or a timer is due."""
        timer_ns = node.timers.next_ns()
        return bool(node.callbacks.soon) or (timer_ns is not None and timer_ns <= self.clock.steady_ns())
