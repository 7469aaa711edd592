"""The former name of the transport; import :mod:`.local_transport` instead."""

from .local_subscription import LocalSubscription as ZmqSubscription
from .local_transport import LocalTransport as ZmqTransport

__all__ = ["ZmqSubscription", "ZmqTransport"]
