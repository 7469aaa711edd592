"""Operator's console: a web page, its server and a Python client.

:class:`ConsoleServer` takes a :class:`ConsoleBackend` and plain values. :class:`~instant_ic.console.feed.PageFeed`
feeds it with messages. :mod:`nodes.console` connects both to the topics.
"""

from instant_ic.console.backend import ConsoleBackend
from instant_ic.console.client import ConsoleClient
from instant_ic.console.config import ConsoleServerConfig
from instant_ic.console.protocol import FrameKind, PageProtocolError
from instant_ic.console.server import ConsoleError, ConsoleServer
from instant_ic.console.view import Look, ViewConfig

__all__ = [
    "ConsoleBackend",
    "ConsoleClient",
    "ConsoleError",
    "ConsoleServer",
    "ConsoleServerConfig",
    "FrameKind",
    "Look",
    "PageProtocolError",
    "ViewConfig",
]
