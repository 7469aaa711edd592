"""The part of a node that its own objects use."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, ClassVar, Protocol

from instant_ic.bus.clock import Clock
from instant_ic.bus.diagnostics import Diagnostics
from instant_ic.bus.qos import QoS
from instant_ic.bus.topics import Publisher, Subscription


class NodeInterface(Protocol):
    """See :class:`instant_ic.bus.node.Node`."""

    live_parameters: ClassVar[tuple[str, ...]]
    node_name: str
    config: Any
    clock: Clock
    log: logging.Logger
    use_sim_time: bool
    nice: int
    run_state: str
    publishers: list[Publisher]
    subscriptions: list[Subscription]
    diagnostics: Diagnostics
    on_registry_change: Callable[[], None]

    def publisher(self, topic: str, message_class: Any, qos: QoS = ...) -> Publisher: ...

    def subscribe(
        self, topic: str, message_class: Any, callback: Callable[[Any], None], qos: QoS = ...
    ) -> Subscription: ...

    def diagnose(self, name: str, level: int, message: str, **values: Any) -> None: ...

    def reconfigure(self, config: Any) -> None: ...
