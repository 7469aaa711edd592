"""Clock of a node that follows ``/clock``."""

from __future__ import annotations

import time
from typing import Any

from instant_ic.bus.clock import ManualClock
from instant_ic.bus.diagnostics import OK, WARN
from instant_ic.bus.node_interface import NodeInterface
from instant_ic.bus.node_transforms import NodeTransforms
from instant_ic.bus.qos import RELIABLE
from instant_ic.bus.timers import Timers
from instant_ic.bus.topics import WENT_BACK_NS, Subscription
from instant_ic.msg import message_type, stamp_ns

_NO_CLOCK_S = 5.0


class SimulatedTime:
    """Sets a node's clock. A step back restarts the node's timers and drops its moving transforms."""

    def __init__(self, node: NodeInterface, timers: Timers, transforms: NodeTransforms) -> None:
        assert isinstance(node.clock, ManualClock)
        self._timers = timers
        self._transforms = transforms
        self._node = node
        self._clock = node.clock
        self._warn_at_s = time.monotonic() + _NO_CLOCK_S
        self._waited = False
        self.subscription = node.subscribe("/clock", message_type("Clock"), self._on_clock, RELIABLE)

    def inputs(self) -> list[Subscription]:
        """Return the subscriptions to read now: only ``/clock`` before simulated time has started."""
        if self._clock.now_ns() > 0:
            if self._waited:
                self._waited = False
                self._node.diagnose("simulated time", OK, "running")
            return self._node.subscriptions
        if time.monotonic() > self._warn_at_s:
            self._waited = True
            text = f"use_sim_time is set, waiting for {self.subscription.raw.topic}"
            self._node.diagnose("simulated time", WARN, text)
        return [self.subscription]

    def _on_clock(self, message: Any) -> None:
        before_ns, now_ns = self._clock.now_ns(), stamp_ns(message.clock)
        self._clock.set(now_ns)
        went_back = now_ns < before_ns - WENT_BACK_NS
        if went_back:
            self._node.log.warning(
                "simulated time went back %.1f s: timers restart, moving transforms are dropped",
                (before_ns - now_ns) / 1e9,
            )
            self._transforms.forget_moving()
        if went_back or before_ns == 0:
            self._timers.restart(now_ns)
