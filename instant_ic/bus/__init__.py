"""Topics between processes, with the file system as registry: node, publisher, subscriber, clock, parameters.

Names are imported on first use, so a command that only reads the registry does not load the whole bus.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from instant_ic.bus.callbacks import NodeError
    from instant_ic.bus.diagnostics import ERROR, OK, STALE, WARN
    from instant_ic.bus.node import Node
    from instant_ic.bus.process import main
    from instant_ic.bus.qos import LATCHED, RECORD, RELIABLE, SENSOR, QoS
    from instant_ic.bus.registry import RegistryError
    from instant_ic.bus.topics import Latest, Publisher, Subscription
    from instant_ic.bus.worker import Worker
    from instant_ic.config.params import ParameterError

_NAMES = {
    "bus.callbacks": "NodeError",
    "bus.diagnostics": "ERROR OK STALE WARN",
    "bus.node": "Node",
    "bus.topics": "Latest Publisher Subscription",
    "bus.worker": "Worker",
    "config.params": "ParameterError",
    "bus.process": "main",
    "bus.qos": "LATCHED RECORD RELIABLE SENSOR QoS",
    "bus.registry": "RegistryError",
}
_MODULES = {name: module for module, names in _NAMES.items() for name in names.split()}

__all__ = [
    "ERROR",
    "LATCHED",
    "OK",
    "RECORD",
    "RELIABLE",
    "SENSOR",
    "STALE",
    "WARN",
    "Latest",
    "Node",
    "NodeError",
    "ParameterError",
    "Publisher",
    "QoS",
    "RegistryError",
    "Subscription",
    "Worker",
    "main",
]


def __getattr__(name: str) -> Any:
    """Import a public name on first use."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"instant_ic.{_MODULES[name]}"), name)
    globals()[name] = value
    return value
