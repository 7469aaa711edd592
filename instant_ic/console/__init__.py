"""Operator's console: a web page, its server and a Python client.

The package does not depend on the bus. :class:`ConsoleServer` takes a :class:`Backend` and plain values;
:class:`~instant_ic.console.feed.PageFeed` feeds it with messages; :mod:`nodes.console` connects both to the topics.
"""

from instant_ic.console.client import ConsoleClient
from instant_ic.console.drive import DriveConfig, DriveGate
from instant_ic.console.protocol import Frame, FrameKind, ProtocolError, decode_frame, encode_frame
from instant_ic.console.server import Backend, ConsoleError, ConsoleServer, ServerConfig
from instant_ic.console.view import Look, ViewConfig

__all__ = [
    "Backend",
    "ConsoleClient",
    "ConsoleError",
    "ConsoleServer",
    "DriveConfig",
    "DriveGate",
    "Frame",
    "FrameKind",
    "Look",
    "ProtocolError",
    "ServerConfig",
    "ViewConfig",
    "decode_frame",
    "encode_frame",
]
