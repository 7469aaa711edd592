"""A Zenoh session whose nodes appear in the ROS graph, as those of rmw_zenoh do.

Zenoh is an extra, imported when a session is opened.
"""

from __future__ import annotations

import itertools
import json
import logging
import os
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from instant_ic.bridge.zenoh_format import ADMIN_SPACE, SENDER_SIZE, FormatError, Kind, Token
from instant_ic.util.closing import Closing
from instant_ic.util.paths import shipped_file

DEFAULT_ROUTER = "tcp/localhost:7447"

CONNECT_TIMEOUT_MS = 2000
"""Time after which a client gives up if no router answers; Zenoh's own default may wait forever."""

SESSION_DEFAULTS = {
    "mode": '"peer"',
    "connect/endpoints": f'["{DEFAULT_ROUTER}"]',
    "listen/endpoints": '["tcp/localhost:0"]',
    "scouting/multicast/enabled": "false",
    "scouting/gossip/enabled": "true",
    # The cache of a latched topic sorts messages by time stamp.
    "timestamping/enabled": "{router: true, peer: true, client: true}",
}
"""rmw_zenoh's configuration of a session: peers meet through the router on their host, without multicast."""

CLIENT_DEFAULTS = {**SESSION_DEFAULTS, "mode": '"client"', "listen/endpoints": "[]"}
"""Configuration for a router elsewhere; Zenoh routers do not forward messages between peers without a direct link."""

ROUTER_DEFAULTS = {
    **SESSION_DEFAULTS,
    "mode": '"router"',
    "connect/endpoints": "[]",
    "listen/endpoints": f'["{DEFAULT_ROUTER}"]',
}

log = logging.getLogger(__name__)


class ZenohError(RuntimeError):
    """Zenoh is not installed, or rejects its configuration; the message says what to do."""


def zenoh() -> Any:
    """Return the zenoh package.

    Raises:
        ZenohError: the extra is not installed.
    """
    try:
        import zenoh
        import zenoh.ext
    except ImportError as error:
        raise ZenohError(f"Zenoh is not installed ({error}): pip install 'instant-ic[zenoh]'") from None
    return zenoh


def load_config(
    file: str,
    connect: Sequence[str] = (),
    listen: Sequence[str] = (),
    defaults: Mapping[str, str] = SESSION_DEFAULTS,
) -> Any:
    """Load a Zenoh configuration.

    Args:
        file: path of a Zenoh JSON5 file, or its name in config/; empty uses ``defaults``.
        connect: endpoints to connect to (``tcp/10.0.0.1:7447``), instead of those of the file.
        listen: endpoints to listen on, instead of those of the file.
        defaults: Zenoh configuration keys → JSON5 values.

    Raises:
        ZenohError: the file does not exist or is not a Zenoh configuration, or an endpoint is invalid.
    """
    package = zenoh()
    what = file
    given = {"connect/endpoints": connect, "listen/endpoints": listen}
    settings = {} if file else dict(defaults)
    settings |= {key: json.dumps(list(endpoints)) for key, endpoints in given.items() if endpoints}
    try:
        config = package.Config.from_json5(_path(file).read_text()) if file else package.Config()
        for key, value in settings.items():
            what = f"{key} {value}"
            config.insert_json5(key, value)
    except OSError as error:
        raise ZenohError(f"session file: {error}") from None
    except package.ZError as error:
        raise ZenohError(f"{what}: not a Zenoh configuration: {_text(error)}") from None
    return config


def _path(file: str) -> Path:
    path = Path(file).expanduser()
    return path if path.is_file() or "/" in file else shipped_file("config", file)


def open_zenoh(config: Any) -> Any:
    """Open a Zenoh session. In peer mode it searches for a missing router in the background.

    Raises:
        ZenohError: an endpoint or certificate cannot be used, or a client finds no router.
    """
    package = zenoh()
    package.init_log_from_env_or("error")
    if json.loads(config.get_json("mode")) == "client":
        config.insert_json5("connect/timeout_ms", str(CONNECT_TIMEOUT_MS))
    try:
        return package.open(config)
    except package.ZError as error:
        raise ZenohError(f"Zenoh session: {_text(error)}") from None


def _text(error: Exception) -> str:
    """Return the text of a Zenoh error without source locations."""
    return re.sub(r"\s+at /\S+\.rs:\d+\.?", "", str(error)).strip()


class RosSession(Closing):
    """Nodes of the ROS graph in one Zenoh session. A context manager.

    Args:
        config: see :func:`load_config`.
        domain: ROS domain.

    Raises:
        ZenohError: see :func:`open_zenoh`.
    """

    def __init__(self, config: Any, domain: int = 0) -> None:
        self.domain = domain
        self.zenoh = open_zenoh(config)
        self.id = str(self.zenoh.info.zid())
        self.gid_head = os.urandom(SENDER_SIZE)
        self.entity_ids = itertools.count()
        self._watch: Any = None

    def close(self) -> None:
        """Close the session with all its tokens, publishers and subscriptions."""
        if not self.zenoh.is_closed():
            self.zenoh.close()

    def links(self) -> tuple[int, int]:
        """Return the numbers of connected routers and peers."""
        return len(self.zenoh.info.routers_zid()), len(self.zenoh.info.peers_zid())

    def watch(self, on_token: Callable[[Token, bool], None]) -> None:
        """Call ``on_token(token, alive)`` for current and future entities of other sessions, on a Zenoh thread."""
        put = zenoh().SampleKind.PUT

        def heard(sample: Any) -> None:
            try:
                token = Token.parse(str(sample.key_expr))
            except FormatError as error:
                log.warning("%s", error)
                return
            if token is not None and token.session != self.id:
                on_token(token, sample.kind == put)

        self._watch = self.zenoh.liveliness().declare_subscriber(f"{ADMIN_SPACE}/{self.domain}/**", heard, history=True)


class RosNode:
    """A node of the ROS graph, as shown by ``ros2 node list``.

    Args:
        session: session of the node.
        namespace: ``/robot1``, or ``/``.
        name: name of the node.
    """

    def __init__(self, session: RosSession, namespace: str, name: str) -> None:
        self.session = session
        self._id = next(session.entity_ids)
        self.namespace, self.name = namespace, name
        self._token = self._declare("NN", self._id)

    def endpoint(self, kind: Kind, *endpoint: Any) -> Any:
        """Declare the token of a publisher or subscription with its topic, type name, type hash and QoS."""
        return self._declare(kind, next(self.session.entity_ids), *endpoint)

    def _declare(self, kind: Kind, number: int, *endpoint: Any) -> Any:
        session = self.session
        token = Token(kind, session.domain, session.id, self._id, number, self.namespace, self.name, *endpoint)
        return session.zenoh.liveliness().declare_token(token.key())

    def close(self) -> None:
        self._token.undeclare()
