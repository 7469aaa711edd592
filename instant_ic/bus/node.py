"""Base class of nodes: parameters, topics, timers, clock, transforms, heartbeat and diagnostics."""

from __future__ import annotations

import dataclasses
import heapq
import itertools
import logging
import mmap
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar, get_args

import numpy as np

from instant_ic.bus.clock import Clock, JumpDetector, ManualClock
from instant_ic.bus.flow_report import RECENT_S, FlowReport
from instant_ic.bus.parameter_event import TOPIC as PARAMETER_EVENTS
from instant_ic.bus.parameter_event import parameter_event
from instant_ic.bus.qos import LATCHED, RELIABLE, SENSOR, QoS
from instant_ic.bus.transport import Payload, RawPublisher, RawSubscription, Received, Transport
from instant_ic.config import params
from instant_ic.config.parameter_info import ParameterInfo, is_live, parameter_infos, plain
from instant_ic.geometry.poses import Matrix
from instant_ic.geometry.transforms import TransformBuffer, TransformError
from instant_ic.msg import (
    MessageError,
    deserialize,
    header,
    message_type,
    serializer,
    stamp_ns,
    to_time,
    transform_matrix,
    transform_message,
    type_name,
)
from instant_ic.util.diagnosis import Diagnosis
from instant_ic.util.pace import current
from instant_ic.util.safe_text import masked

OK, WARN, ERROR, STALE = 0, 1, 2, 3
"""Levels of a diagnosis, as in diagnostic_msgs/DiagnosticStatus."""

ConfigT = TypeVar("ConfigT")

_REPORT_S = 1.0  # period of heartbeat and diagnostics, which also sees a stop flag set by a signal
_WENT_BACK_NS = 100_000_000  # a simulated clock that goes back farther resets timers and transforms; less is jitter
_START_GRACE_S = 15.0  # how long after its start a node may wait for others without a warning in the log
_NO_CLOCK_S = 5.0


class NodeError(RuntimeError):
    """A fault that its message fully explains. Raised in ``setup``, it ends the process without a traceback."""


class Publisher:
    """Typed publisher; :meth:`publish` may be called from any thread."""

    def __init__(self, raw: RawPublisher) -> None:
        self.raw = raw
        self.topic = raw.topic

    @property
    def subscriber_count(self) -> int:
        """Number of connected readers; an image that nobody receives need not be made."""
        return self.raw.subscriber_count

    def publish(self, message: Any) -> None:
        """Send one message.

        Raises:
            MessageError: the message is of another type, or a field has a wrong value.
        """
        if type_name(message) != self.raw.type_name:
            raise MessageError(f"{self.topic} carries {self.raw.type_name}, not {type_name(message)}")
        self.raw.send_filled(*serializer(message))

    def publish_bytes(self, payload: Payload, publish_ns: int | None = None) -> None:
        """Send CDR bytes as they are: one buffer, or several in a row.

        Args:
            payload: must not be changed afterwards; it may still be on its way.
            publish_ns: publication time of a forwarded message; default: now.
        """
        self.raw.send(payload, publish_ns)


class Subscription:
    """A subscribed topic with its callback."""

    def __init__(self, topic: str, callback: Callable[[Received], None]) -> None:
        self.label = f"callback of {topic}"
        self.callback = callback
        self.raw: RawSubscription  # set by the node right after construction

    def close(self) -> None:
        self.raw.close()


class Latest:
    """The newest message of a topic, as long as it is fresh."""

    def __init__(self, clock: Clock, max_age_s: float) -> None:
        self._clock = clock
        self.max_age_s = max_age_s
        self._message: Any = None
        self._received_ns = 0  # on the steady clock, so that setting the machine's clock changes no age
        self._given_ns = 0
        self.instances: dict[str, bytes] = {}
        """Publishers by the name of their node, as in :class:`Received`."""

    def put(self, message: Any, received: Received) -> None:
        """Store a newer message with its reception data."""
        self._message, self._received_ns = message, received.steady_ns
        self.note(received)
        self._given_ns = received.given_ns(stamp_ns(message)) if hasattr(message, "header") else received.steady_ns

    def note(self, received: Received) -> None:
        """Note the publisher of a message that is not stored."""
        self.instances[received.publisher] = received.instance

    def forget(self) -> None:
        """Drop the message, as before the first."""
        self._message = None

    @property
    def message(self) -> Any:
        """The newest message, or None when there is none younger than ``max_age_s``."""
        return self._message if self.age_s <= self.max_age_s else None

    @property
    def fresh(self) -> Any:
        """The newest message, or None when it was measured or commanded more than ``max_age_s`` ago.

        For what a robot drives by: a message that waited while this node was busy counts as newly arrived.
        """
        return self._message if self.stamp_age_s <= self.max_age_s else None

    @property
    def age_s(self) -> float:
        """Seconds since the message arrived; inf before the first."""
        return self._since_s(self._received_ns)

    @property
    def stamp_age_s(self) -> float:
        """Seconds since it was measured or commanded (:meth:`Received.given_ns`); inf before the first."""
        return self._since_s(self._given_ns)

    def _since_s(self, instant_ns: int) -> float:
        if self._message is None:
            return float("inf")
        age_ns = self._clock.steady_ns() - instant_ns
        # From the future: the clock has been set back since, for example when a player restarts.
        return age_ns / 1e9 if age_ns >= -_WENT_BACK_NS else float("inf")


class Worker:
    """Runs slow work in a thread beside the node's, on the newest item only; in lockstep it runs inline."""

    def __init__(self, node: Node[Any], work: Callable[[Any], Any], on_result: Callable[[Any], None] | None) -> None:
        self._node = node
        self._work = work
        self._on_result = on_result
        self._condition = threading.Condition()
        self._item: list[Any] = []
        self._stopped = False
        self.busy = False
        self.skipped = 0
        self._thread: threading.Thread | None = None
        if not node.lockstep:
            self._thread = threading.Thread(target=self._run, name=getattr(work, "__name__", "work"), daemon=True)
            self._thread.start()

    def submit(self, item: Any) -> None:
        """Hand over an item. It replaces an item that is still waiting, which is counted in ``skipped``."""
        if self._thread is None:
            self._do(item)
            return
        with self._condition:
            self.skipped += len(self._item)
            self._item, self.busy = [item], True
            self._condition.notify()

    def stop(self, timeout_s: float = 3.0) -> None:
        """End the thread after the current item; waits at most ``timeout_s``."""
        with self._condition:
            self._stopped = True
            self._item = []
            self._condition.notify()
        if self._thread is not None:
            self._thread.join(timeout_s)

    def _run(self) -> None:
        while True:
            with self._condition:
                self.busy = False
                while not self._item and not self._stopped:
                    self._condition.wait()
                if self._stopped:
                    return
                item = self._item.pop()
                self.busy = True
            self._do(item)

    def _do(self, item: Any) -> None:
        try:
            result = self._work(item)
        except Exception as error:  # noqa: BLE001 - a node survives a bad item; the fault is logged with its traceback
            self._node.call_soon(self._node.fault, f"background {getattr(self._work, '__name__', 'work')}", error)
            return
        if self._on_result is not None:
            self._node.call_soon(self._on_result, result)


@dataclasses.dataclass(eq=False)
class Timer:
    """A callback once per period."""

    period_ns: int
    due_ns: int
    callback: Callable[[], None]
    cancelled: bool = False

    def cancel(self) -> None:
        """Stop the timer; it never fires again."""
        self.cancelled = True


class Node(Generic[ConfigT]):
    """Base class of every process of the stack; docs/architecture.md explains how to write one.

    Args:
        config: typed parameters.
        transport: topics.
        clock: time; a :class:`ManualClock` where ``/clock`` or a test sets it.
        name: used instead of the class's name.
        namespace: prefix of every topic.
        remaps: topic → topic, applied before the namespace.
        lockstep: no threads and no heartbeat; the bus drives the node.
        use_sim_time: the clock follows ``/clock``; callbacks wait for its first value.
    """

    name: ClassVar[str] = "node"
    live_parameters: ClassVar[tuple[str, ...]] = ()
    """Parameters, or whole groups, that can be changed while the node runs. These are the parameters that the node
    reads from ``self.config`` at each use, and those that its :meth:`reconfigure` applies. ``"*"`` means all."""

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
        self._transport = transport
        self._remaps = dict(remaps or {})
        self._timers: list[tuple[int, int, Timer]] = []
        self._timer_orders = itertools.count()
        self._soon: deque[tuple[Callable[..., None], tuple[Any, ...]]] = deque()
        self._stop = threading.Event()
        self._workers: list[Worker] = []
        self._diagnoses: dict[str, tuple[int, str, dict[str, Any]]] = {}
        self._faults = 0
        self._tf: TransformBuffer | None = None
        self._tf_out: Publisher | None = None
        self._tf_static_out: Publisher | None = None
        self._tf_static: dict[str, Any] = {}
        self._state = "STARTING"
        self.commands: dict[str, Callable[..., Any]] = {}
        """Commands that the control channel's ``call`` can run: name → function with keyword arguments. The result goes
        back as JSON; a ``ValueError`` or :class:`NodeError` goes back as the reason of a refusal."""
        self._clock_in: Subscription | None = None
        self._began_s = time.monotonic()
        self._flows = FlowReport(time.monotonic_ns())
        self._failed_at: dict[str, float] = {}  # callback or timer -> monotonic time of its newest exception
        self._well: set[str] = set()  # diagnoses that have been OK before
        self._waiting: set[str] = set()  # diagnoses never OK so far, logged as information only
        self._running: tuple[str, float] | None = None
        self._load = time.process_time(), self._began_s  # CPU seconds of the process, and when
        self._parameter_events: Publisher | None = None
        self.on_registry_change: Callable[[], None] | None = None

    # -- for the node's author -------------------------------------------------------------------

    def setup(self) -> None:
        """Create publishers, subscriptions and timers; overridden by each node."""

    def teardown(self) -> None:
        """Leave devices in a safe state; called once, also after an error in ``setup``."""

    def reconfigure(self, config: ConfigT) -> None:
        """Apply new values of live parameters, already checked by the dataclass; runs on the node's thread.

        A node that builds something from its parameters overrides this: build the new object first, then call
        ``super()``.

        Raises:
            ValueError, NodeError: the values cannot be used; nothing has been changed.
        """
        self.config = config

    @classmethod
    def config_class(cls) -> type[Any]:
        """The dataclass given in ``class X(Node[Config])``."""
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
        """Name of a topic after remaps and namespace."""
        topic = self._remaps.get(topic, topic)
        return f"/{self.namespace}{topic}" if self.namespace else topic

    def publisher(self, topic: str, message_class: Any, qos: QoS = SENSOR) -> Publisher:
        """Create a typed publisher."""
        return self.publisher_raw(topic, type_name(message_class), qos)

    def publisher_raw(self, topic: str, type_name: str, qos: QoS = SENSOR) -> Publisher:
        """Create a publisher by type name, for bytes that are not decoded here."""
        publisher = Publisher(self._transport.advertise(self.resolve(topic), type_name, qos))
        self.publishers.append(publisher)
        self._registry_changed()
        return publisher

    def subscribe(
        self, topic: str, message_class: Any, callback: Callable[[Any], None], qos: QoS = SENSOR
    ) -> Subscription:
        """Subscribe; ``callback(message)`` runs on the node's thread."""
        name = type_name(message_class)

        def decode(received: Received) -> None:
            callback(deserialize(received.payload, name))

        return self._subscribe(topic, name, decode, qos)

    def subscribe_received(
        self, topic: str, callback: Callable[[Received], None], qos: QoS = RELIABLE, message_class: Any = None
    ) -> Subscription:
        """Subscribe to bytes, with all that is known of a message; without ``message_class`` to any type."""
        return self._subscribe(topic, type_name(message_class) if message_class else None, callback, qos)

    def drop(self, item: Publisher | Subscription) -> None:
        """Close a publisher or a subscription while the node runs, for example when a bridged topic disappears."""
        item.raw.close()
        if isinstance(item, Publisher):
            self.publishers.remove(item)
        else:
            self.subscriptions.remove(item)
        self._registry_changed()

    def latest(
        self,
        topic: str,
        message_class: Any,
        max_age_s: float,
        qos: QoS = SENSOR,
        callback: Callable[[Any], None] = lambda message: None,
    ) -> Latest:
        """Subscribe and keep the newest message of a topic; ``callback(message)`` runs once it is stored."""
        latest = Latest(self.clock, max_age_s)
        name = type_name(message_class)

        def keep(received: Received) -> None:
            message = deserialize(received.payload, name)
            latest.put(message, received)
            callback(message)

        self._subscribe(topic, name, keep, qos)
        return latest

    def timer(self, period_s: float, callback: Callable[[], None]) -> Timer:
        """Call back once per period of the node's clock; missed periods are not caught up."""
        if period_s <= 0:
            raise ValueError(f"timer period must be > 0 (got {period_s})")
        period = int(period_s * 1e9)
        timer = Timer(period, self.clock.steady_ns() + period, callback)
        heapq.heappush(self._timers, (timer.due_ns, next(self._timer_orders), timer))
        self._transport.set()
        return timer

    def background(self, work: Callable[[Any], Any], on_result: Callable[[Any], None] | None = None) -> Worker:
        """Start a worker thread for slow work on the newest item; ``on_result`` runs on the node's thread."""
        worker = Worker(self, work, on_result)
        self._workers.append(worker)
        return worker

    def call_soon(self, function: Callable[..., None], *args: Any) -> None:
        """Run a function on the node's thread; may be called from any thread."""
        self._soon.append((function, args))
        self._transport.set()

    def diagnose(self, name: str, level: int, message: str, **values: Any) -> None:
        """Set a named diagnosis; it is published until the next one of that name."""
        before = self._diagnoses.get(name)
        message = masked(message)
        self._diagnoses[name] = (level, message, values)
        if level >= WARN and (before is None or before[0] != level):
            self._log_diagnosis(name, level, message)
        elif level == OK:
            self._well.add(name)
            self._waiting.discard(name)
            if before is not None and before[0] >= WARN:
                self.log.info("%s: %s", name, message or "fine again")

    def diagnose_all(self, *states: Diagnosis | None) -> None:
        """Set the diagnoses that a library has made; None is left out."""
        for state in states:
            if state is not None:
                self.diagnose(state.name, state.level, state.text, **state.values)

    def _log_diagnosis(self, name: str, level: int, message: str) -> None:
        """Log a diagnosis; one that was never OK is logged once, as information, while other nodes still start."""
        if not self.lockstep and name not in self._well and time.monotonic() < self._began_s + _START_GRACE_S:
            if name not in self._waiting:
                self._waiting.add(name)
                self.log.info("%s: %s", name, message)
            return
        self.log.log(logging.WARNING if level == WARN else logging.ERROR, "%s: %s", name, message)

    def _end_start_grace(self) -> None:
        """Log what is still wrong at the end of the start-up grace period, at its own level."""
        for name in sorted(self._waiting) if time.monotonic() >= self._began_s + _START_GRACE_S else ():
            self._waiting.discard(name)
            level, message, _ = self._diagnoses[name]
            self._log_diagnosis(name, level, message)

    def stop(self) -> None:
        """End the loop; may be called from any thread and from a signal handler."""
        self._stop.set()
        self._transport.set()

    @property
    def starting(self) -> bool:
        """Whether ``setup`` has not finished yet."""
        return self._state == "STARTING"

    @property
    def stopping(self) -> bool:
        """Whether the loop has been asked to end."""
        return self._stop.is_set()

    def be_patient(self, patient: bool) -> None:
        """Let messages wait until a timer or :meth:`call_soon` wakes the node, at least once a second, or no longer.

        For a node that nobody waits for: a wake-up costs several times what a further message costs in the same
        wake-up. Messages get the time of the wake-up as their time of arrival.
        """
        self._transport.patient = patient

    # -- parameters and log level while it runs ---------------------------------------------------

    def parameters(self) -> list[ParameterInfo]:
        """All parameters with their present values; may be called from any thread."""
        infos = parameter_infos(type(self.config), self.config, self.live_parameters)
        own = {info.name for info in infos}
        process = params.ProcessParameters(self.use_sim_time, self.nice)
        common = parameter_infos(params.ProcessParameters, process)
        return infos + [info for info in common if info.name not in own]

    def set_parameters(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Change live parameters together, or none; returns those whose value changed. Runs on the node's thread.

        Raises:
            ParameterError: a value is refused, or its parameter takes effect only at the start.
        """
        own = {field.name for field in dataclasses.fields(type(self.config))}  # type: ignore[arg-type]
        flat = params.flatten(values)
        shared = ("use_sim_time", "nice")
        common: dict[str, Any] = {key: flat.pop(key) for key in shared if key in flat and key not in own}
        process = params.ProcessParameters(self.use_sim_time, self.nice)
        params.change(process, common, lambda key: False, self.node_name)
        config, different = params.change(
            self.config, flat, lambda key: is_live(key, self.live_parameters), self.node_name
        )
        if not different:
            return {}
        try:
            self.reconfigure(config)
        except (ValueError, NodeError) as error:
            raise params.ParameterError(f"{self.node_name}: {error}") from error
        different = {key: plain(value) for key, value in different.items()}
        self.log.info("parameters changed: %s", ", ".join(f"{key} = {value}" for key, value in different.items()))
        if self._parameter_events is not None:
            self._parameter_events.publish(parameter_event(self.node_name, different, self.clock.now_ns()))
        self._registry_changed()
        return different

    def set_log_level(self, level: str) -> None:
        """Set the log level of this node and the library: ``debug``, ``info``, ``warning`` or ``error``."""
        for name in _loggers(self):
            logging.getLogger(name).setLevel(level.upper())

    def activity(self) -> tuple[str, float]:
        """The callback that the node's thread is running, and for how many seconds; ("", 0) when it is idle."""
        running = self._running
        return ("", 0.0) if running is None else (running[0], time.monotonic() - running[1])

    # -- transforms ------------------------------------------------------------------------------

    @property
    def tf(self) -> TransformBuffer:
        """The transform buffer; the first use subscribes to ``/tf`` and ``/tf_static``."""
        if self._tf is None:
            self._tf = TransformBuffer()
            transforms = message_type("TFMessage")
            self.subscribe("/tf", transforms, lambda m: self._on_tf(m, False), RELIABLE)
            self.subscribe("/tf_static", transforms, lambda m: self._on_tf(m, True), LATCHED)
        return self._tf

    def _on_tf(self, message: Any, static: bool) -> None:
        assert self._tf is not None
        for transform in message.transforms:
            try:
                self._tf.set(
                    transform.header.frame_id,
                    transform.child_frame_id,
                    stamp_ns(transform),
                    transform_matrix(transform),
                    static,
                    self.clock.now_ns(),
                )
            except (TransformError, MessageError) as error:
                self.diagnose("tf", ERROR, str(error))

    def tf_broadcast(self, parent: str, child: str, parent_from_child: Matrix, stamp: int) -> None:
        """Publish one transform on ``/tf``."""
        transforms = message_type("TFMessage")
        if self._tf_out is None:
            self._tf_out = self.publisher("/tf", transforms, RELIABLE)
        self._tf_out.publish(transforms([transform_message(parent_from_child, parent, child, stamp)]))

    def tf_broadcast_static(self, parent: str, child: str, parent_from_child: Matrix) -> None:
        """Publish a fixed transform on ``/tf_static``, together with the node's other fixed transforms."""
        transforms = message_type("TFMessage")
        if self._tf_static_out is None:
            self._tf_static_out = self.publisher("/tf_static", transforms, LATCHED)
        self._tf_static[child] = transform_message(parent_from_child, parent, child, self.clock.now_ns())
        self._tf_static_out.publish(transforms(list(self._tf_static.values())))

    # -- the loop --------------------------------------------------------------------------------

    def start(self) -> None:
        """Run ``setup``; called once by whatever drives the node."""
        if not self.lockstep:
            self._rosout = self.publisher("/rosout", message_type("Log"), RELIABLE)
            for name in _loggers(self):
                logging.getLogger(name).addHandler(_RosoutHandler(self))
            self._parameter_events = self.publisher(PARAMETER_EVENTS, message_type("ParameterEvent"), RELIABLE)
            self._heartbeat = self.publisher("/heartbeat", message_type("NodeStatus"), RELIABLE)
            self._diagnostics = self.publisher("/diagnostics", message_type("DiagnosticArray"), RELIABLE)
            self._beat()
        if self.use_sim_time:
            self._clock_in = self.subscribe("/clock", message_type("Clock"), self._on_clock, RELIABLE)
        self._running = ("setup", time.monotonic())
        self.setup()
        self._running = None
        self._state = "RUNNING"

    def _on_clock(self, message: Any) -> None:
        assert isinstance(self.clock, ManualClock)
        before_ns, now_ns = self.clock.now_ns(), stamp_ns(message.clock)
        self.clock.set(now_ns)
        went_back = now_ns < before_ns - _WENT_BACK_NS
        if went_back:
            self.log.warning(
                "simulated time went back %.1f s: timers restart, moving transforms are dropped",
                (before_ns - now_ns) / 1e9,
            )
        if went_back or before_ns == 0:
            for entry in self._timers:
                entry[2].due_ns = now_ns + entry[2].period_ns
            self._timers = [(timer.due_ns, order, timer) for _, order, timer in self._timers]
            heapq.heapify(self._timers)
        if went_back and self._tf is not None:
            self._tf.forget_moving()

    def _inputs(self) -> list[Subscription]:
        """Subscriptions to read now; before simulated time has started, only ``/clock``."""
        if self._clock_in is None:
            return self.subscriptions
        if self.clock.now_ns() > 0:
            if self._diagnoses.get("simulated time", (OK,))[0] != OK:
                self.diagnose("simulated time", OK, "running")
            return self.subscriptions
        if time.monotonic() > self._began_s + _NO_CLOCK_S:
            self.diagnose("simulated time", WARN, f"use_sim_time is set, waiting for {self._clock_in.raw.topic}")
        return [self._clock_in]

    def spin(self) -> None:
        """Run callbacks until :meth:`stop`."""
        next_report = 0.0
        system_clock = JumpDetector()
        while not self._stop.is_set():
            self._transport.clear()
            self.spin_once()
            now = time.monotonic()
            if now >= next_report:
                next_report = now + _REPORT_S
                self._beat()
                self._publish_diagnostics()
                self._end_start_grace()
                if (jump_s := system_clock.jump_s()) and not self.use_sim_time:
                    self.log.warning(
                        "the machine's clock was set by %+.1f s: stamps jump, timers are not affected", jump_s
                    )
            wait = next_report - now
            if self._timers:
                due = (self._timers[0][0] - self.clock.steady_ns()) / 1e9
                # Simulated time may run slower or faster than the machine's, so its timers are checked often.
                wait = min(wait, 0.01 if self.use_sim_time else current().wait_s(due))
            if self._soon:
                continue
            self._transport.wait(max(0.0, wait))

    def spin_once(self) -> bool:
        """Run what is due: results of workers, messages in order of arrival, timers. True if anything ran."""
        ran = self._run_arrived()
        return self._fire_timers() or ran

    def _run_arrived(self) -> bool:
        ran = False
        while self._soon:
            function, args = self._soon.popleft()
            label = getattr(function, "__qualname__", "callback")
            self._guard(label, function, *args)
            self._failed_at.pop(label, None)  # called once: that another call succeeds mends nothing
            ran = True
        pending: list[tuple[int, Subscription, Received]] = []
        for subscription in self._inputs():
            for received in subscription.raw.take():
                pending.append((received.order, subscription, received))
        if len(pending) > 1:
            pending.sort(key=lambda entry: entry[0])
        for index, (_, subscription, received) in enumerate(pending):
            if index and subscription.raw.qos.depth == 1 and not self.lockstep:
                # Earlier callbacks may have taken long: for a newest-only topic, use what has arrived since.
                self._transport.wait(0.0)
                for newer in subscription.raw.take():
                    if newer.publisher == received.publisher:
                        received = newer
                    else:
                        pending.append((newer.order, subscription, newer))
            self._guard(subscription.label, subscription.callback, received)
            ran = True
        return ran

    def read_all(self) -> None:
        """Run the callbacks of all messages that have arrived, also of those still in the sockets, but no timers."""
        # A wait reads one message of each of 64 sockets at most, and all that is left in those of the wait before it.
        for _ in range(2 + len(self.subscriptions) // 64):
            self._transport.wait(0.0)
        self._run_arrived()

    def _fire_timers(self) -> bool:
        fired = False
        now = self.clock.steady_ns()
        if self.use_sim_time and now == 0:
            return False
        while self._timers and self._timers[0][0] <= now:
            _, _, timer = heapq.heappop(self._timers)
            if timer.cancelled:
                continue
            # On a fixed grid of periods: no drift, and no burst after a pause.
            timer.due_ns += timer.period_ns * ((now - timer.due_ns) // timer.period_ns + 1)
            heapq.heappush(self._timers, (timer.due_ns, next(self._timer_orders), timer))
            self._guard(f"timer {getattr(timer.callback, '__qualname__', '')}", timer.callback)
            fired = True
        return fired

    def next_timer_ns(self) -> int | None:
        """Time of the next timer; for the lockstep bus."""
        while self._timers and self._timers[0][2].cancelled:
            heapq.heappop(self._timers)
        return self._timers[0][0] if self._timers else None

    def due(self) -> bool:
        """Whether results of workers or timers are due; for the lockstep bus."""
        timer_ns = self.next_timer_ns()
        return bool(self._soon) or (timer_ns is not None and timer_ns <= self.clock.steady_ns())

    def _guard(self, what: str, function: Callable[..., None], *args: Any) -> None:
        self._running = (what, started_s := time.monotonic())
        try:
            function(*args)
            if what in self._failed_at and started_s > self._failed_at[what] + RECENT_S:
                del self._failed_at[what]
                self.diagnose(what, OK, f"no exception in the last {RECENT_S:g} s", faults=self._faults)
        except NodeError as error:
            self._faults += 1
            self._failed_at[what] = time.monotonic()
            self.diagnose(what, ERROR, str(error))
        except Exception as error:  # noqa: BLE001 - one bad message must not end a node that moves a robot
            self.fault(what, error)
        finally:
            self._running = None

    def fault(self, what: str, error: Exception) -> None:
        """Log an exception with its traceback, and count it."""
        self._faults += 1
        self._failed_at[what] = time.monotonic()
        self.log.error("%s: %s: %s", what, type(error).__name__, error, exc_info=error)
        self._diagnoses[what] = (ERROR, masked(f"{type(error).__name__}: {error}"), {"faults": self._faults})
        if self.lockstep:
            raise error

    def close(self) -> None:
        """Run ``teardown``, then close topics and threads."""
        self._state = "STOPPING"
        self._stop.set()
        try:
            try:
                if hasattr(self, "_heartbeat"):
                    self._beat()  # so that nobody takes the node for dead
            finally:
                self.teardown()
        finally:
            for worker in self._workers:
                worker.stop()
            if not self.lockstep:
                for logger in map(logging.getLogger, _loggers(self)):
                    for handler in [h for h in logger.handlers if isinstance(h, _RosoutHandler) and h.node is self]:
                        logger.removeHandler(handler)
            self._transport.close()

    # -- what every node reports -----------------------------------------------------------------

    @property
    def level(self) -> int:
        """The worst level of the present diagnoses."""
        return max((level for level, _, _ in self._diagnoses.values()), default=OK)

    def diagnoses(self) -> dict[str, tuple[int, str, dict[str, Any]]]:
        """The present diagnoses by name: level, message, values."""
        return dict(self._diagnoses)

    def _beat(self) -> None:
        now = self.clock.steady_ns()
        status = message_type("NodeStatus")
        state = "DEGRADED" if self._state == "RUNNING" and self.level >= ERROR else self._state
        worst = max(self._diagnoses.values(), default=(OK, "", {}), key=lambda d: d[0])
        inputs = [s.raw for s in self.subscriptions]
        outputs = [p.raw for p in self.publishers]
        losses = [(s.topic, node, count) for s in inputs for node, count in sorted(s.stats.lost_by.items())]
        cpu_s, at_s = time.process_time(), time.monotonic()
        before_cpu_s, before_s = self._load
        self._load = cpu_s, at_s
        self._heartbeat.publish(
            status(
                header=header("", time.time_ns()),
                node=self.node_name,
                pid=os.getpid(),
                state=getattr(status, state),
                message=worst[1] if worst[0] >= WARN else "",
                cpu_percent=100.0 * (cpu_s - before_cpu_s) / max(at_s - before_s, 1e-3),
                rss_mb=int(Path("/proc/self/statm").read_text().split()[1]) * mmap.PAGESIZE / 1e6,
                inputs=[s.topic for s in inputs],
                input_rates_hz=np.array([s.stats.rate_hz(now) for s in inputs], np.float32),
                input_ages_s=np.array([s.stats.age_s(now) for s in inputs], np.float32),
                input_lost=np.array([s.stats.lost for s in inputs], np.uint64),
                lost_topics=[topic for topic, _, _ in losses],
                lost_publishers=[node for _, node, _ in losses],
                lost_counts=np.array([count for _, _, count in losses], np.uint64),
                outputs=[p.topic for p in outputs],
                output_rates_hz=np.array([p.stats.rate_hz(now) for p in outputs], np.float32),
                output_ages_s=np.array([p.stats.age_s(now) for p in outputs], np.float32),
            )
        )

    def _publish_diagnostics(self) -> None:
        flows: list[Diagnosis] = []
        now, report_ns = self.clock.steady_ns(), time.monotonic_ns()
        for subscription in self.subscriptions:
            stats, topic = subscription.raw.stats, subscription.raw.topic
            values = {"rate_hz": round(stats.rate_hz(now), 2), "age_s": round(stats.age_s(now), 3)}
            flows += self._flows.input(topic, stats, values, report_ns)
        for publisher in self.publishers:
            flows += self._flows.output(publisher.topic, publisher.raw.stats, report_ns)
        found = self._diagnoses | {flow.name: (int(flow.level), flow.text, dict(flow.values)) for flow in flows}
        status, key_value = message_type("DiagnosticStatus"), message_type("diagnostic_msgs/KeyValue")
        entries = [
            status(
                level=level,
                name=f"{self.node_name}: {name}",
                message=text,
                hardware_id="",
                values=[key_value(key=str(key), value=str(value)) for key, value in values.items()],
            )
            for name, (level, text, values) in found.items()
        ]
        self._diagnostics.publish(message_type("DiagnosticArray")(header=header("", time.time_ns()), status=entries))

    # -- internals -------------------------------------------------------------------------------

    def _subscribe(self, topic: str, name: str | None, callback: Callable[[Received], None], qos: QoS) -> Subscription:
        topic = self.resolve(topic)
        subscription = Subscription(topic, callback)
        subscription.raw = self._transport.subscribe(topic, name, qos, self._transport.set)
        self.subscriptions.append(subscription)
        self._registry_changed()
        return subscription

    def _registry_changed(self) -> None:
        if self.on_registry_change is not None:
            self.on_registry_change()

    def describe(self) -> dict[str, Any]:
        """The node's entry in the registry."""
        return {
            "name": self.node_name,
            "executable": type(self).name,
            "pid": os.getpid(),
            "params": {"use_sim_time": self.use_sim_time, "nice": self.nice, **params.to_dict(self.config)},
            "publishes": {p.topic: p.raw.type_name for p in self.publishers},
            "subscribes": {s.raw.topic: s.raw.type_name or "any" for s in self.subscriptions},
        }


def _loggers(node: Node[Any]) -> tuple[str, str]:
    """Names of the node's own logger and of the library's, whose modules do not know the node."""
    return node.node_name, "instant_ic"


class _RosoutHandler(logging.Handler):
    """Publishes a node's log records on ``/rosout``."""

    _LEVELS: ClassVar = {logging.DEBUG: 10, logging.INFO: 20, logging.WARNING: 30, logging.ERROR: 40}

    def __init__(self, node: Node[Any]) -> None:
        super().__init__()
        self.node = node
        self._log_type = message_type("Log")

    def emit(self, record: logging.LogRecord) -> None:
        try:
            self.node._rosout.publish(
                self._log_type(
                    stamp=to_time(int(record.created * 1e9)),
                    level=self._LEVELS.get(record.levelno, 50),
                    name=self.node.node_name,
                    msg=masked(record.getMessage()).encode(errors="replace").decode(),
                    file=record.pathname,
                    function=record.funcName or "",
                    line=record.lineno,
                )
            )
        except Exception:  # noqa: BLE001 - a bad log line must not end the callback that wrote it
            self.handleError(record)
