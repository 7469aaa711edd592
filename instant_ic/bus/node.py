"""Base class of nodes: topics, timers, clock, the loop, and objects for parameters, diagnostics and transforms."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar, get_args

from instant_ic.bus.callbacks import Callbacks
from instant_ic.bus.clock import Clock
from instant_ic.bus.diagnostics import Diagnostics
from instant_ic.bus.node_parameters import NodeParameters
from instant_ic.bus.node_report import NodeReport
from instant_ic.bus.node_transforms import NodeTransforms
from instant_ic.bus.qos import RELIABLE, SENSOR, QoS
from instant_ic.bus.simulated_time import SimulatedTime
from instant_ic.bus.timers import Timer, Timers
from instant_ic.bus.topics import Latest, Publisher, Subscription
from instant_ic.bus.transport import Received, Transport
from instant_ic.bus.worker import Worker
from instant_ic.config import params
from instant_ic.geometry.transforms import TransformBuffer
from instant_ic.msg import deserialize, type_name
from instant_ic.util.diagnosis import Diagnosis
from instant_ic.util.pace import current

ConfigT = TypeVar("ConfigT")

_REPORT_S = 1.0  # period of heartbeat and diagnostics, and of the check of a stop flag set by a signal


class Node(Generic[ConfigT]):
    """Base class of every process of the stack; docs/architecture.md explains how to write a node.

    Args:
        config: typed parameters.
        transport: topics of the node.
        clock: clock of the node; a :class:`ManualClock` if ``/clock`` or a test sets the time.
        name: name of the node; None uses the class's name.
        namespace: prefix of every topic.
        remaps: names of topics and their replacements, applied before the namespace.
        lockstep: run without threads and heartbeat; the lockstep bus drives the node.
        use_sim_time: follow ``/clock``; callbacks wait for its first value.

    Attributes:
        parameters: parameters of the node, of which live ones can change while it runs.
        diagnostics: diagnoses of the node; :meth:`diagnose` sets one.
        transforms: broadcasts transforms; :attr:`tf` looks transforms up.
        timers: the node's timers; :meth:`timer` adds one.
        callbacks: runs the node's callbacks one after another.
        node_report: publishers of log, heartbeat and diagnostics; None before :meth:`start` and in lockstep.
        commands: functions that the control channel's ``call`` can run, by name, with keyword arguments. The result is
            returned as JSON, a ``ValueError`` or ``NodeError`` as the reason for a refusal.
        run_state: ``STARTING``, ``RUNNING`` or ``STOPPING``.
        on_registry_change: function called when topics or parameters change.
    """

    name: ClassVar[str] = "node"
    live_parameters: ClassVar[tuple[str, ...]] = ()
    """Parameters or groups of parameters that can be changed while the node runs: those that the node reads from
    ``self.config`` at each use, and those that its :meth:`reconfigure` applies. ``"*"`` means all."""

    def __init__(
        self,
        config: ConfigT,
        transport: Transport,
        clock: Clock,
        name: str | None = None,
        namespace: str = "",
        remaps: dict[str, str] | None = None,
        lockstep: bool = False,
        use_sim_time: bool = False,
    ) -> None:
        self.config = config
        self.clock = clock
        self.node_name = name or type(self).name
        self.namespace = namespace.strip("/")
        self.lockstep = lockstep
        self.use_sim_time = use_sim_time
        self.nice = 0
        self.log = logging.getLogger(self.node_name)
        self.publishers: list[Publisher] = []
        self.subscriptions: list[Subscription] = []
        self.run_state = "STARTING"
        self.commands: dict[str, Callable[..., Any]] = {}
        self.on_registry_change: Callable[[], None] = lambda: None
        self.diagnostics = Diagnostics(self.log, lockstep)
        self.callbacks = Callbacks(self.diagnostics, transport.set, lockstep)
        self.timers = Timers()
        self.parameters = NodeParameters(self)
        self.transforms = NodeTransforms(self)
        self.node_report: NodeReport | None = None
        self._transport = transport
        self._remaps = dict(remaps or {})
        self._workers: list[Worker] = []
        self._simulated_time: SimulatedTime | None = None
        self._stop = threading.Event()

    # -- for the node's author -------------------------------------------------------------------

    def setup(self) -> None:
        """Create publishers, subscriptions and timers. Each node overrides this."""

    def teardown(self) -> None:
        """Leave devices in a safe state. This is called once, even after an error in ``setup``."""

    def reconfigure(self, config: ConfigT) -> None:
        """Apply new values of live parameters, which the dataclass has checked, on the node's thread.

        A node that creates objects from its parameters overrides this. Create the new objects first, then call
        ``super()``.

        Raises:
            ValueError, NodeError: the values cannot be used; nothing has been changed.
        """
        self.config = config

    @classmethod
    def config_class(cls) -> type[Any]:
        """Return the dataclass of the node's parameters, from ``class X(Node[Config])``."""
        for base in getattr(cls, "__orig_bases__", ()):
            arguments = get_args(base)
            if arguments and isinstance(arguments[0], type):
                return arguments[0]
        raise TypeError(f"{cls.__name__} must derive from Node[ItsConfig]")

    @property
    def run_dir(self) -> Path | None:
        """The run directory of the node's topics; None in lockstep."""
        return self._transport.run_dir

    def resolve(self, topic: str) -> str:
        """Return the full name of a topic, with remaps and namespace applied."""
        topic = self._remaps.get(topic, topic)
        return f"/{self.namespace}{topic}" if self.namespace else topic

    def publisher(self, topic: str, message_class: Any, qos: QoS = SENSOR) -> Publisher:
        """Create a typed publisher."""
        return self.publisher_raw(topic, type_name(message_class), qos)

    def publisher_raw(self, topic: str, type_name: str, qos: QoS = SENSOR) -> Publisher:
        """Create a publisher of CDR bytes by the name of their type."""
        publisher = Publisher(self._transport.advertise(self.resolve(topic), type_name, qos))
        self.publishers.append(publisher)
        self.on_registry_change()
        return publisher

    def subscribe(
        self, topic: str, message_class: Any, callback: Callable[[Any], None], qos: QoS = SENSOR
    ) -> Subscription:
        """Subscribe to a topic; ``callback(message)`` runs on the node's thread."""
        name = type_name(message_class)

        def decode(received: Received) -> None:
            callback(deserialize(received.payload, name))

        return self.subscribe_received(topic, decode, qos, message_class)

    def subscribe_received(
        self, topic: str, callback: Callable[[Received], None], qos: QoS = RELIABLE, message_class: Any = None
    ) -> Subscription:
        """Subscribe to undecoded messages with their reception data; without ``message_class``, of any type."""
        topic = self.resolve(topic)
        name = type_name(message_class) if message_class else None
        subscription = Subscription(topic, callback)
        subscription.raw = self._transport.subscribe(topic, name, qos, self._transport.set)
        self.subscriptions.append(subscription)
        self.on_registry_change()
        return subscription

    def drop(self, item: Publisher | Subscription) -> None:
        """Close a publisher or a subscription while the node runs, for example when a bridged topic disappears."""
        item.raw.close()
        if isinstance(item, Publisher):
            self.publishers.remove(item)
        else:
            self.subscriptions.remove(item)
        self.on_registry_change()

    def latest(
        self,
        topic: str,
        message_class: Any,
        max_age_s: float,
        qos: QoS = SENSOR,
        callback: Callable[[Any], None] = lambda message: None,
    ) -> Latest:
        """Subscribe and keep the newest message of a topic; ``callback(message)`` runs after each is stored."""
        latest = Latest(self.clock, max_age_s)
        name = type_name(message_class)

        def keep(received: Received) -> None:
            message = deserialize(received.payload, name)
            latest.put(message, received)
            callback(message)

        self.subscribe_received(topic, keep, qos, message_class)
        return latest

    def timer(self, period_s: float, callback: Callable[[], None]) -> Timer:
        """Call back once per period of the node's clock. Missed periods are skipped."""
        if period_s <= 0:
            raise ValueError(f"timer period must be > 0 (got {period_s})")
        period = int(period_s * 1e9)
        timer = Timer(period, self.clock.steady_ns() + period, callback)
        self.timers.add(timer)
        self._transport.set()
        return timer

    def background(self, work: Callable[[Any], Any], on_result: Callable[[Any], None] | None = None) -> Worker:
        """Start a worker thread that runs slow work on the newest item; ``on_result`` runs on the node's thread."""
        worker = Worker(self.callbacks, work, on_result, self.lockstep)
        self._workers.append(worker)
        return worker

    def call_soon(self, function: Callable[..., None], *args: Any) -> None:
        """Run a function on the node's thread. Any thread may call this."""
        self.callbacks.call_soon(function, *args)

    def diagnose(self, name: str, level: int, message: str, **values: Any) -> None:
        """Set a named diagnosis. It is published until another one of this name replaces it."""
        self.diagnostics.set(name, level, message, **values)

    def diagnose_all(self, *states: Diagnosis | None) -> None:
        """Set the diagnoses that a library has made; None is ignored."""
        for state in states:
            if state is not None:
                self.diagnose(state.name, state.level, state.text, **state.values)

    def diagnoses(self) -> dict[str, tuple[int, str, dict[str, Any]]]:
        """Return the present diagnoses (level, message, values) by name."""
        return dict(self.diagnostics.present)

    def stop(self) -> None:
        """End the loop. Any thread and a signal handler may call this."""
        self._stop.set()
        self._transport.set()

    @property
    def stopping(self) -> bool:
        """True once the loop has been asked to end."""
        return self._stop.is_set()

    def be_patient(self, patient: bool) -> None:
        """Set whether messages wait until a timer or :meth:`call_soon` wakes the node, at least once a second.

        This suits a node whose reaction is not urgent, because a wake-up costs several times as much as handling one
        more message. The time of the wake-up becomes the messages' time of arrival.
        """
        self._transport.patient = patient

    @property
    def tf(self) -> TransformBuffer:
        """The transform buffer; the first use subscribes to ``/tf`` and ``/tf_static``."""
        return self.transforms.buffer

    # -- the loop --------------------------------------------------------------------------------

    def start(self) -> None:
        """Run ``setup``. The process or the lockstep bus calls this once."""
        if not self.lockstep:
            self.node_report = NodeReport(self)
        if self.use_sim_time:
            self._simulated_time = SimulatedTime(self, self.timers, self.transforms)
        self.callbacks.run_setup(self.setup)
        self.run_state = "RUNNING"

    def spin(self) -> None:
        """Run callbacks until :meth:`stop`."""
        next_report = 0.0
        while not self._stop.is_set():
            self._transport.clear()
            self.spin_once()
            now = time.monotonic()
            if now >= next_report:
                next_report = now + _REPORT_S
                if self.node_report is not None:
                    self.node_report.beat()
                    self.node_report.publish_diagnostics()
                self.diagnostics.end_start_grace()
            wait = next_report - now
            if (timer_ns := self.timers.next_ns()) is not None:
                due_s = (timer_ns - self.clock.steady_ns()) / 1e9
                # Simulated time may run slower or faster than the machine's, so timers are checked often.
                wait = min(wait, 0.01 if self.use_sim_time else current().wait_s(due_s))
            if not self.callbacks.soon:
                self._transport.wait(max(0.0, wait))

    def spin_once(self) -> bool:
        """Run what is due: workers' results, messages in order of arrival, timers.

        Returns:
            True if anything ran.
        """
        ran = self._run_arrived()
        now_ns = self.clock.steady_ns()
        if self.use_sim_time and now_ns == 0:
            return ran
        for timer in self.timers.due(now_ns):
            self.callbacks.run(f"timer {getattr(timer.callback, '__qualname__', '')}", timer.callback)
            ran = True
        return ran

    def _run_arrived(self) -> bool:
        ran = bool(self.callbacks.soon) and self.callbacks.run_soon()
        pending: list[tuple[int, Subscription, Received]] = []
        for subscription in self.subscriptions if self._simulated_time is None else self._simulated_time.inputs():
            for received in subscription.raw.take():
                pending.append((received.order, subscription, received))
        if len(pending) > 1:
            pending.sort(key=lambda entry: entry[0])
        for index, (_, subscription, received) in enumerate(pending):
            if index and subscription.raw.qos.depth == 1 and not self.lockstep:
                # Earlier callbacks may have taken long. For a newest-only topic, use what has arrived since.
                self._transport.wait(0.0)
                for newer in subscription.raw.take():
                    if newer.publisher == received.publisher:
                        received = newer
                    else:
                        pending.append((newer.order, subscription, newer))
            self.callbacks.run(subscription.label, subscription.callback, received)
            ran = True
        return ran

    def read_all(self) -> None:
        """Run the callbacks of all messages that have arrived, including those still in the sockets, but no timers."""
        # A wait reads one message from each of at most 64 sockets, and the rest from the sockets of the wait before.
        for _ in range(2 + len(self.subscriptions) // 64):
            self._transport.wait(0.0)
        self._run_arrived()

    def close(self) -> None:
        """Run ``teardown``, then close topics and threads."""
        self.run_state = "STOPPING"
        self._stop.set()
        try:
            try:
                if self.node_report is not None:
                    self.node_report.beat()  # so that the launcher does not take the node for dead
            finally:
                self.teardown()
        finally:
            for worker in self._workers:
                worker.stop()
            if self.node_report is not None:
                self.node_report.close()
            self._transport.close()

    def describe(self) -> dict[str, Any]:
        """Return the node's entry in the registry."""
        return {
            "name": self.node_name,
            "executable": type(self).name,
            "pid": os.getpid(),
            "params": {"use_sim_time": self.use_sim_time, "nice": self.nice, **params.to_dict(self.config)},
            "publishes": {p.topic: p.raw.type_name for p in self.publishers},
            "subscribes": {s.raw.topic: s.raw.type_name or "any" for s in self.subscriptions},
        }
