"""Topics over ZeroMQ, with the file system as registry: node, publisher, subscriber, clock, parameters."""

from .main import main
from .node import ERROR, OK, STALE, WARN, Latest, Node, NodeError, Publisher, Subscription, Worker
from .params import ParameterError
from .qos import LATCHED, RECORD, RELIABLE, SENSOR, QoS
from .registry import RegistryError

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
