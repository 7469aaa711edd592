"""Operator's console: a web page, its server and a Python client.

:class:`ConsoleServer` knows no messages, only plain values and a :class:`ConsoleBackend`.
:class:`~instant_ic.console.feed.PageFeed` converts messages for it. :mod:`nodes.console` connects both to the topics.
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
