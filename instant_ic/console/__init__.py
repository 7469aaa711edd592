"""Operator's console: a web page, its server and a Python client.

The package does not depend on the bus. :class:`ConsoleServer` takes a :class:`ConsoleBackend` and plain values;
:class:`~instant_ic.console.feed.PageFeed` feeds it with messages; :mod:`nodes.console` connects both to the topics.
"""

from instant_ic.console.backend import ConsoleBackend
from instant_ic.console.client import ConsoleClient
from instant_ic.console.config import ConsoleServerConfig
from instant_ic.console.drive import DriveConfig, DriveGate
from instant_ic.console.protocol import FrameKind, PageFrame, PageProtocolError, decode_frame, encode_frame
from instant_ic.console.server import ConsoleError, ConsoleServer
from instant_ic.console.view import Look, ViewConfig

__all__ = [
    "ConsoleBackend",
    "ConsoleClient",
    "ConsoleError",
    "ConsoleServer",
    "ConsoleServerConfig",
    "DriveConfig",
    "DriveGate",
    "FrameKind",
    "Look",
    "PageFrame",
    "PageProtocolError",
    "ViewConfig",
    "decode_frame",
    "encode_frame",
]
